"""The gradient check passes where the gradient is right."""

import math
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Corridor, Random, Tree
from gradient_checks import ACTION_SPACES, HalfDetached, corridor, with_noise
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import check_gradient, policy_errors
from sb3_reinforce.diagnostics.sampling import sample
from sb3_reinforce.estimation.rollout import used_inputs
from sb3_reinforce.recurrent import RecurrentREINFORCE


@pytest.mark.parametrize(
    ("action_space", "kwargs"),
    [
        *((action_space, {}) for action_space in ACTION_SPACES),
        # Returns and weights do not depend on the actions
        (ACTION_SPACES[0], {"gae_lambda": 0.7}),
        (ACTION_SPACES[0], {"gae_lambda": 0.0}),
        (ACTION_SPACES[0], {"baseline": "optimal"}),
        (ACTION_SPACES[0], {"baseline": "mean", "reward_to_go": False}),
    ],
)
def test_every_action_space_and_every_kind_of_weights_passes(action_space, kwargs):
    env = make_vec_env(lambda: corridor(action_space), 2, seed=0)
    table = check_gradient(REINFORCE("MlpPolicy", env, device="cpu", seed=0, gamma=0.9, **kwargs))
    assert table.passed, table
    assert table.names == ["log_prob", "sampling", "scores", "sign", "returns", "weights", "surrogate"]


@pytest.mark.parametrize("baseline", ["leave_one_out", "time_mean", "mean"])
def test_equal_returns_pass(baseline):
    """Their mean differs from each by rounding."""
    env = make_vec_env(lambda: Corridor((5,)), 2, seed=0)
    model = REINFORCE("MlpPolicy", env, baseline=baseline, gamma=0.99, reward_to_go=baseline != "mean", device="cpu")
    # With both numbers each of the three baselines rounds
    assert all(check_gradient(model, n_episodes=n).passed for n in (3, 6))


def two_episodes(env, policy="MlpPolicy", **kwargs):
    return partial(REINFORCE, policy, env, n_episodes=2, **kwargs)


def pays(scale):
    return make_vec_env(lambda: Corridor((3, 7), lambda t, action: scale * (1.0 + t + action)), 2, seed=0)


PARTS = spaces.Dict(image=spaces.Box(0, 255, (36, 36, 1), np.uint8), vector=spaces.Box(-1, 1, (3,)))


def trained(**kwargs):
    return REINFORCE("MlpPolicy", "CartPole-v1", **kwargs).learn(1000)


@pytest.mark.parametrize(
    "make",
    [
        trained,
        partial(REINFORCE, "MlpPolicy", "CartPole-v1", normalize_advantage=True, discount_scores=True, ent_coef=0.1),
        two_episodes("CartPole-v1", temperature=0.5, normalize_by="episodes"),
        two_episodes("CartPole-v1", step="natural"),
        two_episodes(Random(PARTS, spaces.Discrete(3)), "MultiInputPolicy"),
        # Also where a step along the gradient is less than the rounding of the parameters
        *(two_episodes(pays(scale), baseline="none") for scale in (1e-7, 1.0, 1e4)),
    ],
)
def test_other_policies_and_arguments_pass(make):
    table = check_gradient(make(device="cpu", seed=0))
    assert table.passed, table


def test_a_baseline_that_is_nan_at_unused_steps_passes():
    def baseline(rollout):
        return th.full_like(rollout.returns, 3.0).masked_fill(~rollout.used, th.nan)

    env = make_vec_env(corridor, 3, seed=0)
    table = check_gradient(REINFORCE("MlpPolicy", env, baseline=baseline, n_episodes=4, device="cpu", seed=0))
    assert table.passed, table


class MovingAverage:
    """The reinforcement comparison of Williams (1992): a baseline that learns from each rollout."""

    value = 0.0

    def __call__(self, rollout):
        values = th.full_like(rollout.returns, self.value)
        self.value = 0.9 * self.value + 0.1 * float(rollout.returns[rollout.used].mean())
        return values


def test_a_baseline_with_memory_passes():
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_episodes=8, baseline=MovingAverage(), seed=0).learn(500)
    assert model.baseline.value > 0
    table = check_gradient(model)
    assert table.passed, table


class Magnified(Corridor):
    """Observations in the thousands."""

    def observe(self):
        return 1e4 * super().observe()


@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ReLU])
def test_policies_that_are_curved_much_pass(activation_fn):
    env = make_vec_env(lambda: Magnified((3, 7), lambda t, action: 1.0 + t + action), 2, seed=0)
    policy_kwargs = {"activation_fn": activation_fn}
    table = check_gradient(REINFORCE("MlpPolicy", env, device="cpu", seed=0, policy_kwargs=policy_kwargs))
    assert table["scores"].passed and table["surrogate"].passed, table


def without_gradient(model, *names):
    for name, parameter in model.policy.named_parameters():
        parameter.requires_grad_(not name.startswith(names))
    return model


@pytest.mark.parametrize(
    ("log_std_init", "frozen"),
    [(-3.0, ()), (0.0, ()), (4.0, ()), (-3.0, ("action_net",)), (0.0, ("action_net",)), (4.0, ("mlp_extractor.",))],
)
def test_scores_that_lie_mostly_in_the_standard_deviation_pass(log_std_init, frozen):
    table = check_gradient(without_gradient(with_noise(log_std_init), *frozen), 2)
    assert table["sign"].passed, table


@pytest.mark.parametrize("seed", range(4))
def test_small_observations_pass(seed):
    env = gym.make("CartPole-v1")
    space = spaces.Box(-np.inf, np.inf, env.observation_space.shape)
    env = gym.wrappers.TransformObservation(env, lambda obs: np.float32(0.01) * obs, space)
    model = REINFORCE("MlpPolicy", env, seed=seed, policy_kwargs={"activation_fn": th.nn.ReLU})
    table = check_gradient(model, seed=seed)
    assert table["scores"].passed, table


