"""Measurements in a model's environments, after which the model goes on from the start of an episode."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.interruptions import interruptible
from sb3_reinforce.envs.guards import guard
from sb3_reinforce.envs.starts import separate, start_episodes
from sb3_reinforce.sampling.normalization import frozen


@contextmanager
def undisturbed(model: BaseAlgorithm) -> Iterator[None]:
    """Use a model's environments with VecNormalize frozen; the model then goes on from the start of an episode."""
    if getattr(model, "is_collecting", False):
        raise ValueError(
            "model is collecting a rollout, whose episodes a measurement in the same environments would cut: call it "
            "in on_rollout_end, or after training"
        )
    env = cast(VecEnv, model.env)
    # Whatever ends the block, a model without an observation resets its environments before its next rollout
    model._last_obs = None
    with interruptible(), guard(env), frozen(env):
        try:
            yield
        finally:
            separate(env)
        obs = env.reset()
    model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
    model._last_obs = obs  # type: ignore[assignment]


def start_from(model: BaseAlgorithm, seeds: NDArray[np.integer]) -> Any:
    """Let the next rollout of a model consist of episodes from given seeds, and return their first observations."""
    env = cast(VecEnv, model.env)
    obs = start_episodes(env, seeds)
    model._last_obs = obs
    model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
    return obs
