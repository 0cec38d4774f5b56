"""
Which policies are plain MLPs, so that ``passes`` and ``backpropagation`` compute what they would, and which have code
of their own.
"""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, MlpExtractor

from sb3_reinforce.policies.backpropagation import parameters_of

# What a policy may have changed on the way from an observation to an action, or to V
ACTOR_METHODS = ("forward", "extract_features", "get_distribution", "_get_action_dist_from_latent")
CRITIC_METHODS = ("forward", "extract_features", "predict_values")
# What the noise of the laid-out actor can be turned into
DISTRIBUTIONS = (BernoulliDistribution, CategoricalDistribution, DiagGaussianDistribution, MultiCategoricalDistribution)


class DivideLogits:
    """
    ``π(a|s) ∝ exp(logits(s, a) / τ)``: a forward hook for the layer that makes the logits.

    :param temperature: τ, a tensor without dimensions
    """

    def __init__(self, temperature: th.Tensor):
        self.temperature = temperature

    def __call__(self, module: th.nn.Module, inputs: Any, logits: th.Tensor) -> th.Tensor:
        """
        Divide the logits.

        :param module: The layer
        :param inputs: Its inputs
        :param logits: Its output
        """
        return logits / self.temperature


def overrides(policy: ActorCriticPolicy, method: str) -> bool:
    """
    Whether the policy has its own version of a method, in its class or set on itself. A compiled policy has its own
    ``forward``.

    :param policy: The policy
    :param method: Name of a method of ``ActorCriticPolicy``
    """
    return method in vars(policy) or getattr(type(policy), method, None) is not getattr(ActorCriticPolicy, method)


def actor_layers(policy: ActorCriticPolicy) -> list[th.nn.Module] | None:
    """
    The layers from the observation to the parameters of the action distribution.

    :param policy: The policy
    :return: None if the actor is not a plain MLP
    """
    if type(policy.action_dist) not in DISTRIBUTIONS or any(overrides(policy, method) for method in ACTOR_METHODS):
        return None
    return plain_layers(policy, policy.pi_features_extractor, "policy_net", policy.action_net)


def critic_layers(policy: ActorCriticPolicy) -> list[th.nn.Module] | None:
    """
    The layers from the observation to V.

    :param policy: The policy
    :return: None if the critic is not a plain MLP
    """
    if any(overrides(policy, method) for method in CRITIC_METHODS):
        return None
    return plain_layers(policy, policy.vf_features_extractor, "value_net", policy.value_net)


def plain_layers(
    policy: ActorCriticPolicy, extractor: BaseFeaturesExtractor, net: str, head: th.nn.Module
) -> list[th.nn.Module] | None:
    """
    The layers, if all that a policy does is to apply linear layers, tanh and ReLU to flat observations.

    :param policy: The policy
    :param extractor: Its features extractor
    :param net: Name of the network that follows in the ``MlpExtractor``
    :param head: The last layer
    :return: None if there is anything else on the way, a hook or another ``forward``, or a parameter in two layers
    """
    space, mlp = policy.observation_space, policy.mlp_extractor
    if type(mlp) is not MlpExtractor or not isinstance(space, spaces.Box) or is_image_space(space):
        return None
    body = getattr(mlp, net)
    if type(extractor) is not FlattenExtractor or type(body) is not th.nn.Sequential:
        return None
    layers = [*body, head]
    is_plain = all(is_plain_layer(layer) for layer in layers) and not any(map(is_changed, (extractor, body, *layers)))
    return layers if is_plain and not share_parameters(layers) else None


def is_plain_layer(layer: th.nn.Module) -> bool:
    """
    Whether a layer is one that ``passes`` and ``backpropagation`` know.

    :param layer: Any layer
    """
    return type(layer) in (th.nn.Tanh, th.nn.ReLU) or (type(layer) is th.nn.Linear and layer.bias is not None)


def share_parameters(layers: list[th.nn.Module]) -> bool:
    """
    Whether two layers have a parameter in common.

    :param layers: The layers of a plain MLP
    """
    parameters = parameters_of(layers)
    return len(set(parameters)) < len(parameters)


def is_changed(module: th.nn.Module) -> bool:
    """
    Whether a module does something else than its class and its temperature say.

    :param module: Any module
    """
    own_hooks = [hook for hook in module._forward_hooks.values() if not isinstance(hook, DivideLogits)]
    other_hooks = (module._forward_pre_hooks, module._backward_pre_hooks, module._backward_hooks)
    return any((own_hooks, *other_hooks, "forward" in vars(module)))
