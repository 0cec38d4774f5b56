"""The natural step: the direction F⁻¹ g, without damping invariant to the parametrization, as long as KL allows."""

from contextlib import nullcontext
from copy import copy, deepcopy
from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from enumeration import make_model
from environments import Corridor
from gymnasium import spaces
from models import Dropping, Normalized, make
from sb3_contrib.common.envs import InvalidActionEnvMultiDiscrete
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.distributions import kl_divergence

from sb3_reinforce import REINFORCE, ActionMaskObservation, MaskedPolicy
from sb3_reinforce.common.tensors import select, to_vector
from sb3_reinforce.estimation import BASELINES
from sb3_reinforce.policies import natural
from sb3_reinforce.policies.evaluation import action_distribution
from sb3_reinforce.policies.natural import conjugate_gradients, line_search, natural_step
from sb3_reinforce.recurrent import RecurrentREINFORCE

# The states of the tree, as often as a rollout might visit them
OBS = th.eye(3)[[0, 0, 0, 1, 2, 2]]


def fisher(policy, obs):
    """Σ_s Σ_a π(a|s) ψψᵀ / n with the scores ψ of the weights."""
    weight = policy.action_net.weight
    total = 0.0
    for row in obs:
        log_probs = policy.get_distribution(row[None]).distribution.logits[0]
        scores = [th.autograd.grad(each, weight, retain_graph=True)[0].flatten() for each in log_probs]
        total = total + sum(each.exp().detach() * th.outer(s, s) for each, s in zip(log_probs, scores, strict=True))
    return total / len(obs)


def gradient_in_range(policy, obs):
    """The gradient of a loss of the usual form, ``−Σ w log π``."""
    log_probs = policy.get_distribution(obs).distribution.logits
    weights = th.linspace(-1, 2, 2 * len(obs), dtype=th.float64).reshape(-1, 2)
    return th.autograd.grad(-(weights * log_probs).sum(), policy.action_net.weight)


def test_a_system_is_solved_in_ten_iterations_of_conjugate_gradients():
    """x minimizes the error over the Krylov space of dimension ten, to which the residual is orthogonal."""
    a = th.diag(th.linspace(1, 4, 12, dtype=th.float64))
    b = th.linspace(-1, 2, 12, dtype=th.float64)
    x = conjugate_gradients(lambda v: a @ v, b)
    krylov = th.linalg.qr(th.stack([th.linalg.matrix_power(a, i) @ b for i in range(10)], dim=1)).Q
    residual = b - a @ x
    assert (krylov.T @ residual).norm() < 1e-8 * b.norm() and (x - krylov @ (krylov.T @ x)).norm() < 1e-8 * x.norm()
    assert residual.norm() > 1e-7 * b.norm()


@pytest.mark.parametrize(("excess", "length"), [(1.19, 2.0), (1.21, 2.0 / 1.21**0.5)])
def test_a_step_beyond_one_fifth_more_than_the_target_is_shortened(excess, length):
    parameter = th.nn.Parameter(th.zeros(1, dtype=th.float64))
    kl = line_search([parameter], th.ones(1), 2.0, lambda: excess * 0.01 * (parameter / 2) ** 2, 0.01)
    assert parameter.item() == pytest.approx(-length)
    assert kl == pytest.approx(excess * 0.01 if length == 2 else 0.01)


@pytest.mark.parametrize("damping", [0.0, 0.1])
def test_the_direction_is_the_gradient_times_the_inverse_fisher_information(damping, monkeypatch):
    if damping == 0:
        monkeypatch.setattr(natural, "DAMPING", 0.0)
    policy = make_model().policy
    weight = policy.action_net.weight
    gradients = gradient_in_range(policy, OBS)
    # A table of logits has as many directions without effect as states
    matrix = fisher(policy, OBS) + damping * th.eye(6, dtype=th.float64)
    expected = -th.linalg.pinv(matrix) @ gradients[0].flatten()
    before = to_vector([weight])
    natural_step(policy, OBS, [weight], gradients, 0.01)
    moved = to_vector([weight]) - before
    th.testing.assert_close(moved / moved.norm(), expected / expected.norm(), rtol=0, atol=1e-8)


