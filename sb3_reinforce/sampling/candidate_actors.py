"""
Several parameter vectors acting side by side: environment i is acted in with vector i, in one forward pass.

Three ways, the fastest that the policy allows: batched matrix products, ``torch.func``, or a loop over environments.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, MlpExtractor, NatureCNN
from stable_baselines3.common.utils import obs_as_tensor
from torch.func import functional_call, vmap

from sb3_reinforce.common.spaces import env_actions_of, shift_to_start
from sb3_reinforce.policies import parameters
from sb3_reinforce.policies.plain_mlp import DISTRIBUTIONS, overrides

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

    def __init__(self, policy: ActorCriticPolicy, actor: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool):
        self.policy, self.actor, self.deterministic, self.device = policy, actor, deterministic, policy.device
        self._as_env_actions = env_actions_of(policy, n_envs)
        # Matrices lie in memory as they are multiplied, transposed, which halves the price of a product
        self.stacks = [p.detach().mT.repeat(n_envs, 1, 1).mT if p.dim() == 2 else repeated(p, n_envs) for p in actor]
        self._stack_of = {id(p): stack for p, stack in zip(actor, self.stacks, strict=True)}
        self._build(n_envs)

    def _build(self, n_envs: int) -> None:
        """Views of the stacks as matrices that multiply from the right; a frozen layer has one value for all."""

        def stacked(parameter: th.Tensor) -> th.Tensor:
            return self._stack_of.get(id(parameter), repeated(parameter, n_envs))

        self._layers = [
            (stacked(layer.weight).mT, stacked(layer.bias)[:, None]) if isinstance(layer, th.nn.Linear) else layer
            for layer in layers_of(self.policy)
        ]
        space, extractor = self.policy.observation_space, self.policy.pi_features_extractor
        self._is_vector = (
            isinstance(space, spaces.Box) and len(space.shape) == 1 and type(extractor) is FlattenExtractor
        )

    def assign(self, envs: Sequence[int], thetas: th.Tensor) -> None:
        """
        From now on, act with these parameters.

        :param envs: ``m`` environments
        :param thetas: Their parameter vectors, shape ``(m, n)``
        """
        for stack, values in zip(self.stacks, parameters.split(thetas, self.actor), strict=True):
            stack[envs] = values

    def act(self, obs: Any) -> np.ndarray:
        """
        The actions of all environments, as the environments take them.

        :param obs: Observations of the environments
        :return: Shape ``(n_envs, *action_space.shape)``
        """
        policy = self.policy
        # No gradient is recorded: the stacks are no leaves of a graph
        outputs = self.outputs(obs)
        if self.deterministic:
            actions = mode(outputs, policy.action_space)
        elif isinstance(policy.action_dist, DiagGaussianDistribution):
            actions = policy.action_dist.proba_distribution(outputs, policy.log_std.detach()).sample()
        else:
            actions = policy.action_dist.proba_distribution(action_logits=outputs).sample()
        space = policy.action_space
        return self._as_env_actions(actions.cpu().numpy().reshape(-1, *space.shape))  # type: ignore[misc]

    def _features(self, obs: Any) -> th.Tensor:
        if self._is_vector:
            # What the lines below do to vectors, for a tenth of their price
            return th.from_numpy(obs).to(self.device, th.float32)
        obs = obs_as_tensor(obs, self.device)
        return BasePolicy.extract_features(self.policy, obs, self.policy.pi_features_extractor)

    def outputs(self, obs: Any) -> th.Tensor:
        """
        What the action net returns: means or logits.

        :param obs: Observations of the environments
        :return: Shape ``(n_envs, n_outputs)``
        """
        x = self._features(obs)[:, None]
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
        obs = obs_as_tensor(obs, self.device)
        preprocessed = preprocess_obs(obs, policy.observation_space, normalize_images=policy.normalize_images)
        return self._forward(self._named_stacks, preprocessed)


class Predict(th.nn.Module):
    """
    ``predict`` as a module, so that ``torch.func`` can call it with other parameters and put back the policy's own.

    :param policy: The policy
    :param deterministic: Whether to take the most likely action instead of a sample
    """

    def __init__(self, policy: ActorCriticPolicy, deterministic: bool):
        super().__init__()
        self.policy, self.deterministic = policy, deterministic

    def forward(self, obs: Any) -> np.ndarray:
        return self.policy.predict(obs, deterministic=self.deterministic)[0]


class LoopActor(MatrixActor):
    """The policy's own ``predict``, called for one environment after the other: for any policy at all."""

    def _build(self, n_envs: int) -> None:
        self._predict = Predict(self.policy, self.deterministic)
        names = {id(parameter): name for name, parameter in self._predict.named_parameters()}
        self._named_stacks = {names[id(p)]: stack for p, stack in zip(self.actor, self.stacks, strict=True)}

    def act(self, obs: Any) -> np.ndarray:
        actions = []
        for i in range(len(self.stacks[0])):
            own = {key: part[i : i + 1] for key, part in obs.items()} if isinstance(obs, dict) else obs[i : i + 1]
            values = {name: stack[i] for name, stack in self._named_stacks.items()}
            actions.append(functional_call(self._predict, values, (own,)))
        return shift_to_start(self.policy.action_space, np.concatenate(actions))


def make_actor(
    policy: ActorCriticPolicy, actor: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool
) -> MatrixActor:
    """
    The fastest way to act that gives the actions that the policy would.

    :param policy: The policy
    :param actor: Its parameters that make up θ
    :param n_envs: Number of vectors that act side by side
    :param deterministic: Whether to take the most likely action instead of a sample
    """
    return actor_class(policy)(policy, actor, n_envs, deterministic)


def actor_class(policy: ActorCriticPolicy) -> type[MatrixActor]:
    """
    Which way to act a policy allows.

    :param policy: The policy
    """
    own_code = any(overrides(policy, method) for method in ACTION_METHODS)
    if own_code or type(policy.mlp_extractor) is not MlpExtractor or type(policy.action_dist) not in DISTRIBUTIONS:
        return LoopActor
    # A temperature is a hook
    plain = all(
        (layer.bias is not None if type(layer) is th.nn.Linear else not list(layer.parameters()))
        and not layer._forward_hooks
        for layer in layers_of(policy)
    )
    extractor = policy.pi_features_extractor
    if plain and not list(extractor.parameters()):
        return MatrixActor
    return VmapActor if type(extractor) in (FlattenExtractor, NatureCNN, CombinedExtractor) else LoopActor


def repeated(parameter: th.Tensor, n_envs: int) -> th.Tensor:
    """
    The same values for every environment.

    :param parameter: The values
    :param n_envs: Number of environments
    :return: Shape ``(n_envs, *parameter.shape)``
    """
    return parameter.detach().expand(n_envs, *parameter.shape).clone()


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
        parts = th.split(outputs, [int(n) for n in space.nvec.flat], dim=1)
        return th.stack([part.argmax(1) for part in parts], dim=1)
    return (outputs > 0).to(outputs.dtype) if isinstance(space, spaces.MultiBinary) else outputs
