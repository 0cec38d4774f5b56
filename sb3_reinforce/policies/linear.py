"""The policy with the fewest parameters."""

from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule


class LinearPolicy(ActorCriticPolicy):
    """
    An ``ActorCriticPolicy`` whose means or logits are ``W s``, linear in the (flattened) observation.

    No hidden layers, and the bias stays 0, as in ARS: observations are often small, and a perturbed bias alone would
    decide every action. The actor has (observation dimension) × (number of means or logits) parameters.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param kwargs: As for ``ActorCriticPolicy``
    :raises ValueError: If ``net_arch`` asks for hidden layers, or observations are dicts that no features extractor
        flattens
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        **kwargs: Any,
    ):
        net_arch = kwargs.get("net_arch")
        layers = net_arch.values() if isinstance(net_arch, dict) else [net_arch]
        if any(layers):
            raise ValueError(f"LinearPolicy has no hidden layers, got net_arch={net_arch!r}: use MlpPolicy")
        if isinstance(observation_space, spaces.Dict) and "features_extractor_class" not in kwargs:
            raise ValueError(
                f"LinearPolicy needs observations in one array, got {observation_space}: use MultiInputPolicy, "
                "or MaskedPolicy for action masks"
            )
        super().__init__(observation_space, action_space, lr_schedule, **{**kwargs, "net_arch": []})
        th.nn.init.zeros_(cast(th.Tensor, self.action_net.bias)).requires_grad_(False)