def test_the_step_does_not_depend_on_the_parametrization(monkeypatch):
    """Features M x and weights W M⁻¹ are the same policy; so they are after the step, but not after a plain one."""
    monkeypatch.setattr(natural, "DAMPING", 0.0)
    mix = th.tensor([[2.0, 0.3, 0.0], [-0.5, 0.4, 1.0], [0.1, 0.0, 5.0]])
    logits = {}
    for is_natural in (True, False):
        for name, features in {"x": OBS, "M x": OBS @ mix.T}.items():
            policy = make_model().policy
            weight = policy.action_net.weight
            if name == "M x":
                with th.no_grad():
                    weight.copy_(weight @ th.linalg.inv(mix.double()))
            gradients = gradient_in_range(policy, features)
            if is_natural:
                natural_step(policy, features, [weight], gradients, 0.01)
            else:
                with th.no_grad():
                    weight -= 0.1 * gradients[0]
            logits[is_natural, name] = policy.get_distribution(features).distribution.logits.detach()
    th.testing.assert_close(logits[True, "x"], logits[True, "M x"], rtol=0, atol=1e-6)
    assert (logits[False, "x"] - logits[False, "M x"]).abs().max() > 0.01


class Divergences(BaseCallback):
    """Measures how far each update moves the policy: KL(π_before ‖ π_after) at the states of its rollout."""

    def __init__(self):
        super().__init__()
        self.found = []
        self.logged = []
        self.before = None

    def _on_step(self):
        return True

    def measure(self):
        if self.before is not None:
            policy = self.model.policy
            before, obs, actions = self.before
            after = deepcopy(policy.state_dict())
            with th.no_grad():
                new = copy(action_distribution(policy, obs))
                policy.load_state_dict(before)
                old = action_distribution(policy, obs)
            kl = 0.0
            for p, q in zip(independent(old), independent(new), strict=True):
                kl = kl + kl_divergence(p, q).reshape(len(actions), -1).sum(1)
            policy.load_state_dict(after)
            self.found.append(float(kl.mean()))
            self.logged.append(self.model.logger.name_to_value["train/kl"])

    _on_rollout_start = _on_training_end = measure

    def _on_rollout_end(self):
        rollout = self.model.rollout
        obs = select(rollout.inputs, rollout.used)
        self.before = deepcopy(self.model.policy.state_dict()), obs, select(rollout.actions, rollout.used)


def independent(distribution):
    """The distributions of PyTorch whose product it is."""
    inner = distribution.distribution
    return inner if isinstance(inner, list) else [inner]


class Unknown(DiagGaussianDistribution):
    """A distribution of the user's, whose KL divergence nobody knows."""

    def proba_distribution(self, *args):
        super().proba_distribution(*args)
        self.distribution = [self.distribution]
        return self

    def log_prob(self, actions):
        return self.distribution[0].log_prob(actions).sum(1)

    def entropy(self):
        return self.distribution[0].entropy().sum(1)

    def sample(self):
        return self.distribution[0].sample()


def test_a_distribution_without_a_known_divergence_is_named():
    model = REINFORCE("MlpPolicy", "Pendulum-v1", step="natural", n_steps=8)
    model.policy.action_dist = Unknown(1)
    model.policy.get_distribution = lambda obs: Unknown(1).proba_distribution(
        model.policy.action_net(obs[:, :1].repeat(1, 64)), model.policy.log_std
    )
    with pytest.raises(ValueError, match="a KL divergence that PyTorch knows, and Unknown of ActorCriticPolicy"):
        model.learn(8)


