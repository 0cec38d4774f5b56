"""Episodes for a measurement: collected by the model's own code, without a change to the model."""

import copy
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.arguments import check_integer
from sb3_reinforce.envs.guards import guard
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.sampling.collection import by_step

AnyREINFORCE = TypeVar("AnyREINFORCE", bound=REINFORCE)


class Infos(BaseCallback):
    """Keeps the infos of every step: ``infos[t][i]`` of environment i."""

    def __init__(self) -> None:
        super().__init__()
        self.infos: list[list[dict[str, Any]]] = []

    def _on_step(self) -> bool:
        self.infos.append(self.locals["infos"])
        return True


def sample(model: REINFORCE, n_episodes: int, baseline: str | None = None) -> Rollout:
    """
    Whole episodes of the model's policy in its environments, with the model's own returns.

    The model keeps its parameters, counters and log, and the statistics of a VecNormalize stay as they are; its
    environments are left at the start of an episode.

    With gSDE the episodes share noise, unless ``sde_sample_freq=1``, and are not independent samples.

    :param model: The model
    :param n_episodes: Number of episodes, at least 2
    :param baseline: The baseline to collect with; None for ``"value"`` where the model has a critic, else ``"none"``
    :return: The rollout; ``values`` only where the model has a critic
    :raises TypeError: If the model is not a REINFORCE
    :raises ValueError: If there are too few episodes, or the model has no environment
    """
    sampler, _ = sampled(model, n_episodes, baseline)
    assert sampler.rollout is not None
    return sampler.rollout


def sampled(
    model: AnyREINFORCE, n_episodes: int, baseline: str | Baseline | None = None, seed: int | None = None
) -> tuple[AnyREINFORCE, Infos]:
    """
    A copy of the model, which shares its policy and environments, after it has collected a rollout; and the infos.

    :param model: The model
    :param n_episodes: Number of episodes, at least 2
    :param baseline: As for ``sample``
    :param seed: The seed of the environments; None to let them go on
    :raises TypeError: If the model is not a REINFORCE
    :raises ValueError: If there are too few episodes, or the model has no environment
    """
    env = check_model(model)
    sampler = copy.copy(model)
    sampler.n_steps, sampler.n_episodes = None, check_integer("n_episodes", n_episodes, 2)  # type: ignore[assignment]
    sampler.baseline = baseline or ("value" if model.has_critic else "none")
    sampler._logger = Logger(folder=None, output_formats=[])
    sampler.ep_info_buffer, sampler.ep_success_buffer = deque(maxlen=1), deque(maxlen=1)
    sampler.rollout_buffer = model.rollout_buffer_class(  # type: ignore[misc]
        1, env.observation_space, env.action_space, model.device, n_envs=env.num_envs, **model.rollout_buffer_kwargs
    )
    callback = Infos()
    callback.init_callback(sampler)
    with undisturbed(model):
        if seed is not None:
            env.seed(seed)
        sampler._last_obs = env.reset()  # type: ignore[assignment]
        sampler._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        sampler.collect_rollouts(env, callback, sampler.rollout_buffer, None)
    return sampler, callback


@contextmanager
def seeded(policy: BasePolicy, seed: int) -> Iterator[None]:
    """
    Draw from a seed in the block, and leave PyTorch's generator and the mode of a policy as they were.

    :param policy: The policy
    :param seed: The seed
    """
    training = policy.training
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        try:
            yield
        finally:
            policy.set_training_mode(training)


@contextmanager
def undisturbed(model: BaseAlgorithm) -> Iterator[None]:
    """
    Use a model's environments in the block; the statistics of a VecNormalize stay as they are.

    :param model: The model; in the middle of training too, it then goes on from the start of an episode
    """
    env, normalize = cast(VecEnv, model.env), model.get_vec_normalize_env()
    training = normalize is not None and normalize.training
    try:
        if normalize is not None:
            normalize.training = False
        with guard(env):
            yield
        model._last_obs = env.reset()  # type: ignore[assignment]
        model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
    except Exception:
        model._last_obs = None
        raise
    finally:
        if normalize is not None:
            normalize.training = training


def check_model(model: Any) -> VecEnv:
    """
    Check that a model can be measured.

    :param model: Meant to be a REINFORCE with an environment
    :return: Its environments
    :raises TypeError: If it is not a REINFORCE
    :raises ValueError: If it has no environment
    """
    if not isinstance(model, REINFORCE):
        raise TypeError(f"model must be a REINFORCE, got {model!r} of type {type(model).__name__}")
    return check_env(model)


def check_env(model: BaseAlgorithm) -> VecEnv:
    """
    Check that a model has environments.

    :param model: The model
    :return: Its environments
    :raises ValueError: If it has none
    """
    if model.env is None:
        raise ValueError("model must have an environment to sample episodes from: call set_env first")
    return model.env


def check_independent(model: BaseAlgorithm) -> None:
    """
    Check that the episodes of a model are independent samples, as the statistics of their gradients take them to be.

    :param model: The model
    :raises ValueError: If they share noise
    """
    if model.use_sde and model.sde_sample_freq != 1:
        raise ValueError(
            f"model has use_sde=True and sde_sample_freq={model.sde_sample_freq}: its episodes share noise, and the "
            "variance between them is not that of independent samples. Measure a model with sde_sample_freq=1, or "
            "without use_sde"
        )


def training_weights(model: REINFORCE) -> th.Tensor:
    """
    What training reads as G_t − b_t, before or after it has trained on the rollout.

    :param model: A model that has collected a rollout
    :return: Shape ``(n_steps, n_envs)``, float64
    """
    return th.as_tensor(by_step(model.rollout_buffer)[0]).double()
