"""θ as a vector: the actor's parameters, all of them and no others, with nothing lost on the way."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from models import Normalized, Threshold
from stable_baselines3.common.policies import ActorCriticCnnPolicy, ActorCriticPolicy

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.policies import parameters
from sb3_reinforce.policies.linear import LinearPolicy

OBS, ACTIONS = spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,))


def make(policy_class: type[ActorCriticPolicy], obs: spaces.Space = OBS, **kwargs: object) -> ActorCriticPolicy:
    return policy_class(obs, ACTIONS, lambda _: 1e-3, **kwargs)


def names(policy: ActorCriticPolicy) -> set[str]:
    actor = {id(parameter) for parameter in parameters.searched_parameters(policy)}
    return {name for name, parameter in policy.named_parameters() if id(parameter) in actor}


def test_theta_is_the_actor_without_critic_and_log_std() -> None:
    assert names(make(LinearPolicy)) == {"action_net.weight"}
    mlp = names(make(ActorCriticPolicy))
    layers = ("mlp_extractor.policy_net.0", "mlp_extractor.policy_net.2", "action_net")
    assert mlp == {f"{layer}.{part}" for layer in layers for part in ("weight", "bias")}


def test_a_shared_features_extractor_is_part_of_the_actor() -> None:
    policy = make(ActorCriticCnnPolicy, spaces.Box(0, 255, (3, 36, 36), np.uint8))
    extractor = {name for name, _ in policy.named_parameters() if name.startswith("features_extractor")}
    assert extractor and extractor < names(policy)
    assert not any("value" in name for name in names(policy))


class NoGradient(ActorCriticPolicy):
    """A policy whose log π has no derivative at all."""

    def get_distribution(self, obs):
        with th.no_grad():
            return super().get_distribution(obs)


class ByHand(NoGradient):
    """A policy that computes its actions itself, from transposed parameters and from a list of them."""

    def _predict(self, observation, deterministic=False):
        hidden = observation @ self.mlp_extractor.policy_net[0].weight.T > self.mlp_extractor.policy_net[0].bias
        layer = th.cat([self.action_net.weight, self.action_net.bias[:, None]], dim=1)
        return (th.nn.functional.pad(hidden.float(), (0, 1), value=1.0) @ layer.T).argmax(1)


class WithUnusedLayer(NoGradient):
    """A policy with a layer that no action depends on, and without a critic."""

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        self.unused = th.nn.Linear(4, 4)

    def _build(self, lr_schedule) -> None:
        super()._build(lr_schedule)
        del self.value_net, self.mlp_extractor.value_net


@pytest.mark.parametrize(
    "policy_class, activation",
    [(ActorCriticPolicy, Threshold), (NoGradient, th.nn.Tanh), (WithUnusedLayer, th.nn.Tanh), (ByHand, Threshold)],
)
def test_a_policy_without_derivatives_is_searched(policy_class: type[ActorCriticPolicy], activation: type) -> None:
    kwargs = {"net_arch": [4], "activation_fn": activation}
    model = FiniteDifference(policy_class, "CartPole-v1", estimator="central", seed=0, policy_kwargs=kwargs)
    layers = ("mlp_extractor.policy_net.0", "action_net")
    assert names(model.policy) == {f"{layer}.{part}" for layer in layers for part in ("weight", "bias")}
    hidden = model.policy.mlp_extractor.policy_net[0].weight
    before = hidden.detach().clone()
    model.learn(1)
    assert not th.equal(hidden, before)


def test_read_and_write_are_an_exact_round_trip() -> None:
    policy = make(ActorCriticPolicy)
    actor = parameters.searched_parameters(policy)
    before, theta = policy.state_dict(), parameters.read(actor)
    before = {name: value.clone() for name, value in before.items()}
    assert theta.dtype == th.float64 and theta.shape == (sum(p.numel() for p in actor),)
    parameters.write(actor, th.zeros_like(theta))
    assert all((p == 0).all() for p in actor)
    assert th.equal(policy.value_net.weight, before["value_net.weight"])
    parameters.write(actor, theta)
    assert all(th.equal(value, before[name]) for name, value in policy.state_dict().items())


def test_an_actor_without_trainable_parameters_is_an_error() -> None:
    policy = make(LinearPolicy)
    policy.action_net.requires_grad_(False)
    with pytest.raises(ValueError, match="no trainable parameters"):
        parameters.searched_parameters(policy)


def test_linear_policy_refuses_hidden_layers() -> None:
    for net_arch in ([8], {"pi": [], "vf": [8]}):
        with pytest.raises(ValueError, match="no hidden layers"):
            make(LinearPolicy, net_arch=net_arch)
    assert names(make(LinearPolicy, net_arch={"pi": [], "vf": []})) == {"action_net.weight"}


@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_parameters_move_between_the_algorithms(env_id: str) -> None:
    reinforce = REINFORCE("MlpPolicy", env_id, seed=0)
    search = FiniteDifference("MlpPolicy", env_id, estimator="central", n_delta=1, seed=1)
    obs = gym.make(env_id).observation_space.sample()

    def actions() -> list[np.ndarray]:
        return [model.predict(obs, deterministic=True)[0] for model in (reinforce, search)]

    search.set_parameters(reinforce.get_parameters(), exact_match=False)
    assert np.array_equal(*actions())
    assert th.equal(search.theta, parameters.read(parameters.searched_parameters(reinforce.policy)))
    search.learn(1)
    reinforce.set_parameters(search.get_parameters(), exact_match=False)
    assert np.array_equal(*actions())


@pytest.mark.parametrize("ortho_init", [True, False])
def test_the_bias_of_a_linear_policy_is_0(ortho_init: bool) -> None:
    policy = make(LinearPolicy, ortho_init=ortho_init)
    assert not policy.action_net.bias.any() and not policy.action_net.bias.requires_grad


@pytest.mark.parametrize("mode", [True, False])
def test_what_is_searched_is_read_in_evaluation_mode_and_the_mode_stays(mode):
    """In training mode BatchNorm takes no single observation."""
    policy = make(ActorCriticPolicy, features_extractor_class=Normalized, net_arch=[4])
    policy.set_training_mode(mode)
    parts = (policy.features_extractor, policy.mlp_extractor.policy_net, policy.action_net)
    expected = {parameter for part in parts for parameter in part.parameters()}
    assert set(parameters.searched_parameters(policy)) == expected and policy.training == mode