def test_the_gradient_of_the_loss_is_left_for_a_callback():
    gradients = []
    for step in ("optimizer", "natural"):
        model = make("steps", step=step, max_grad_norm=None, seed=0).learn(8)
        actor = [each for name, each in model.policy.named_parameters() if "value_net" not in name]
        gradients.append(to_vector([each.grad for each in actor]))
    assert gradients[0].any()
    th.testing.assert_close(*gradients)


def divergences_of(model, total_timesteps):
    callback = Divergences()
    model.learn(total_timesteps, callback, log_interval=None)
    np.testing.assert_allclose(callback.logged, callback.found, rtol=1e-3, atol=1e-6)
    return np.array(callback.found)


@pytest.mark.parametrize(
    ("env_id", "target_kl"), [("CartPole-v1", None), ("Pendulum-v1", None), ("Pendulum-v1", 0.003)]
)
def test_the_measured_divergence_is_the_target(env_id, target_kl, monkeypatch):
    """And the first length that is tried has it."""
    measured = Mock(side_effect=natural.measured)
    monkeypatch.setattr(natural, "measured", measured)
    env = make_vec_env(env_id, 8, seed=0)
    model = REINFORCE("MlpPolicy", env, step="natural", target_kl=target_kl, n_steps=128, seed=0)
    found = divergences_of(model, 4 * 1024)
    assert len(found) == measured.call_count == 4
    np.testing.assert_allclose(found, target_kl or 0.01, rtol=0.2)


def sums(action_space):
    return Corridor((5,), lambda t, action: float(np.sum(action)), action_space)


BOX = spaces.Box(-1, 1, (2,))
MASKED = InvalidActionEnvMultiDiscrete([3, 4], n_invalid_actions=3)
MODELS = {
    "Discrete": ("MlpPolicy", sums(spaces.Discrete(3, start=1)), {}),
    "MultiDiscrete": ("MlpPolicy", sums(spaces.MultiDiscrete([2, 3])), {}),
    "MultiBinary": ("MlpPolicy", sums(spaces.MultiBinary(4)), {}),
    "gSDE": ("MlpPolicy", sums(BOX), {"use_sde": True}),
    "squashed": ("MlpPolicy", sums(BOX), {"use_sde": True, "policy_kwargs": {"squash_output": True}}),
    "images": ("CnnPolicy", FakeImageEnv(screen_height=40, screen_width=40), {}),
    "masks": (MaskedPolicy, ActionMaskObservation(MASKED), {}),
    "memory": ("MlpLstmPolicy", sums(spaces.Discrete(3)), {}),
}


@pytest.mark.parametrize("name", MODELS)
def test_every_kind_of_policy_takes_it(name):
    policy, env, kwargs = MODELS[name]
    algorithm = RecurrentREINFORCE if name == "memory" else REINFORCE
    model = algorithm(policy, env, step="natural", n_steps=40, seed=0, **kwargs)
    before = to_vector(model.policy.parameters())
    found = divergences_of(model, 120)
    assert len(found) == 3
    assert (found > 0.5 * 0.01).all() and (found <= 1.2 * 0.01).all()
    assert not th.equal(to_vector(model.policy.parameters()), before)


class Attention(FlattenExtractor):
    """Attention between the features of an observation's numbers."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self._features_dim *= 16
        self.embed = th.nn.Linear(1, 16)
        self.attention = th.nn.MultiheadAttention(16, 2, batch_first=True)

    def forward(self, observations):
        parts = self.embed(super().forward(observations)[..., None])
        return self.attention(parts, parts, parts, need_weights=False)[0].flatten(1)


def test_attention_takes_it():
    """PyTorch's fused kernel has no second derivative."""
    kwargs = {"features_extractor_class": Attention}
    model = REINFORCE("MlpPolicy", sums(BOX), step="natural", n_steps=64, seed=0, policy_kwargs=kwargs)
    found = divergences_of(model, 128)
    assert (found > 0).all() and (found <= 1.2 * 0.01).all()


