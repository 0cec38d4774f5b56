"""
What REINFORCE asks of an actor-critic policy of Stable-Baselines3, or of a user's own subclass of it.

A method that the user has overridden is called as it is; where nothing is overridden, only the actor is evaluated.
"""

from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor

Parameters: TypeAlias = list[th.nn.Parameter]


def overrides(policy: ActorCriticPolicy, method: str) -> bool:
    """
    Whether the policy's class has its own version of a method. A compiled policy has its own ``forward``.

    :param policy: The policy
    :param method: Name of a method of ``ActorCriticPolicy``
    """
    return getattr(type(policy), method, None) is not getattr(ActorCriticPolicy, method)


def as_policy_actions(actions: th.Tensor, action_space: spaces.Space[Any]) -> th.Tensor:
    """
    Stored actions in the form that ``evaluate_actions`` takes.

    :param actions: Shape ``(n, action_dim)``
    :param action_space: The action space
    :return: Shape ``(n,)``, int64 for Discrete, else ``(n, action_dim)``, float32
    """
    return actions.long().flatten() if isinstance(action_space, spaces.Discrete) else actions.float()


def log_prob_and_entropy(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    log π(a|s) and the entropy of π(·|s), without evaluating the critic.

    :param policy: The policy
    :param obs: ``n`` observations
    :param actions: As ``as_policy_actions`` gives them
    :return: Two tensors of shape ``(n,)``. Where the entropy has no closed form (squashed output) it is estimated by
        −log π(a|s)
    """
    if overrides(policy, "evaluate_actions"):
        _, log_prob, entropy = policy.evaluate_actions(obs, actions)
    else:
        distribution = policy.get_distribution(obs)
        log_prob, entropy = distribution.log_prob(actions), distribution.entropy()
    return log_prob, -log_prob if entropy is None else entropy


def split_parameters(policy: ActorCriticPolicy) -> tuple[Parameters, Parameters, Parameters]:
    """
    Sort the trainable parameters by what depends on them, read from the graph of one evaluation, not from their names.

    :param policy: The policy
    :return: The parameters that log π depends on, those that only V depends on, and those that both depend on (the
        shared features extractor); the third list is part of the first
    """
    obs = obs_as_tensor(_zeros(policy.observation_space), policy.device)
    action_dim = int(np.prod(_zeros(policy.action_space).shape))
    actions = as_policy_actions(th.zeros(1, action_dim, device=policy.device), policy.action_space)
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    policy.set_training_mode(False)
    in_actor, in_critic = (
        [grad is not None for grad in th.autograd.grad(output.sum(), parameters, allow_unused=True)]
        for output in (log_prob_and_entropy(policy, obs, actions)[0], policy.predict_values(obs))
    )
    sorted_parameters = list(zip(parameters, in_actor, in_critic, strict=True))
    return (
        [parameter for parameter, actor, _ in sorted_parameters if actor],
        [parameter for parameter, actor, critic in sorted_parameters if critic and not actor],
        [parameter for parameter, actor, critic in sorted_parameters if critic and actor],
    )


def _zeros(space: spaces.Space[Any]) -> Any:
    """An all-zero batch of one element of the space."""
    if isinstance(space, spaces.Dict):
        return {key: _zeros(part) for key, part in space.spaces.items()}
    return np.zeros((1, *(space.shape or ())), dtype=space.dtype)


def divide_logits(policy: ActorCriticPolicy, temperature: th.Tensor) -> None:
    """
    From now on ``π(a|s) ∝ exp(logits(s, a) / τ)``, wherever the policy is evaluated.

    :param policy: A policy over discrete actions
    :param temperature: τ, a tensor without dimensions, read at each evaluation
    :raises ValueError: If the policy has no ``action_net``
    """
    if not hasattr(policy, "action_net"):
        raise ValueError(f"temperature needs a policy with an action_net, and {type(policy).__name__} has none")
    policy.action_net.register_forward_hook(lambda module, inputs, logits: logits / temperature)


@th.no_grad()
def floor_std(policy: ActorCriticPolicy, min_std: float) -> None:
    """
    ``log_std ← max(log_std, log min_std)``: the projection of the standard deviations to at least ``min_std``.

    :param policy: A policy with Gaussian actions
    :param min_std: The floor, in units of the (unsquashed) action; 0 is no floor
    :raises ValueError: If the policy has no ``log_std``
    """
    if min_std > 0:
        if not hasattr(policy, "log_std"):
            raise ValueError(f"min_std needs a policy with a log_std, and {type(policy).__name__} has none")
        policy.log_std.clamp_(min=float(np.log(min_std)))
