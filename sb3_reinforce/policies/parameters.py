"""θ, the parameters of a policy's actor, as one vector of float64, which holds every float32 exactly."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import to_vector
from sb3_reinforce.policies.evaluation import (
    Parameters,
    actor_parameters,
    critic_parameters,
    evaluation_mode,
    leave_no_graph,
    trainable,
)


def searched_parameters(policy: ActorCriticPolicy) -> Parameters:
    """
    The trainable parameters in the policy's order, without ``log_std`` and without those that V alone depends on.

    A parameter that neither has a derivative for is searched, with a warning: it may come before a threshold.
    """
    # The memory of this package's recurrent policies and of sb3-contrib's
    if hasattr(policy, "lstm_actor"):
        raise ValueError(f"A policy whose parameters are searched must have no memory, got {type(policy).__name__}")
    obs = obs_as_tensor(observation_in(policy.observation_space), policy.device)
    zeros = th.zeros(1, get_action_dim(policy.action_space), device=policy.device)
    actions = as_policy_actions(zeros, policy.action_space)
    with evaluation_mode(policy), th.enable_grad():
        of_actor = {*actor_parameters(policy, obs, actions)}
        of_critic = {*critic_parameters(policy, obs, actions)}
        leave_no_graph(policy, obs, actions)
    left_out = {getattr(policy, "log_std", None), *(of_critic - of_actor)}
    searched = [parameter for parameter in trainable(policy) if parameter not in left_out]
    unreached = {parameter for parameter in searched if parameter not in of_actor}
    if unreached:
        name = next(name for name, parameter in policy.named_parameters() if parameter in unreached)
        warnings.warn(
            f"Neither log π nor V of {type(policy).__name__} has a derivative for {len(unreached)} of its parameters "
            f"(the first is {name}). They are searched too: call requires_grad_(False) on those that do not change "
            "actions",
            stacklevel=2,
        )
    if not searched:
        raise ValueError(
            f"The actor of {type(policy).__name__} has no trainable parameters, so there is nothing to search"
        )
    return searched


def observation_in(space: spaces.Space[Any]) -> Any:
    """One observation, as near to 0 as its space allows, since a features extractor may be undefined outside it."""
    if isinstance(space, spaces.Dict):
        return {key: observation_in(part) for key, part in space.spaces.items()}
    zeros: Any = create_empty_array(space)
    return zeros.clip(space.low, space.high) if isinstance(space, spaces.Box) else zeros


def read(parameters: Sequence[th.Tensor]) -> th.Tensor:
    """θ, a copy of the parameters, shape ``(n,)``, on the CPU."""
    return to_vector(parameters).cpu().double()


def split(thetas: th.Tensor, parameters: Sequence[th.Tensor]) -> list[th.Tensor]:
    """For each parameter its values in θs of shape ``(k, n)``, of shape ``(k, *parameter.shape)``."""
    parts = th.split(thetas, [parameter.numel() for parameter in parameters], dim=1)
    return [
        part.reshape(-1, *parameter.shape).to(parameter.device, parameter.dtype)
        for part, parameter in zip(parts, parameters, strict=True)
    ]


@contextmanager
def restored(parameters: Sequence[th.Tensor]) -> Iterator[None]:
    """Set the parameters to their present values when the block ends."""
    before = to_vector(parameters)
    try:
        yield
    finally:
        write(parameters, before)


@th.no_grad()
def write(parameters: Sequence[th.Tensor], theta: th.Tensor) -> None:
    """Set the parameters to the values in θ."""
    for parameter, part in zip(parameters, split(theta[None], parameters), strict=True):
        parameter.copy_(part[0])
