"""
What REINFORCE asks of an actor-critic policy of Stable-Baselines3, or of a user's own subclass of it.

A method that the user has overridden is called as it is; where nothing is overridden, only the actor is evaluated.
"""

import math
from typing import TypeAlias

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.policies.backpropagation import through
from sb3_reinforce.policies.plain_mlp import DivideLogits, actor_layers, overrides

Parameters: TypeAlias = list[th.nn.Parameter]


def tells_values(policy: ActorCriticPolicy, with_critic: bool) -> bool:
    """
    Whether V(s) is told along with the actions.

    Either the policy overrides ``forward``, or ``extract_features``, which Stable-Baselines3 calls there, or V is
    needed and actor and critic share a features extractor that has parameters: a pass for V alone would evaluate it
    again.

    :param policy: The policy
    :param with_critic: Whether V is needed
    """
    if overrides(policy, "forward") or overrides(policy, "extract_features"):
        return True
    is_shared = policy.share_features_extractor and any(True for _ in policy.features_extractor.parameters())
    return with_critic and is_shared and not has_parts(policy)


def has_parts(policy: ActorCriticPolicy) -> bool:
    """
    Whether the policy has its own way to its actions or to V, which ``forward`` and ``evaluate_actions`` would pass by.

    :param policy: The policy
    """
    return overrides(policy, "predict_values") or overrides(policy, "get_distribution")


def log_prob_and_entropy(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    log π(a|s) and the entropy of π(·|s), without evaluating the critic.

    :param policy: The policy
    :param obs: ``n`` observations
    :param actions: As ``as_policy_actions`` gives them
    :return: Two tensors of shape ``(n,)``. Where the entropy has no closed form (squashed output) it is estimated by
        −log π(a|s)
    """
    return evaluate(policy, obs, actions, with_values=False)[:2]


def evaluate(
    policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor, with_values: bool
) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
    """
    log π(a|s), the entropy of π(·|s), and V(s) if asked for, with one pass of a features extractor that is shared.

    :param policy: The policy
    :param obs: ``n`` observations
    :param actions: As ``as_policy_actions`` gives them
    :param with_values: Whether to evaluate the critic
    :return: As ``log_prob_and_entropy``, and V(s), shape ``(n,)``
    """
    values: th.Tensor | None = None
    has_own = overrides(policy, "evaluate_actions") or overrides(policy, "extract_features")
    if has_own or (with_values and not has_parts(policy)):
        values, log_prob, entropy = policy.evaluate_actions(obs, actions)
    else:
        layers = actor_layers(policy)
        if layers is None:
            distribution = policy.get_distribution(obs)
        else:
            distribution = distribution_of(policy, through(layers, obs.flatten(1).float()))  # type: ignore[union-attr]
        log_prob, entropy = distribution.log_prob(actions), distribution.entropy()
        if with_values:
            values = policy.predict_values(obs)
    entropy = -log_prob if entropy is None else entropy
    return log_prob, entropy, values.flatten() if with_values and values is not None else None


def distribution_of(policy: ActorCriticPolicy, outputs: th.Tensor) -> Distribution:
    """
    The distribution of actions of a policy whose actor is a plain MLP.

    :param policy: The policy
    :param outputs: What its last layer returns: logits, or means, shape ``(n, width)``
    """
    log_std = [policy.log_std] if isinstance(policy.action_dist, DiagGaussianDistribution) else []
    return policy.action_dist.proba_distribution(outputs, *log_std)


def split_parameters(
    policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor
) -> tuple[Parameters, Parameters, Parameters]:
    """
    Sort the trainable parameters by what depends on them, read from the graph and not from their names.

    :param policy: The policy
    :param obs: ``n`` observations
    :param actions: As ``as_policy_actions`` gives them
    :return: The parameters that log π depends on, those that only V depends on, and those that both depend on (a shared
        features extractor); the third list is part of the first
    """
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    in_actor = reached(log_prob_and_entropy(policy, obs, actions)[0], parameters)
    in_critic = reached(policy.predict_values(obs), parameters)
    table = list(zip(parameters, in_actor, in_critic, strict=True))
    return (
        [parameter for parameter, actor, _ in table if actor],
        [parameter for parameter, actor, critic in table if critic and not actor],
        [parameter for parameter, actor, critic in table if critic and actor],
    )


def reached(output: th.Tensor, parameters: Parameters) -> list[bool]:
    """
    Which parameters an output depends on.

    :param output: Any tensor
    :param parameters: The parameters
    """
    if not output.requires_grad:
        return [False] * len(parameters)
    return [grad is not None for grad in th.autograd.grad(output.sum(), parameters, allow_unused=True)]


# At this temperature the logits of float32 networks leave one action
MIN_TEMPERATURE = 1e-3


def set_temperature(policy: ActorCriticPolicy, temperature: float) -> None:
    """
    From now on the policy acts and is evaluated at a temperature. ``policy.save`` does not keep it, a model's does.

    :param policy: A policy over discrete actions
    :param temperature: τ; below ``MIN_TEMPERATURE`` this stands for it, so that a schedule may fall to 0
    :raises ValueError: If τ is not 1 and the policy has no ``action_net``
    """
    layer = getattr(policy, "action_net", None)
    if layer is None and temperature != 1:
        raise ValueError(f"temperature needs a policy with an action_net, and {type(policy).__name__} has none")
    hooks = [hook for hook in layer._forward_hooks.values() if isinstance(hook, DivideLogits)] if layer else []
    if temperature != 1 and not hooks and layer:
        hooks = [DivideLogits(th.ones((), device=policy.device))]
        layer.register_forward_hook(hooks[0])
    for hook in hooks:
        hook.temperature.fill_(max(temperature, MIN_TEMPERATURE))


@th.no_grad()
def floor_std(policy: ActorCriticPolicy, min_std: float) -> None:
    """
    ``log_std ← max(log_std, log min_std)``: the projection of the standard deviations to at least ``min_std``.

    :param policy: A policy with Gaussian actions
    :param min_std: The floor, in units of the (unsquashed) action; 0 is no floor
    :raises ValueError: If there is a floor and the policy has no ``log_std``
    """
    if min_std > 0:
        if not hasattr(policy, "log_std"):
            raise ValueError(f"min_std needs a policy with a log_std, and {type(policy).__name__} has none")
        policy.log_std.clamp_(min=math.log(min_std))
