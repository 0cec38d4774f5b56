"""
Several parameter vectors acting side by side: environment i is acted in with vector i, in one forward pass.

Three ways, the fastest that the policy allows: batched matrix products, ``torch.func``, or a loop over copies.
"""

from collections.abc import Sequence
from copy import deepcopy
from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, MlpExtractor, NatureCNN
from stable_baselines3.common.utils import obs_as_tensor
from torch.func import functional_call, vmap

from sb3_reinforce import parameters
from sb3_reinforce.collection import as_env_actions, shift_to_start
from sb3_reinforce.policies import overrides

DISTRIBUTIONS = (BernoulliDistribution, CategoricalDistribution, DiagGaussianDistribution, MultiCategoricalDistribution)
# What an action goes through in ActorCriticPolicy; a policy with its own version of one of them is called as it is
ACTION_METHODS = ("predict", "_predict", "get_distribution", "_get_action_dist_from_latent", "obs_to_tensor")


class MatrixActor:
    """
    Batched matrix products, for actors made of linear layers and activation functions.

    :param policy: The policy, which is not changed
    :param actor: Its parameters that make up θ
    :param n_envs: Number of vectors that act side by side
    :param deterministic: Whether to take the most likely action instead of a sample
    """

    def __init__(
        self, policy: ActorCriticPolicy, actor: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool
    ):
        self.policy, self.actor, self.deterministic = policy, actor, deterministic
        self.stacks = [p.detach().repeat(n_envs, *[1] * p.dim()) for p in actor]
        self._stack_of = {id(p): stack for p, stack in zip(actor, self.stacks, strict=True)}
        self._build(n_envs)

    def _build(self, n_envs: int) -> None:
        """Views of the stacks as matrices that multiply from the right; a frozen layer has one value for all."""

        def stacked(parameter: th.nn.Parameter) -> th.Tensor:
            return self._stack_of.get(id(parameter), parameter.detach().expand(n_envs, *parameter.shape))

        self._layers = [
            (stacked(layer.weight).transpose(1, 2), stacked(layer.bias)[:, None])
            if isinstance(layer, th.nn.Linear)
            else layer
            for layer in layers_of(self.policy)
        ]

    def assign(self, envs: Sequence[int], thetas: th.Tensor) -> None:
        """
        From now on, act with these parameters.

        :param envs: ``m`` environments
        :param thetas: Their parameter vectors, shape ``(m, n)``
        """
        for stack, values in zip(self.stacks, parameters.split(thetas, self.actor), strict=True):
            stack[envs] = values

    @th.inference_mode()
    def act(self, obs: Any) -> np.ndarray:
        """
        The actions of all environments, as the environments take them.

        :param obs: Observations of the environments
        :return: Shape ``(n_envs, *action_space.shape)``
        """
        policy = self.policy
        outputs = self.outputs(obs_as_tensor(obs, policy.device))
        if self.deterministic:
            actions = mode(outputs, policy.action_space)
        elif isinstance(policy.action_dist, DiagGaussianDistribution):
            actions = policy.action_dist.proba_distribution(outputs, policy.log_std).sample()
        else:
            actions = policy.action_dist.proba_distribution(action_logits=outputs).sample()
        space = policy.action_space
        return as_env_actions(policy, actions.cpu().numpy().reshape(-1, *space.shape))  # type: ignore[misc]

    def outputs(self, obs: Any) -> th.Tensor:
        """
        What the action net returns: means or logits.

        :param obs: Observations of the environments, as tensors
        :return: Shape ``(n_envs, n_outputs)``
        """
        x = BasePolicy.extract_features(self.policy, obs, self.policy.pi_features_extractor)[:, None]
        for layer in self._layers:
            x = th.baddbmm(layer[1], x, layer[0]) if isinstance(layer, tuple) else layer(x)
        return x[:, 0]


