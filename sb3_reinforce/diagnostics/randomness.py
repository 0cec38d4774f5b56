"""How random a policy still is."""

import math
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.common.settings import MAX_TEMPERATURE
from sb3_reinforce.policies.evaluation import action_distribution
from sb3_reinforce.policies.masks import FORBIDDEN


def randomness(policy: ActorCriticPolicy, obs: Any, entropy: float) -> float:
    """Entropy / largest entropy, or for a Box min(1, standard deviation / half the mean width); NaN if not known."""
    space = policy.action_space
    distribution: Any = action_distribution(policy, obs).distribution
    if isinstance(space, spaces.Box):
        # Not train/std, which with gSDE is a standard deviation of weights
        std = float(distribution.stddev.mean()) if isinstance(distribution, th.distributions.Normal) else math.nan
        # A squashed policy acts on [-1, 1], whatever the space
        half_width = 1.0 if policy.squash_output else float(np.subtract(space.high, space.low, dtype=float).mean() / 2)
        return float(np.minimum(std / half_width, 1.0)) if half_width > 0 else math.nan
    parts = distribution if isinstance(distribution, list) else [distribution]
    if all(isinstance(part, th.distributions.Categorical) for part in parts):
        # Of a policy that prefers none of the actions that a mask allows
        masked = FORBIDDEN / MAX_TEMPERATURE / 2
        largest = float(sum((part.logits > masked).sum(-1).log().mean() for part in parts))
    else:
        largest = math.log(2) * math.prod(space.shape or ())
    return entropy / largest if largest > 0 else math.nan
