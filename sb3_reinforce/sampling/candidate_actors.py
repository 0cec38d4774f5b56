"""
Several parameter vectors acting side by side: vector i in environment i.

Plain actors act together, by batched matrix products; any other policy acts in one environment after the other.
"""

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.interruptions import uninterrupted
from sb3_reinforce.common.spaces import env_actions_of, shift_to_start
from sb3_reinforce.common.tensors import take, to_vector
from sb3_reinforce.policies import parameters
from sb3_reinforce.policies.evaluation import distribution_of, extract_features
from sb3_reinforce.policies.masks import sizes_of
from sb3_reinforce.policies.plain_mlp import plain_actor, takes_vectors, temperature_hook


class LoopActor:
    """Calls ``predict`` in one environment after the other; candidates are written to the policy for the call only."""

    # A deep copy would not do: hooks and replaced methods may refer to the policy that they were made for, and policies
    # that hold a graph, as with gSDE, cannot be copied

    def __init__(
        self, policy: ActorCriticPolicy, searched: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool
    ):
        self.policy = policy
        self.searched = searched
        self.deterministic = deterministic
        # On the device and in the type of the parameters, which matters for large networks
        self.thetas = to_vector(searched).repeat(n_envs, 1)

    def assign(self, envs: Sequence[int], thetas: th.Tensor) -> None:
        """From now on, act with candidates of shape ``(m, n)`` in ``m`` environments."""
        self.thetas[envs] = thetas.to(self.thetas)

    @uninterrupted
    def act(self, obs: Any) -> np.ndarray:
        """The actions in all environments, shape ``(n_envs, *action_space.shape)``, as the environments take them."""
        actions = []
        with parameters.restored(self.searched):
            for i, theta in enumerate(self.thetas):
                parameters.write(self.searched, theta)
                if self.policy.use_sde and not self.deterministic:
                    # Else all episodes would share the noise that the last rollout has left
                    self.policy.reset_noise()
                action, _ = self.policy.predict(take(obs, slice(i, i + 1)), deterministic=self.deterministic)
                actions.append(action)
        return shift_to_start(self.policy.action_space, np.concatenate(actions))


class MatrixActor:
    """Batched matrix products, for the layers of a plain actor."""

    def __init__(
        self,
        policy: ActorCriticPolicy,
        layers: Sequence[th.nn.Module],
        searched: Sequence[th.nn.Parameter],
        n_envs: int,
        deterministic: bool,
    ):
        self.policy = policy
        self.searched = searched
        self.deterministic = deterministic
        self.device = policy.device
        self.as_env_actions = env_actions_of(policy)
        # Asked once: both take longer than the products
        self.takes_vectors = takes_vectors(policy, policy.pi_features_extractor)
        self.temperature = temperature_hook(layers[-1])

        def stacked(parameter: th.Tensor) -> th.Tensor:
            """The values for each environment, matrices transposed in memory, which halves the price of a product."""
            values = parameter.detach()
            return values.mT.repeat(n_envs, 1, 1).mT if values.dim() == 2 else values.repeat(n_envs, 1)

        # Frozen parameters too, with the same values in all environments
        stacks: dict[th.Tensor, th.Tensor] = {each: stacked(each) for layer in layers for each in layer.parameters()}
        self.stacks = [stacks[parameter] for parameter in searched]
        self.operations = [
            (stacks[layer.weight].mT, stacks[layer.bias][:, None]) if isinstance(layer, th.nn.Linear) else layer
            for layer in layers
        ]

    def assign(self, envs: Sequence[int], thetas: th.Tensor) -> None:
        for stack, values in zip(self.stacks, parameters.split(thetas, self.searched), strict=True):
            stack[envs] = values

    def act(self, obs: Any) -> np.ndarray:
        outputs = self.outputs(obs)
        if self.deterministic:
            actions = mode(outputs, self.policy.action_space)
        else:
            with th.no_grad():
                actions = distribution_of(self.policy, outputs).sample()
        shape: Any = self.policy.action_space.shape
        return self.as_env_actions(actions.cpu().numpy().reshape(-1, *shape))

    def outputs(self, obs: Any) -> th.Tensor:
        """Means or logits, shape ``(n_envs, n_outputs)``, without a graph, since the stacks require no gradient."""
        obs = obs_as_tensor(obs, self.device)
        if self.takes_vectors:
            x = obs.flatten(1).float()
        else:
            x = extract_features(self.policy, obs, self.policy.pi_features_extractor)
        x = x.unsqueeze(1)
        for operation in self.operations:
            if isinstance(operation, tuple):
                weight, bias = operation
                x = th.baddbmm(bias, x, weight)
            else:
                x = operation(x)
        x = x.squeeze(1)
        return x if self.temperature is None else self.temperature(self.policy.action_net, (), x)


# Acts in environment i with the i-th of ``n_envs`` candidates
CandidateActor: TypeAlias = LoopActor | MatrixActor


def make_candidate_actor(
    policy: ActorCriticPolicy, searched: Sequence[th.nn.Parameter], n_envs: int, deterministic: bool
) -> CandidateActor:
    """The faster of the two actors that takes the actions which the policy would take."""
    layers = plain_actor(policy)
    if layers is None:
        return LoopActor(policy, searched, n_envs, deterministic)
    return MatrixActor(policy, layers, searched, n_envs, deterministic)


def mode(outputs: th.Tensor, space: spaces.Space[Any]) -> th.Tensor:
    """The most likely actions for means or logits of shape ``(n, n_outputs)``, without the price of a distribution."""
    if isinstance(space, spaces.Discrete):
        return outputs.argmax(1)
    if isinstance(space, spaces.MultiDiscrete):
        parts = th.split(outputs, sizes_of(space), dim=1)
        return th.stack([part.argmax(1) for part in parts], dim=1)
    return (outputs > 0).to(outputs.dtype) if isinstance(space, spaces.MultiBinary) else outputs
