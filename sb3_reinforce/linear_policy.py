"""The policy with the fewest parameters."""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule


class LinearPolicy(ActorCriticPolicy):
    """
    An ``ActorCriticPolicy`` without hidden layers: means or logits are linear in the (flattened) observation.

    It has (observation dimension + 1) × (number of means or logits) parameters in the actor.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param kwargs: As for ``ActorCriticPolicy``
    :raises ValueError: If ``net_arch`` asks for hidden layers
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        **kwargs: Any,
    ):
        if kwargs.get("net_arch"):
            raise ValueError(f"LinearPolicy has no hidden layers, got net_arch={kwargs['net_arch']!r}: use MlpPolicy")
        super().__init__(observation_space, action_space, lr_schedule, **{**kwargs, "net_arch": []})