@pytest.mark.parametrize("baseline", BASELINES)
@pytest.mark.parametrize("rollout", [{"n_steps": 20}, {"n_episodes": 12, "reward_to_go": False}], ids=str)
def test_every_baseline_and_rollout_takes_it(baseline, rollout):
    env = DummyVecEnv([lambda: sums(BOX)] * 4)
    model = REINFORCE("MlpPolicy", env, step="natural", baseline=baseline, gamma=0.9, seed=0, **rollout)
    found = divergences_of(model, 120)
    assert len(found) >= 2
    np.testing.assert_allclose(found, 0.01, rtol=0.2)


def test_the_entropy_bonus_is_part_of_its_direction():
    changes = []
    for ent_coef in (0.0, 100.0):
        model = make("steps", n_steps=64, step="natural", ent_coef=ent_coef, seed=0)
        with th.no_grad():
            model.policy.action_net.bias[0] = 2.0
            obs = th.as_tensor(model.env.reset())
            before = model.policy.get_distribution(obs).entropy()
        model.learn(64)
        assert model.logger.name_to_value["train/grad_norm"] > 0
        with th.no_grad():
            changes.append(float(model.policy.get_distribution(obs).entropy() - before))
    # A step of that divergence along the entropy alone raises it by about √(2 · 0.01 Var log π)
    assert changes[1] > 0.05 and changes[1] > changes[0] + 0.01


def test_where_no_step_is_possible_the_parameters_stay():
    policy = make_model().policy
    weight = policy.action_net.weight
    before = weight.detach().clone()
    with pytest.raises(ValueError, match="gradient of the policy is not finite"):
        natural_step(policy, OBS, [weight], [th.full_like(weight, th.nan)], 0.01)
    assert natural_step(policy, OBS, [weight], [th.zeros_like(weight)], 0.01) == (0.0, 0.0)
    assert th.equal(weight, before)
    with th.no_grad():
        # No action but the first one has a probability, so that no small step changes the policy
        weight.copy_(th.tensor([[1e4], [-1e4]]))
    before = weight.detach().clone()
    with pytest.warns(UserWarning, match="natural step is left out"):
        natural_step(policy, OBS, [weight], [th.ones_like(weight)], 0.01)
    # Also in a copy, which could not be made where a graph is left
    assert th.equal(deepcopy(policy).action_net.weight, before)


@pytest.mark.parametrize("answer", [np.inf, np.nan, ValueError("not finite"), MemoryError()], ids=repr)
def test_a_step_that_cannot_be_measured_is_taken_back(answer):
    weight = th.nn.Parameter(th.ones(3))
    divergence = Mock(side_effect=answer if isinstance(answer, Exception) else lambda: th.tensor(answer))
    with pytest.raises(MemoryError) if isinstance(answer, MemoryError) else nullcontext():
        assert line_search([weight], th.ones(3), 1.0, divergence, 0.01) is None
    assert th.equal(weight, th.ones(3))


@pytest.mark.parametrize("matrix", [th.diag(th.tensor([1.0, -1.0])), th.full((2, 2), th.nan)])
def test_an_indefinite_system_has_no_direction(matrix):
    assert not conjugate_gradients(lambda v: matrix @ v, th.tensor([1.0, 0.5])).any()


def test_a_step_that_is_far_too_long_is_not_shortened_to_nothing():
    """The divergence of a policy that is almost deterministic grows faster than the square of the step."""
    weight = th.nn.Parameter(th.zeros(1))
    kl = line_search([weight], th.ones(1), 10.0, lambda: (weight**8).sum(), 0.01)
    assert 0.01 / 2**8 <= kl <= 0.012


