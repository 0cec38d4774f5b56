"""Measuring a model without disturbing it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv


@contextmanager
def undisturbed(model: BaseAlgorithm) -> Iterator[None]:
    """Freeze the statistics of VecNormalize in the block, and leave the environments at the start of an episode."""
    env, normalize = cast(VecEnv, model.env), model.get_vec_normalize_env()
    training = normalize is not None and normalize.training
    try:
        if normalize is not None:
            normalize.training = False
        yield
        model._last_obs = env.reset()  # type: ignore[assignment]
        model._last_episode_starts = np.ones(env.num_envs, dtype=bool)
    except Exception:
        model._last_obs = None
        raise
    finally:
        if normalize is not None:
            normalize.training = training
