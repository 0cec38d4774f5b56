"""θ, the parameters of a policy's actor, as one vector of float64, which holds every float32 exactly."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.utils import obs_as_tensor
from torch.overrides import TorchFunctionMode

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import to_vector
from sb3_reinforce.policies.evaluation import (
    Parameters,
    actor_parameters,
    evaluation_mode,
    leave_no_graph,
    trainable,
)


class ParametersRead(TorchFunctionMode):
    """The parameters that PyTorch's functions take as arguments while this mode is active."""

    def __init__(self) -> None:
        super().__init__()
        self.found: set[th.nn.Parameter] = set()

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        # Of the attributes only those such as T and data have values
        if func.__name__ != "__get__" or isinstance(result, th.Tensor):
            for each in (*args, *kwargs.values()):
                parts = each if isinstance(each, (list, tuple)) else (each,)
                self.found |= {part for part in parts if isinstance(part, th.nn.Parameter)}
        return result


def searched_parameters(policy: ActorCriticPolicy) -> Parameters:
    """
    The trainable parameters that actions are computed from, in the policy's order, without ``log_std``.

    They are those with a gradient of log π, and those that ``predict`` reads: a policy may have no derivative.
    """
    # The memory of this package's recurrent policies and of sb3-contrib's
    if hasattr(policy, "lstm_actor"):
        raise ValueError(f"A policy whose parameters are searched must have no memory, got {type(policy).__name__}")
    observation = observation_in(policy.observation_space)
    obs = obs_as_tensor(observation, policy.device)
    zeros = th.zeros(1, get_action_dim(policy.action_space), device=policy.device)
    actions = as_policy_actions(zeros, policy.action_space)
    with evaluation_mode(policy), th.enable_grad():
        with th.compiler.set_stance("force_eager"), ParametersRead() as read:
            policy.predict(observation, deterministic=True)
        of_actor = read.found | {*actor_parameters(policy, obs, actions)}
        leave_no_graph(policy, obs, actions)
    log_std = getattr(policy, "log_std", None)
    searched = [each for each in trainable(policy) if each in of_actor and each is not log_std]
    if not searched:
        raise ValueError(
            f"The actor of {type(policy).__name__} has no trainable parameters, so there is nothing to search"
        )
    return searched


def observation_in(space: spaces.Space[Any]) -> Any:
    """A batch of one observation, as near to 0 as its space allows: a features extractor may fail outside it."""
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
