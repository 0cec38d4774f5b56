"""FiniteDifference as an algorithm of Stable-Baselines3: what test_contract does not ask of both algorithms."""

import copy
import pickle
from dataclasses import replace
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Corridor
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from models import OwnPrediction, Scaled, plain
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import FiniteDifference
from sb3_reinforce.estimation import ESTIMATORS, central_difference, fit_quality
from sb3_reinforce.estimation.perturbations import default_delta_std

SMALL = dict(n_delta=3, estimator="central", seed=0, device="cpu")


def make(env="CartPole-v1", policy="LinearPolicy", **kwargs):
    return FiniteDifference(policy, env, **{**SMALL, **kwargs})


class Line(gym.Env):
    """One step an episode: the reward is −(a − 3 s)², with s drawn at reset."""

    observation_space, action_space = spaces.Box(-1, 1, (1,)), spaces.Box(-9, 9, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.state, {}

    def step(self, action):
        return self.state, -float((action[0] - 3 * self.state[0]) ** 2), True, False, {}


class Levels(Line):
    """The start decides most of the reward, 50 l + a, and the observation is 1."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.level = self.np_random.normal()
        return np.ones(1, np.float32), {}

    def step(self, action):
        return np.ones(1, np.float32), 50 * self.level + float(action[0]), True, False, {}


def estimates(n_updates, env=None, **kwargs):
    """Of as many updates at one θ."""
    model, callback = make(env or Line(), learning_rate=0.0, delta_std=0.1, **kwargs), Record(lambda model: None)
    model.learn(1, callback)
    return [model.estimate_gradient(callback) for _ in range(n_updates)]


def test_an_estimate_before_learn_is_refused():
    model = make(Line())
    with pytest.raises(ValueError, match=r"estimate_gradient needs the counters and the log of learn\(\)"):
        model.estimate_gradient(Record(lambda model: None))


def test_the_gradient_is_the_estimator_applied_to_the_utility():
    (estimate,) = estimates(1, n_delta=4)
    theta = estimate.candidates.mean()
    # In Line with W = w, U = −(w s − 3 s)² = −(w − 3)² s² for the start s of the column
    utilities, candidates = estimate.utilities.reshape(2, 4), estimate.candidates.reshape(2, 4)
    s_squared = -utilities / (candidates - 3) ** 2
    th.testing.assert_close(s_squared[0], s_squared[1], rtol=1e-4, atol=1e-6)
    assert len(s_squared[0].unique()) == 4
    deltas = candidates[0] - theta
    expected = central_difference(lambda x: -((x[..., 0] - 3) ** 2) * s_squared[0], theta[None], deltas[:, None])
    th.testing.assert_close(estimate.gradient, expected, rtol=1e-3, atol=1e-4)
    assert float(deltas.std()) < 3 * estimate.delta_std


@pytest.mark.parametrize("bound", [None, 0.01])
@pytest.mark.parametrize("standardize", [True, False])
def test_the_step_is_the_gradient_scaled_and_clipped(standardize, bound):
    callback = Record(lambda model: None)
    model = make(
        Line(), learning_rate=0.0, delta_std=0.1, standardize_utilities=standardize, max_grad_norm=bound,
        policy_kwargs={"optimizer_class": th.optim.SGD},
    ).learn(1, callback)  # fmt: skip
    estimate = model.estimate_gradient(callback)
    theta = model.theta
    model.learning_rate = 1.0
    model.train(estimate)
    step = estimate.gradient * (0.1 / estimate.utilities.std(correction=0) if standardize else 1.0)
    norm = float(step.norm())
    logged = model.logger.name_to_value
    assert norm > 0.01 and logged["train/grad_norm"] == pytest.approx(norm, rel=1e-4)
    assert logged["rollout/utility_mean"] == pytest.approx(float(estimate.utilities.mean()))
    assert logged["rollout/utility_std"] == pytest.approx(float(estimate.utilities.std(correction=0)))
    expected = step if bound is None else step * bound / norm
    th.testing.assert_close(model.theta - theta, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("common_random_numbers", [True, False])
@pytest.mark.parametrize("estimator", ["central", "regression"])
def test_the_standard_error_is_the_spread_of_the_gradient(estimator, common_random_numbers):
    kwargs = dict(n_delta=12, estimator=estimator, common_random_numbers=common_random_numbers, deterministic=False)
    env = make_vec_env(Levels, 4, seed=0)
    found = estimates(200, env, **kwargs)
    errors = [fit_quality(each.candidates, each.utilities, each.gradient, each.columns) for each in found]
    standard_error = th.stack([fit.standard_error for fit in errors]).square().mean().sqrt()
    spread = th.stack([each.gradient for each in found]).std()
    assert float(standard_error) == pytest.approx(float(spread), rel=0.2)


def test_utilities_that_differ_by_rounding_make_no_step():
    callback = Record(lambda model: None)
    model = make(Line(), learning_rate=0.0, policy_kwargs={"optimizer_class": th.optim.SGD}).learn(1, callback)
    estimate = model.estimate_gradient(callback)
    theta = model.theta
    model.learning_rate = 1.0
    equal = 0.7 + 1e-16 * th.arange(6.0).double()
    model.train(replace(estimate, utilities=equal, gradient=1e-15 * estimate.gradient))
    assert equal.std() > 0
    th.testing.assert_close(model.theta, theta)


def test_n_top_uses_the_best_pair():
    (estimate,) = estimates(1, n_delta=4, n_top=1)
    utilities, candidates = estimate.utilities.reshape(2, 4), estimate.candidates.reshape(2, 4)
    best = utilities.amax(0).argmax()
    plus, minus = utilities[:, best]
    x, y = candidates[:, best]
    th.testing.assert_close(estimate.gradient[0], (plus - minus) / (x - y), rtol=1e-6, atol=1e-8)


def test_a_utility_is_the_mean_of_its_episodes():
    (estimate,) = estimates(1, Corridor((1, 9)), n_delta=8, n_eval_episodes=2)
    assert 5.0 in estimate.utilities and {*estimate.utilities.tolist()} <= {1.0, 5.0, 9.0}


@pytest.mark.parametrize("deterministic", [True, False])
def test_candidates_sample_only_on_request(deterministic):
    """All parameters change alike, which leaves the softmax as it is."""
    env = Corridor((20,), lambda t, action: float(action))
    ones = lambda k, n, generator: th.ones(k, n)  # noqa: E731
    (estimate,) = estimates(1, env, perturbation=ones, deterministic=deterministic)
    assert (len(estimate.utilities.unique()) == 1) == deterministic


@pytest.mark.parametrize("estimator", ["regression", "central", "forward"])
@pytest.mark.parametrize("n_envs", [1, 4])
def test_it_learns_the_line(estimator, n_envs):
    model = make(make_vec_env(Line, n_envs), estimator=estimator, n_delta=8, learning_rate=0.1).learn(3000)
    assert float(model.theta) == pytest.approx(3, abs=0.2)


def test_an_update_is_finished_and_none_starts_after_the_end():
    starts = Record(lambda model: model.num_timesteps, at="rollout_start")
    model = make().learn(300, starts)
    assert starts.records[-1] < 300 <= model.num_timesteps and len(starts.records) == model._n_updates


def test_a_callback_finds_the_centre_in_the_policy_and_can_stop_at_any_step():
    model = make(make_vec_env("CartPole-v1", 4))
    theta, thetas = model.theta, Record(lambda model: model.theta, at="step")
    model.learn(10_000, [thetas, At(7)])
    assert len(thetas.records) == 7 and all(th.equal(each, theta) for each in [*thetas.records, model.theta])


def test_schedules_end_at_zero_and_never_below():
    seen, scales = [], []
    model = make(
        learning_rate=lambda progress: seen.append(progress) or 0.1 * progress,
        delta_std=lambda progress: 0.01 + 0.1 * progress,
    )
    for n_steps in (1, 300, 300):
        model.learn(n_steps, log_interval=None, reset_num_timesteps=False)
        scales.append(model.logger.name_to_value["train/delta_std"])
    assert min(seen) >= 0 and max(seen) <= 1
    assert 0.01 <= scales[2] < scales[0] == 0.11


def test_common_random_numbers_reduce_the_variance_of_the_gradient():
    shared, own = (
        th.stack([estimate.gradient for estimate in estimates(50, n_delta=2, common_random_numbers=is_shared)])
        for is_shared in (True, False)
    )
    assert shared.var() < own.var() / 2


def test_seeds_differ_from_update_to_update():
    found = estimates(3, n_delta=1, perturbation=lambda k, n, generator: th.ones(k, n))
    assert len({float(estimate.gradient) for estimate in found}) == 3


@pytest.mark.parametrize("norm_obs", [True, False])
def test_vec_normalize_is_frozen_in_an_update_and_learns_between(norm_obs):
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_obs=norm_obs)
    seen = Record(lambda model: (env.training, env.obs_rms.count if norm_obs else 0), at="step")
    model = make(env).learn(1, seen)
    ((training, count),) = set(seen.records)
    assert training and env.training and model._n_updates == 1
    if norm_obs:
        assert env.obs_rms.count == pytest.approx(count + model.num_timesteps)
        count = env.obs_rms.count
        env.training = False
        model.learn(1)
        assert env.obs_rms.count == count and not env.training


def test_a_callback_may_stop_the_statistics_of_vec_normalize():
    env = VecNormalize(make_vec_env("CartPole-v1", 2))
    make(env).learn(60, At(3, lambda model: setattr(env, "training", False)))
    assert not env.training and env.obs_rms.count == pytest.approx(2 + 2 * 3, abs=1e-3)


def test_a_stopped_update_leaves_its_observations_in_the_statistics():
    env = VecNormalize(make_vec_env("CartPole-v1", 2))
    model = make(env).learn(1000, At(7))
    assert model._n_updates == 0 and env.obs_rms.count == pytest.approx(2 + model.num_timesteps, abs=1e-3)
    model.set_logger(Logger(None, []))
    callback = At(1)
    callback.init_callback(model)
    assert model.estimate_gradient(callback) is None


def test_utilities_are_sums_of_rewards_before_their_scaling():
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_reward=True)
    env.ret_rms.var = np.array(100.0)
    (estimate,) = estimates(1, env, n_delta=2)
    assert all(length.is_integer() and length > 1 for length in estimate.utilities.tolist())


def test_a_linear_policy_on_dicts():
    """Where a features extractor puts them in a row."""
    space = spaces.Dict(once=spaces.Box(-1, 1, (1,)), twice=spaces.Box(-2, 2, (1,)))
    doubled = partial(TransformObservation, func=lambda s: {"once": s, "twice": 2 * s}, observation_space=space)
    env = make_vec_env(lambda: doubled(Line()), 2)
    model = make(env, policy_kwargs={"features_extractor_class": CombinedExtractor}).learn(20)
    assert model.n_parameters == 2 and model._n_updates > 0
    with pytest.raises(ValueError, match="use MultiInputPolicy"):
        make(env)


def test_a_features_extractor_of_the_user_is_searched_and_left_as_it_was():
    model = make(Line(), "MlpPolicy", policy_kwargs=dict(features_extractor_class=Scaled), learning_rate=0.0)
    before, n_parameters = plain(model.policy.state_dict()), model.n_parameters
    for _ in range(2):
        model.learn(20)
        assert plain(model.policy.state_dict()) == before
    model.policy.features_extractor.requires_grad_(False)
    assert model.n_parameters == n_parameters - 1


def test_what_a_callback_freezes_is_searched_for_the_last_time():
    model = make(Line(), "MlpPolicy")
    hidden = [plain(model.policy.mlp_extractor.state_dict())]
    for _ in range(2):
        model.learn(6, Record(lambda model: model.policy.mlp_extractor.requires_grad_(False)))
        hidden.append(plain(model.policy.mlp_extractor.state_dict()))
    assert model._n_updates == 2 and hidden[0] != hidden[1] == hidden[2]


def test_a_model_can_be_copied_when_new_and_pickled_after_learning():
    model = make(Line())
    same = copy.deepcopy(model)
    assert th.equal(model.learn(60).theta, same.learn(60).theta)
    again = pickle.loads(pickle.dumps(model))
    assert th.equal(model.learn(60).theta, again.learn(60).theta)


def test_a_model_that_a_callback_saves_is_not_collecting(tmp_path):
    seen = Record(lambda model: model.save(tmp_path / "model") or model.is_collecting, at="step")
    model = make(Line()).learn(1, seen)
    assert all(seen.records)
    assert not model.is_collecting and not FiniteDifference.load(tmp_path / "model").is_collecting


def test_a_policy_with_code_of_its_own_gives_the_same_and_says_that_it_is_slower(capsys):
    thetas = []
    for policy, verbose in (("MlpPolicy", 0), (OwnPrediction, 1)):
        model = make(make_vec_env("CartPole-v1", 2), policy, n_delta=2, verbose=verbose)
        thetas.append(model.learn(100, log_interval=None).theta)
    assert "OwnPrediction is not a plain MLP" in capsys.readouterr().out
    th.testing.assert_close(*thetas)


def test_too_few_perturbations_for_a_regression_are_said():
    model = make(estimator="regression", n_delta=4)
    with pytest.warns(UserWarning, match="n_delta=4 perturbations do not determine the gradient of 8") as warned:
        model.learn(1)
    assert warned[0].filename == __file__


@pytest.mark.parametrize("estimator", ["regression", "central"])
def test_an_estimator_of_this_package_is_the_same_as_a_function(estimator):
    named, function = (make(estimator=each, n_delta=None) for each in (estimator, ESTIMATORS[estimator]))
    assert named.n_delta == function.n_delta and function.estimator == estimator


def test_the_rule_of_thumb():
    n = make().n_parameters
    assert make(estimator="regression", n_delta=None).n_delta == 2 * n
    assert make(estimator="central", n_delta=None).n_delta == n
    assert make(policy="MlpPolicy", n_delta=None).n_delta == 64


def test_perturbations_are_one_percent_of_theta_or_a_twentieth():
    assert default_delta_std(th.full((4,), 10.0)) == pytest.approx(0.2) and default_delta_std(th.zeros(4)) == 0.05
    assert make().learn(1, log_interval=None).logger.name_to_value["train/delta_std"] == 0.05


def test_a_perturbation_and_an_estimator_of_the_user():
    def estimator(utility, theta, deltas):
        # Two calls: rows that are compared meet the same episodes
        plus, minus = utility(theta + deltas), utility(theta - deltas)
        return (plus - minus) @ deltas / (2 * (deltas**2).sum())

    ones = lambda k, n, generator: th.ones(k, n)  # noqa: E731
    model = make(Line(), estimator=estimator, perturbation=ones, learning_rate=0.1).learn(2000)
    assert float(model.theta) == pytest.approx(3, abs=0.3)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        (dict(estimator=lambda u, t, d: t[:1]), r"estimator must return a tensor of shape \(8,\), got .*\(1,\)"),
        (dict(estimator=lambda u, t, d: 3.0), r"estimator must return a tensor of shape \(8,\), got 3.0"),
        (dict(estimator=lambda u, t, d: t * np.nan), "estimator must return finite numbers"),
        (dict(estimator=lambda u, t, d: t), "estimator must call the utility at least once"),
        (dict(estimator=lambda u, t, d: u(t)), r"estimator must call the utility with a finite tensor of .*\(8,\)"),
        (dict(estimator=lambda u, t, d: u(d / 0)), "estimator must call the utility with a finite tensor"),
        (dict(perturbation=lambda k, n, g: th.ones(n, k)), r"perturbation must return a tensor of shape \(3, 8\)"),
        (dict(perturbation=lambda k, n, g: th.full((k, n), th.inf)), "perturbation must return finite numbers"),
        (dict(perturbation=lambda k, n, g: th.zeros(k, n)), "no usable direction"),
        (dict(estimator="regression", n_delta=9, perturbation=lambda k, n, g: th.ones(k, n)), "no usable direction"),
        (dict(max_episode_steps=3), "has not ended after max_episode_steps=3 steps"),
    ],
)
def test_what_a_user_returns_wrongly_is_named_and_theta_stays(kwargs, match):
    model = make(**kwargs)
    theta = model.theta
    with pytest.raises(ValueError, match=match):
        model.learn(100)
    assert th.equal(model.theta, theta) and model._n_updates == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_learns_cart_pole(seed):
    model = FiniteDifference("LinearPolicy", make_vec_env("CartPole-v1", 1, seed=seed), seed=seed, device="cpu")
    assert evaluate_policy(model.learn(50_000), model.get_env(), 50)[0] >= 475
