"""θ, the parameters of a policy's actor, as one vector."""

from collections.abc import Sequence

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.policies import split_parameters


def actor_parameters(policy: ActorCriticPolicy) -> list[th.nn.Parameter]:
    """
    The trainable parameters that the most likely action depends on: the critic's and ``log_std`` are not among them.

    :param policy: The policy
    :return: In the policy's own order
    :raises ValueError: If there are none
    """
    log_std = getattr(policy, "log_std", None)
    parameters = [parameter for parameter in split_parameters(policy)[0] if parameter is not log_std]
    if not parameters:
        raise ValueError(
            f"The actor of {type(policy).__name__} has no trainable parameters, so there is nothing to search"
        )
    return parameters


def read(parameters: Sequence[th.Tensor]) -> th.Tensor:
    """
    Parameters, or their gradients, as one vector. float64 holds every float32 exactly.

    :param parameters: Tensors with n elements in all
    :return: θ, shape ``(n,)``, float64, on the CPU
    """
    return th.cat([parameter.detach().flatten().to("cpu", th.float64) for parameter in parameters])


def split(thetas: th.Tensor, parameters: Sequence[th.Tensor]) -> list[th.Tensor]:
    """
    Vectors in the shapes, types and on the devices of the parameters that they are values of.

    :param thetas: Shape ``(k, n)``
    :param parameters: Tensors with n elements in all
    :return: For each parameter a tensor of shape ``(k, *parameter.shape)``
    """
    parts = th.split(thetas, [parameter.numel() for parameter in parameters], dim=1)
    return [
        part.reshape(-1, *parameter.shape).to(parameter.device, parameter.dtype)
        for part, parameter in zip(parts, parameters, strict=True)
    ]


@th.no_grad()
def write(parameters: Sequence[th.Tensor], theta: th.Tensor) -> None:
    """
    Set parameters to the values in a vector.

    :param parameters: Tensors with n elements in all
    :param theta: θ, shape ``(n,)``
    """
    for parameter, part in zip(parameters, split(theta[None], parameters), strict=True):
        parameter.copy_(part[0])
