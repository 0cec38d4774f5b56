"""The method ``predict`` of both algorithms."""

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_reinforce.common.spaces import shift_to_start


def predict(
    self: BaseAlgorithm,
    observation: np.ndarray | dict[str, np.ndarray],
    state: tuple[np.ndarray, ...] | None = None,
    episode_start: np.ndarray | None = None,
    deterministic: bool = False,
) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
    """
    The policy's action, as the environment takes it: a Discrete or MultiDiscrete action counts from its start.

    :param observation: The input observation
    :param state: Passed on; the policies are not recurrent
    :param episode_start: Passed on
    :param deterministic: Whether to return the most likely action instead of a sample
    :return: The action and ``state``
    """
    actions, state = BaseAlgorithm.predict(self, observation, state, episode_start, deterministic)
    return shift_to_start(self.action_space, actions), state
