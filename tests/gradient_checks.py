"""What the tests of the gradient check share."""

import numpy as np
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE

ACTION_SPACES = [
    spaces.Discrete(3),
    spaces.Discrete(3, start=4),
    spaces.Box(-1, 1, (2,)),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary(2),
]


def corridor(action_space=None):
    """Time limits, rewards that differ, and episodes of two lengths."""
    return Corridor((3, 7), lambda t, action: 1.0 + t + np.sum(action), action_space=action_space, truncate=True)


def with_noise(log_std_init, policy="MlpPolicy", n_actions=1):
    env = corridor(spaces.Box(-1, 1, (n_actions,)))
    return REINFORCE(policy, env, device="cpu", seed=0, policy_kwargs={"log_std_init": log_std_init})


class HalfDetached(ActorCriticPolicy):
    """Cuts the graph between the network and the logits' layer."""

    def evaluate_actions(self, obs, actions):
        latent = self.mlp_extractor.forward_actor(self.extract_features(obs)).detach()
        distribution = self._get_action_dist_from_latent(latent)
        return self.predict_values(obs), distribution.log_prob(actions), distribution.entropy()
