"""Measurements in a model's environments, after which the model goes on from the start of an episode."""

import copy
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.interruptions import interruptible
from sb3_reinforce.envs.guards import guard
from sb3_reinforce.envs.starts import give_new_seeds, start_episodes
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.sampling.normalization import frozen

# Where the distribution of gSDE keeps its noise
NOISE = ("exploration_mat", "exploration_matrices")


@contextmanager
def undisturbed(model: BaseAlgorithm) -> Iterator[None]:
    """Use a model's environments with VecNormalize frozen; the model then goes on from the start of an episode."""
    if getattr(model, "is_collecting", False):
        raise ValueError(
            "model is collecting a rollout, and a measurement in the same environments would cut its episodes: measure "
            "in on_rollout_end, or after training"
        )
    env = cast(VecEnv, model.env)
    # Whatever ends the block, a model without an observation resets its environments before its next rollout
    model._last_obs = None
    with interruptible(), guard(env), frozen(env), kept_noise(model.policy):
        try:
            yield
        finally:
            give_new_seeds(env)
        start_from(model, None)


@contextmanager
def kept_noise(policy: Any) -> Iterator[None]:
    """Restore the noise of gSDE after the block: A2C and PPO draw it before ``on_rollout_start``."""
    attributes = vars(policy.action_dist)
    noise = {name: attributes[name] for name in NOISE if name in attributes}
    try:
        yield
    finally:
        attributes.update(noise)


def start_from(model: BaseAlgorithm, seeds: NDArray[np.integer] | None) -> Any:
    """Start episodes for a model's next rollout, from seeds or None for any; return their first observations."""
    env = cast(VecEnv, model.env)
    obs = start_episodes(env, seeds)
    model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
    # Last: after an interrupt before it, the model has no observation and resets its environments
    model._last_obs = obs
    return obs


def sampling_copy(model: Any, n_episodes: int, baseline: str | Baseline | None) -> Any:
    """
    A copy of a REINFORCE for measurements of whole episodes: it shares policy and environments, with its own log,
    counters and rollouts. ``collect_rollouts`` resets the environments first. Without a baseline it has ``"value"``
    with a critic, else ``"none"``.
    """
    sampler = copy.copy(model)
    sampler.n_steps = None
    sampler.n_episodes = n_episodes
    sampler.episodes_per_start = 1
    sampler.baseline = baseline or ("value" if model.has_critic else "none")
    if not sampler.has_critic:
        # λ weights values, and there are none
        sampler.gae_lambda = 1.0
    sampler._processes = None
    sampler.set_logger(Logger(folder=None, output_formats=[]))
    sampler.ep_info_buffer = deque(maxlen=1)
    sampler.ep_success_buffer = deque(maxlen=1)
    sampler.rollout_buffer = model.rollout_buffer_class(
        1, model.observation_space, model.action_space, model.device, n_envs=model.n_envs, **model.rollout_buffer_kwargs
    )
    sampler._last_episode_starts = np.zeros(model.n_envs, dtype=bool)
    return sampler
