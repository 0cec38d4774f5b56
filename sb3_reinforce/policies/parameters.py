"""θ, the parameters of a policy's actor, as one vector."""

from collections.abc import Sequence

import numpy as np
import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.spaces import as_policy_actions, zeros
from sb3_reinforce.policies.evaluation import depends_on, log_prob_and_entropy


def actor_parameters(policy: ActorCriticPolicy) -> list[th.nn.Parameter]:
    """
    The trainable parameters that the most likely action depends on: the critic's and ``log_std`` are not among them.

    :param policy: The policy
    :return: In the policy's own order
    :raises ValueError: If there are none
    """
    obs = obs_as_tensor(zeros(policy.observation_space), policy.device)
    action_dim = int(np.prod(zeros(policy.action_space).shape))
    actions = as_policy_actions(th.zeros(1, action_dim, device=policy.device), policy.action_space)
    log_std = getattr(policy, "log_std", None)
    searched = [parameter for parameter in policy.parameters() if parameter.requires_grad and parameter is not log_std]
    policy.set_training_mode(False)
    in_actor = depends_on(log_prob_and_entropy(policy, obs, actions)[0], searched)
    parameters = [parameter for parameter, actor in zip(searched, in_actor, strict=True) if actor]
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
