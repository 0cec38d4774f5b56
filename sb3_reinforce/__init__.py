"""REINFORCE and finite-difference policy search as algorithms of Stable-Baselines3."""

from sb3_reinforce.common.processes import is_leader
from sb3_reinforce.envs.vec_env import GymnasiumVecEnv
from sb3_reinforce.estimation import Rollout
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.policies.linear import LinearPolicy
from sb3_reinforce.policies.masks import ActionMaskObservation, MaskedPolicy
from sb3_reinforce.reinforce import REINFORCE

__version__ = "0.1.0"

__all__ = [
    "REINFORCE",
    "ActionMaskObservation",
    "FiniteDifference",
    "GymnasiumVecEnv",
    "LinearPolicy",
    "MaskedPolicy",
    "Rollout",
    "__version__",
    "is_leader",
]