class VmapActor(MatrixActor):
    """``torch.func``, for actors whose features extractor has parameters: images, and dicts with images."""

    def _build(self, n_envs: int) -> None:
        module = th.nn.Sequential(self.policy.pi_features_extractor, *layers_of(self.policy))
        module.eval()
        values = {name: self._stack_of.get(id(p)) for name, p in module.named_parameters()}
        stacks = {name: stack for name, stack in values.items() if stack is not None}
        rest = {name: p.detach() for name, p in module.named_parameters() if values[name] is None}

        def forward(stacks: dict[str, th.Tensor], obs: Any) -> th.Tensor:
            # One observation at a time: layers see a batch of one
            batch = {key: part[None] for key, part in obs.items()} if isinstance(obs, dict) else obs[None]
            return functional_call(module, {**rest, **stacks}, (batch,))[0]  # type: ignore[no-any-return]

        self._forward = vmap(forward)
        self._named_stacks = stacks

    def outputs(self, obs: Any) -> th.Tensor:
        policy = self.policy
        preprocessed = preprocess_obs(obs, policy.observation_space, normalize_images=policy.normalize_images)
        return self._forward(self._named_stacks, preprocessed)  # type: ignore[no-any-return]


class LoopActor:
    """
    One copy of the policy per environment, each called as ``predict``: for any policy at all.

    :param policy: The policy, which is not changed
    :param actor: Its parameters that make up θ
    :param n_envs: Number of vectors that act side by side
    :param deterministic: Whether to take the most likely action instead of a sample
    """

    def __init__(
        self, policy: ActorCriticPolicy, actor: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool
    ):
        wanted = {id(parameter) for parameter in actor}
        places = [i for i, parameter in enumerate(policy.parameters()) if id(parameter) in wanted]
        self.deterministic = deterministic
        self.copies = [deepcopy(policy) for _ in range(n_envs)]
        self.actors = [[list(copy.parameters())[i] for i in places] for copy in self.copies]

    def assign(self, envs: Sequence[int], thetas: th.Tensor) -> None:
        """As ``MatrixActor.assign``."""
        for env, theta in zip(envs, thetas, strict=True):
            parameters.write(self.actors[env], theta)

    def act(self, obs: Any) -> np.ndarray:
        """As ``MatrixActor.act``."""
        actions = []
        for i, copy in enumerate(self.copies):
            own = {key: part[i : i + 1] for key, part in obs.items()} if isinstance(obs, dict) else obs[i : i + 1]
            actions.append(copy.predict(own, deterministic=self.deterministic)[0])
        return shift_to_start(self.copies[0].action_space, np.concatenate(actions))


Actor: TypeAlias = MatrixActor | VmapActor | LoopActor


def make_actor(
    policy: ActorCriticPolicy, actor: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool
) -> Actor:
    """
    The fastest way to act that gives the actions that the policy would.

    :param policy: The policy
    :param actor: Its parameters that make up θ
    :param n_envs: Number of vectors that act side by side
    :param deterministic: Whether to take the most likely action instead of a sample
    """
    return actor_class(policy)(policy, actor, n_envs, deterministic)


def actor_class(policy: ActorCriticPolicy) -> type[MatrixActor] | type[VmapActor] | type[LoopActor]:
    """
    Which way to act a policy allows.

    :param policy: The policy
    """
    own_code = any(overrides(policy, method) for method in ACTION_METHODS)
    if own_code or type(policy.mlp_extractor) is not MlpExtractor or type(policy.action_dist) not in DISTRIBUTIONS:
        return LoopActor
    layers = layers_of(policy)
    plain = all(type(layer) is th.nn.Linear and layer.bias is not None or not [*layer.parameters()] for layer in layers)
    extractor = policy.pi_features_extractor
    if plain and not list(extractor.parameters()):
        return MatrixActor
    return VmapActor if type(extractor) in (FlattenExtractor, NatureCNN, CombinedExtractor) else LoopActor


def layers_of(policy: ActorCriticPolicy) -> list[th.nn.Module]:
    """
    The layers between the features and the means or logits.

    :param policy: A policy with an ``MlpExtractor``
    """
    return [*policy.mlp_extractor.policy_net, policy.action_net]


def mode(outputs: th.Tensor, space: spaces.Space[Any]) -> th.Tensor:
    """
    The most likely actions, without building a distribution, which would cost as much as the forward pass.

    :param outputs: Means or logits, shape ``(n_envs, n_outputs)``
    :param space: The action space
    :return: Shape ``(n_envs, ...)``
    """
    if isinstance(space, spaces.Discrete):
        return outputs.argmax(1)
    if isinstance(space, spaces.MultiDiscrete):
        parts = outputs.split([int(n) for n in space.nvec.flat], dim=1)
        return th.stack([part.argmax(1) for part in parts], dim=1)
    return (outputs > 0).to(outputs.dtype) if isinstance(space, spaces.MultiBinary) else outputs
