"""Both algorithms, small: what is promised of one is promised of the other."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_reinforce import REINFORCE, FiniteDifference

# One of each kind of update
KINDS: dict[str, tuple[type[BaseAlgorithm], dict[str, Any]]] = {
    "steps": (REINFORCE, {"n_steps": 8}),
    "episodes": (REINFORCE, {"n_episodes": 2, "baseline": "none"}),
    "search": (FiniteDifference, {"n_delta": 2, "estimator": "central", "common_random_numbers": False}),
}
all_kinds = pytest.mark.parametrize("kind", KINDS)
both = pytest.mark.parametrize("kind", ["steps", "search"])
both_extents = pytest.mark.parametrize("kind", ["steps", "episodes"])


def make(kind: str, env: Any = "CartPole-v1", policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    """A small model of a kind."""
    algorithm, arguments = KINDS[kind]
    fixed = {"device": "cpu", "policy_kwargs": {"net_arch": [4]}}
    return algorithm(policy, env, **{**fixed, **arguments, **kwargs})  # type: ignore[call-arg]


def plain(state: Any) -> Any:
    """The numbers of nested states as in ``get_parameters``, to compare them."""
    if isinstance(state, dict):
        return [(str(key), plain(value)) for key, value in sorted(state.items(), key=lambda item: str(item[0]))]
    if isinstance(state, (list, tuple)):
        return [plain(value) for value in state]
    return state.numpy().tobytes() if isinstance(state, th.Tensor) else repr(state)


def moved_by_learning(model: Any, total_timesteps: int) -> set[str]:
    """The names of the policy's parameters that training changes."""
    before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
    model.learn(total_timesteps)
    return {name for name, parameter in model.policy.named_parameters() if not th.equal(parameter, before[name])}


class Threshold(th.nn.Module):
    """An activation without a derivative."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        return (x > 0).float()


class OwnPrediction(ActorCriticPolicy):
    """Code of the user's, which only the policy itself can run."""

    def _predict(self, observation, deterministic=False):  # type: ignore[no-untyped-def]
        return super()._predict(observation, deterministic)


class FromDistribution(ActorCriticPolicy):
    """Takes everything from ``get_distribution`` and ``predict_values``."""

    def forward(self, obs, deterministic=False):  # type: ignore[no-untyped-def]
        distribution = self.get_distribution(obs)
        actions = distribution.get_actions(deterministic=deterministic)
        return actions, self.predict_values(obs), distribution.log_prob(actions)

    def evaluate_actions(self, obs, actions):  # type: ignore[no-untyped-def]
        distribution = self.get_distribution(obs)
        return self.predict_values(obs), distribution.log_prob(actions), distribution.entropy()


class Double(FlattenExtractor):
    """Stable-Baselines3 hands observations on in float32; from here on all is float64."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return super().forward(observations).double()


@contextmanager
def float64() -> Iterator[None]:
    """Policies that are made in the block have parameters in float64."""
    th.set_default_dtype(th.float64)
    try:
        yield
    finally:
        th.set_default_dtype(th.float32)


class Experts(FlattenExtractor):
    """A network for each step of a Corridor, which sees its own rows only."""

    def __init__(self, space: spaces.Space[Any]):
        super().__init__(space)
        self.experts = th.nn.ModuleList(th.nn.Linear(self.features_dim, self.features_dim) for _ in range(2))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = super().forward(observations)
        outputs = th.zeros_like(features)
        for t, expert in enumerate(self.experts):
            rows = features[:, t] == 1
            if rows.any():
                outputs[rows] = expert(features[rows])
        return outputs


class Normalized(FlattenExtractor):
    """Features that are normalized by their batch in training mode."""

    def __init__(self, space: spaces.Space[Any]):
        super().__init__(space)
        self.norm = th.nn.BatchNorm1d(self.features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        normalized: th.Tensor = self.norm(super().forward(observations))
        return normalized


class Scaled(FlattenExtractor):
    """A user's features extractor with a parameter, which a policy that shares it knows by three names."""

    def __init__(self, space: spaces.Space[Any]):
        super().__init__(space)
        self.scale = th.nn.Parameter(th.ones(self.features_dim))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.scale * super().forward(observations)


class Dropping(FlattenExtractor):
    """Flat observations, of which training mode drops half."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return th.nn.functional.dropout(super().forward(observations), 0.5, self.training)