def test_the_sign_of_a_mean_that_is_not_trained_does_not_pass_unchecked():
    table = check_gradient(without_gradient(with_noise(0.0), "action_net", "mlp_extractor.policy_net"), 2)
    assert np.isnan(table["sign"].error)
    assert "sign" in table.failures


# Finite differences in random directions take time in proportion to the parameters
SMALL = {"features_extractor_kwargs": {"features_dim": 16}}


def test_images_pass_with_a_bounded_number_of_them(monkeypatch):
    """Also where the parameters are not contiguous in memory."""
    monkeypatch.setattr(policy_errors, "N_ELEMENTS", 300 * 36**2)
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=True)
    seen, forward = [], NatureCNN.forward
    monkeypatch.setattr(NatureCNN, "forward", lambda self, obs: seen.append(len(obs)) or forward(self, obs))
    model = two_episodes(env, "CnnPolicy", baseline="none", policy_kwargs=SMALL)(device="cpu", seed=0)
    model.policy.to(memory_format=th.channels_last)
    table = check_gradient(model, 2)
    assert table.passed, table
    assert max(seen) == 300


def test_gsde_cuts_its_scores_unless_it_learns_features():
    """Stable-Baselines3 detaches the features that the standard deviation depends on: not the gradient of log π."""
    env = gym.make("Pendulum-v1", max_episode_steps=20)
    model = REINFORCE("MlpPolicy", env, use_sde=True, device="cpu", seed=0)
    assert check_gradient(model).failures == ["scores"]
    model.policy.action_dist.learn_features = True
    assert check_gradient(model).passed


def test_a_memory_that_larger_weights_would_make_explode_passes():
    memory = {"memory": "rnn", "lstm_hidden_size": 64, "lstm_kwargs": {"nonlinearity": "relu"}}
    model = RecurrentREINFORCE("MlpLstmPolicy", "Pendulum-v1", policy_kwargs=memory, device="cpu", seed=2)
    assert check_gradient(model).passed


def test_a_new_policy_whose_last_layer_alone_learns_is_named():
    """The last layer's weights are small, and the scores of the others with them."""
    env = make_vec_env("CartPole-v1", 2, seed=0)
    assert check_gradient(REINFORCE(HalfDetached, env, device="cpu", seed=0)).failures == ["scores"]


def test_the_table_says_what_its_columns_are():
    table = check_gradient(REINFORCE("MlpPolicy", corridor(ACTION_SPACES[0]), device="cpu"), 2)
    below = str(table).splitlines()[len(table) + 2 :]
    assert all(column in "\n".join(below) for column in table.columns[1:])


def test_the_parameters_stay_where_they_are_in_memory():
    """In one common storage, each saved parameter would take the bytes of all."""
    model = REINFORCE("MlpPolicy", Tree(), device="cpu")
    addresses = [parameter.data_ptr() for parameter in model.policy.parameters()]
    check_gradient(model)
    assert [parameter.data_ptr() for parameter in model.policy.parameters()] == addresses


def test_a_learning_rate_that_has_just_been_changed():
    """The check passes, and training goes on with the new rate."""
    model = REINFORCE("MlpPolicy", "CartPole-v1", learning_rate=1e-3, seed=0, device="cpu").learn(64)
    model.learning_rate = 0.25
    assert check_gradient(model).passed
    model.learn(64)
    assert model.policy.optimizer.param_groups[0]["lr"] == 0.25


class Sides(gym.Env):
    """One side of the image is bright, and naming it earns 1."""

    observation_space, action_space = spaces.Box(0, 255, (36, 36, 1), np.uint8), spaces.Discrete(2)

    def observe(self):
        image = np.zeros((36, 36, 1), np.uint8)
        self.side = int(self.np_random.integers(2))
        image[8:28, 18 * self.side : 18 * self.side + 18] = self.np_random.integers(100, 255)
        return image

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        reward = float(action == self.side)
        self.t += 1
        return self.observe(), reward, self.t == 10, False, {}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_policy_that_has_learned_to_be_almost_deterministic_passes(seed):
    """Its log π is mostly rounding, and the more so with a larger last layer."""
    model = REINFORCE("CnnPolicy", make_vec_env(Sides, 8, seed=seed), device="cpu", seed=seed).learn(4096)
    assert check_gradient(model).passed


def test_a_difference_from_nan_is_not_small():
    nan = th.tensor([math.nan, 1.0])
    for other in (th.ones(2), th.zeros(2)):
        assert math.isnan(policy_errors.relative_difference(nan, other))
        assert math.isnan(policy_errors.relative_difference(other, nan))
    assert policy_errors.relative_difference(th.zeros(2), th.zeros(2)) == 0


class NanForLargeMeans(ActorCriticPolicy):
    """Its log π is right, and the score of a mean beyond 0.5 is NaN."""

    def _get_action_dist_from_latent(self, latent):
        distribution = super()._get_action_dist_from_latent(latent)
        mean = distribution.distribution.mean
        change = th.where(mean.abs() > 0.5, mean - mean.detach(), th.ones_like(mean))
        mean = mean + change.square().sqrt() - change.detach().abs()
        return self.action_dist.proba_distribution(mean, self.log_std)


def test_scores_that_are_nan_with_a_larger_last_layer_do_not_pass():
    model = REINFORCE(NanForLargeMeans, corridor(spaces.Box(-1, 1, (2,), np.float32)), device="cpu", seed=0)
    rollout = sample(model, 2)
    error = policy_errors.score_error(model.policy, *used_inputs(rollout))
    assert math.isnan(error)