class OwnEntropy(ActorCriticPolicy):
    """Adds a parameter to the entropy, on which the distribution does not depend, and has one without any use."""

    def _build(self, lr_schedule):
        self.bonus = th.nn.Parameter(th.zeros(()))
        self.unused = th.nn.Parameter(th.zeros(()))
        super()._build(lr_schedule)

    def evaluate_actions(self, obs, actions):
        values, log_prob, entropy = super().evaluate_actions(obs, actions)
        return values, log_prob, entropy + self.bonus


def test_parameters_on_which_the_distribution_does_not_depend():
    model = make("steps", Corridor(), OwnEntropy, step="natural", ent_coef=0.01).learn(32)
    assert model.policy.bonus > 0 and model.logger.name_to_value["train/kl"] > 0
    model.policy.optimizer = th.optim.Adam([*model.policy.value_net.parameters(), model.policy.unused])
    assert dict(model.learn(32).logger.name_to_value)["train/grad_norm"] == 0


class OtherFeatures(ActorCriticPolicy):
    """Learns from other features than ``get_distribution`` sees."""

    def extract_features(self, obs, features_extractor=None):
        return 5 * super().extract_features(obs, features_extractor)

    def get_distribution(self, obs):
        return super().get_distribution(obs / 5)


@pytest.mark.parametrize(
    ("policy", "extractor", "sentence"),
    [
        (OtherFeatures, FlattenExtractor, "get_distribution of OtherFeatures does not give the log π"),
        ("MlpPolicy", Dropping, "does not give the log π that it learns from .dropout"),
        ("MlpPolicy", Normalized, "does not give the log π that it learns from .dropout, batch normalization"),
    ],
)
def test_a_policy_with_another_distribution_is_refused(policy, extractor, sentence):
    policy_kwargs = {"features_extractor_class": extractor}
    model = REINFORCE(policy, "CartPole-v1", step="natural", n_steps=32, policy_kwargs=policy_kwargs, seed=0)
    before = to_vector(model.policy.parameters())
    with pytest.raises(ValueError, match=sentence):
        model.learn(32)
    assert th.equal(to_vector(model.policy.parameters()), before)


EQUAL_RETURNS = {
    "leave_one_out": (0.99, lambda t, action: 0.1 + 0.1 * t),
    "optimal": (1.0, lambda t, action: 0.7 * (t == 6)),
}


@pytest.mark.parametrize("baseline", EQUAL_RETURNS)
def test_equal_returns_are_no_gradient(baseline):
    """The baseline may differ from them by rounding; the optimal one is the same at all steps of an episode."""
    gamma, reward = EQUAL_RETURNS[baseline]
    env = DummyVecEnv([lambda: Corridor((7,), reward)] * 3)
    model = REINFORCE("MlpPolicy", env, step="natural", baseline=baseline, gamma=gamma, n_episodes=9, seed=0)
    assert divergences_of(model, 63) == [0.0]


def test_the_critic_does_not_move_shared_features():
    features = []
    for vf_coef, n_critic_updates in ((0.0, 1), (9.0, 5)):
        env = FakeImageEnv(screen_height=40, screen_width=40, n_channels=1)
        env.observation_space.seed(0)
        kwargs = {"vf_coef": vf_coef, "n_critic_updates": n_critic_updates}
        model = REINFORCE("CnnPolicy", env, step="natural", n_steps=32, seed=0, **kwargs).learn(32)
        features.append(to_vector(model.policy.features_extractor.parameters()))
    assert th.equal(*features)


def test_a_target_may_fall_to_0_also_in_a_saved_model(tmp_path, recwarn):
    env = make_vec_env("CartPole-v1", 2, seed=0)
    schedule = LinearSchedule(0.02, 0.0, 1.0)
    model = REINFORCE("MlpPolicy", env, step="natural", target_kl=schedule, n_steps=64, seed=0).learn(128)
    model.save(tmp_path / "model")
    found = divergences_of(REINFORCE.load(tmp_path / "model", env=env), 256)
    np.testing.assert_allclose(found, [0.01, 0.0], rtol=0.2)
    assert not recwarn
