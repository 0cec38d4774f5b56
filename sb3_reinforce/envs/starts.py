"""Episodes that start from given seeds."""

from contextlib import suppress
from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_reinforce.envs.checks import check_finite

# The attribute that marks a VecEnv with given seeds: its environments may repeat each other, or earlier episodes
MARK = "has_given_seeds"


def base_of(env: VecEnv) -> Any:
    """The environments below all wrappers; those of other libraries need not be a VecEnv, and lack ``unwrapped``."""
    base = env
    while isinstance(base, VecEnvWrapper):
        base = base.venv
    return base


def start_episodes(env: VecEnv, seeds: NDArray[np.integer] | None) -> Any:
    """The first observations of episodes, environment i with the seed ``seeds[i]``; None leaves the seeds open."""
    if seeds is None:
        give_new_seeds(env)
        return env.reset()
    base = base_of(env)
    if not hasattr(base, "env_method"):
        raise cannot_seed(base)
    setattr(base, MARK, True)
    # VecEnv.seed(s) can only give environment i the seed s + i, so each environment is reset with its seed. Then the
    # reset of all passes through every wrapper and continues these random numbers
    for seed in np.unique(seeds).tolist():
        try:
            env.env_method("reset", seed=seed, indices=np.flatnonzero(seeds == seed).tolist())
        except (NotImplementedError, TypeError) as error:
            # Some VecEnvs pass the indices on to an environment, which does not know them
            if isinstance(error, TypeError) and "indices" not in str(error):
                raise
            raise cannot_seed(base) from error
    return env.reset()


def cannot_seed(base: Any) -> ValueError:
    """The error for environments that cannot be reset with a seed each."""
    return ValueError(
        "Episodes can start from given seeds only where env_method('reset', seed=...) works, and "
        f"{type(base).__name__} does not support it here: use DummyVecEnv or SubprocVecEnv. Training needs no given "
        "seeds with common_random_numbers=False (FiniteDifference) and episodes_per_start=1 (REINFORCE)"
    )


def start_groups(env: VecEnv, size: int) -> Any:
    """First observations; each group of ``size`` neighboring environments shares a start."""
    seeds = th.randint(2**31, (env.num_envs // size,)).numpy().repeat(size)
    # Pending seeds would replace these. VecNormalize need not know of this reset
    base_of(env).reset()
    obs = start_episodes(env, seeds)
    check_groups(obs, size)
    return obs


def has_given_seeds(env: VecEnv) -> bool:
    """Whether environments have started from given seeds, and may draw the same random numbers."""
    return getattr(base_of(env), MARK, False)


def give_new_seeds(env: VecEnv) -> None:
    """Give environments with given seeds new and different ones, from their next reset on."""
    if has_given_seeds(env):
        # By NumPy's generator: measurements seed PyTorch's, and training would repeat its starts after each of them
        reseed(env, np.random.randint(2**31))
        setattr(base_of(env), MARK, False)


def reseed(env: VecEnv, seed: int) -> None:
    """Give environments different seeds, from their next reset on."""
    # A user's VecEnv may have no seeds
    if hasattr(base_of(env), "seed"):
        with suppress(NotImplementedError):
            env.seed(seed)


def are_alike(obs: Any, size: int) -> bool:
    """Whether the observations of each ``size`` neighbors are equal."""
    parts = obs.values() if isinstance(obs, dict) else [obs]
    return all(np.array_equal(part, part[::size].repeat(size, axis=0)) for part in parts)


def check_groups(obs: Any, size: int) -> None:
    """Refuse first observations that differ between ``size`` neighbors, which had the same seed."""
    check_finite("The observation", obs, (None,))
    if not are_alike(obs, size):
        raise ValueError(
            "Episodes cannot share their start: environments reset with the same seed, and then once more without a "
            "seed, return different observations. The environment must draw all random numbers from self.np_random"
        )
