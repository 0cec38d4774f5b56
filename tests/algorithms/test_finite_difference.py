"""FiniteDifference as an algorithm of Stable-Baselines3: what test_contract does not ask of both algorithms."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor
from searches import Levels, Line, estimates, estimates_of, make
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import FiniteDifference
from sb3_reinforce.estimation import ESTIMATORS, central_difference, fit_quality, regression_gradient
from sb3_reinforce.estimation.perturbations import default_delta_std
from sb3_reinforce.sampling.candidates import seeds_of


def test_an_estimate_before_learn_is_refused(tmp_path):
    """A loaded model has no log. The remedy of the message keeps its counts."""
    model = make(Line())
    callback = Record(lambda model: None)
    with pytest.raises(ValueError, match=r"call learn\(0\) first"):
        model.estimate_gradient(callback)
    model.learn(20).save(tmp_path / "model")
    loaded = FiniteDifference.load(tmp_path / "model", env=Line())
    with pytest.raises(ValueError, match=r"call learn\(0\) first, for a loaded model with reset_num_timesteps=False"):
        loaded.estimate_gradient(callback)
    loaded.learn(0, callback, reset_num_timesteps=False)
    assert loaded.num_timesteps == model.num_timesteps >= 20
    assert loaded.estimate_gradient(callback) is not None


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


def test_perturbations_are_multiplied_by_delta_std():
    """By a schedule at its present value: after a third of the training it is 0.4."""
    model = make(Line(), perturbation=lambda k, n, generator: th.ones(k, n), delta_std=lambda left: 0.6 * left)
    callback = Record(lambda model: None)
    model.learn(18, callback)
    model._update_current_progress_remaining(6, 18)
    estimate = model.estimate_gradient(callback)
    th.testing.assert_close(estimate.candidates[:3] - model.theta, th.full((3, 1), 0.4, dtype=th.float64))
    assert estimate.delta_std == pytest.approx(0.4)


def test_all_episodes_of_a_pair_have_seeds_that_no_other_pair_has():
    seeds = seeds_of((2, 3, 7), n_episodes=2, first_seed=5)
    plus, minus = seeds.reshape(2, 3, 2)
    assert (plus == minus).all() and len(np.unique(plus)) == 6


@pytest.mark.parametrize("bound", [None, 0.01])
@pytest.mark.parametrize("standardize", [True, False])
def test_the_step_is_the_gradient_scaled_and_clipped(standardize, bound):
    model = make(
        Line(), learning_rate=0.0, delta_std=0.1, standardize_utilities=standardize, max_grad_norm=bound,
        policy_kwargs={"optimizer_class": th.optim.SGD},
    )  # fmt: skip
    (estimate,) = estimates_of(model, 1)
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


@pytest.mark.parametrize(
    ("estimator", "common_random_numbers"),
    [
        ("central", False),
        ("regression", True),
        pytest.param("central", True, marks=pytest.mark.slow),
        pytest.param("regression", False, marks=pytest.mark.slow),
    ],
)
def test_the_standard_error_is_the_spread_of_the_gradient(estimator, common_random_numbers):
    kwargs = dict(n_delta=12, estimator=estimator, common_random_numbers=common_random_numbers, deterministic=False)
    env = make_vec_env(Levels, 4, seed=0)
    found = estimates(200, env, **kwargs)
    errors = [fit_quality(each.candidates, each.utilities, each.gradient, each.columns) for each in found]
    standard_error = th.stack([fit.standard_error for fit in errors]).square().mean().sqrt()
    spread = th.stack([each.gradient for each in found]).std()
    assert float(standard_error) == pytest.approx(float(spread), rel=0.2)


def test_the_fit_of_central_differences_is_the_regression_within_pairs():
    """Of (U₊ − U₋) / 2 on δ without an intercept: what the start of a pair adds is not left to explain."""
    model = make(make_vec_env(Levels, 4, seed=0), n_delta=6, deterministic=False, learning_rate=0.0)
    (estimate,) = estimates_of(model, 1)
    model.train(estimate)
    plus, minus = estimate.utilities.reshape(2, 6)
    x = (estimate.candidates.reshape(2, 6)[0] - model.theta).numpy()
    y = (plus - minus).numpy() / 2
    slope = x @ y / (x @ x)
    residuals = y - slope * x
    # Each pair has two residuals of this size and opposite signs, and one degree of freedom
    variance = 2 * residuals @ residuals / 5
    logged = model.logger.name_to_value
    assert logged["train/r_squared"] == pytest.approx(1 - residuals @ residuals / (y @ y))
    assert logged["train/residual_std"] == pytest.approx(variance**0.5)
    assert logged["train/standard_error"] == pytest.approx((variance / (2 * x @ x)) ** 0.5)


@pytest.mark.parametrize("level", [0.7, -200.0, 1e6])
def test_utilities_that_differ_by_rounding_make_no_step(level):
    model = make(Line(), learning_rate=0.0, policy_kwargs={"optimizer_class": th.optim.SGD})
    (estimate,) = estimates_of(model, 1)
    theta = model.theta
    model.learning_rate = 1.0
    equal = level + abs(level) * 1.5e-16 * th.arange(6.0).double()
    model.train(replace(estimate, utilities=equal, gradient=1e-15 * estimate.gradient))
    assert equal.std() > 0
    th.testing.assert_close(model.theta, theta)
    model.train(replace(estimate, utilities=level + th.arange(6.0).double()))
    assert not th.allclose(model.theta, theta)


def test_the_mean_of_the_standard_errors_is_logged():
    model = make(estimator="regression", n_delta=30, learning_rate=0.0)
    (estimate,) = estimates_of(model, 1)
    model.train(estimate)
    errors = fit_quality(estimate.candidates, estimate.utilities, estimate.gradient, estimate.columns).standard_error
    assert errors.std() > 0
    assert model.logger.name_to_value["train/standard_error"] == pytest.approx(float(errors.mean()))


def shrunk_regression(utility, theta, deltas):
    return 0.1 * regression_gradient(utility, theta, deltas)


@pytest.mark.parametrize(
    "kwargs", [dict(estimator="forward"), dict(estimator="central", n_top=15), dict(estimator=shrunk_regression)]
)
def test_no_standard_error_is_logged_where_the_gradient_is_no_regression(kwargs):
    model = make(n_delta=30, learning_rate=0.0, **kwargs)
    (estimate,) = estimates_of(model, 1)
    model.train(estimate)
    assert fit_quality(estimate.candidates, estimate.utilities, estimate.gradient).standard_error is not None
    assert "train/residual_std" in model.logger.name_to_value
    assert "train/standard_error" not in model.logger.name_to_value


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


def test_an_update_is_finished_and_none_starts_after_the_end():
    starts = Record(lambda model: model.num_timesteps, at="rollout_start")
    model = make().learn(300, starts)
    assert starts.records[-1] < 300 <= model.num_timesteps and len(starts.records) == model._n_updates


def test_schedules_see_the_progress_from_one_down_and_never_below_zero():
    seen, scales = [], []
    model = make(
        learning_rate=lambda progress: seen.append(progress) or 0.1 * progress,
        delta_std=lambda progress: 0.01 + 0.1 * progress,
    )
    # At construction they are checked at both ends
    seen.clear()
    for n_steps in (1, 300, 300):
        model.learn(n_steps, log_interval=None, reset_num_timesteps=False)
        scales.append(model.logger.name_to_value["train/delta_std"])
    assert 0 <= min(seen) < max(seen) == 1
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


def test_utilities_are_sums_of_rewards_before_their_scaling():
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_reward=True)
    env.ret_rms.var = np.array(100.0)
    (estimate,) = estimates(1, env, n_delta=2)
    assert all(length.is_integer() and length > 1 for length in estimate.utilities.tolist())


def test_too_few_perturbations_for_a_regression_are_said():
    model = make(estimator="regression", n_delta=4)
    with pytest.warns(UserWarning, match="n_delta=4 perturbations do not determine the gradient of 8") as warned:
        model.learn(1)
    assert warned[0].filename == __file__


@pytest.mark.parametrize("estimator", ["regression", "central"])
def test_an_estimator_of_this_package_is_the_same_as_a_function(estimator):
    assert make(estimator=ESTIMATORS[estimator]).estimator == estimator


def test_the_rule_of_thumb():
    model = make(n_delta=None)
    assert model.n_delta == 2 * model.n_parameters
    assert make(policy="MlpPolicy", n_delta=None).n_delta == 64
    assert make(perturbation="coordinate", n_delta=None).n_delta == model.n_parameters
    assert make(n_delta=None, n_top=50).n_delta == 50


def test_perturbations_are_one_percent_of_theta_or_a_twentieth():
    assert default_delta_std(th.full((4,), 10.0)) == pytest.approx(0.2) and default_delta_std(th.zeros(4)) == 0.05
    model = make()
    for weight in (0.0, 10.0):
        with th.no_grad():
            model.policy.action_net.weight.fill_(weight)
        expected = default_delta_std(model.theta)
        model.learn(1, log_interval=None)
        assert model.logger.name_to_value["train/delta_std"] == pytest.approx(expected)
    assert expected > 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_learns_cart_pole(seed):
    model = FiniteDifference("LinearPolicy", make_vec_env("CartPole-v1", 1, seed=seed), seed=seed, device="cpu")
    assert evaluate_policy(model.learn(50_000), model.get_env(), 50)[0] >= 475


def test_rewards_that_a_callback_changes_do_not_count():
    def thetas(factor):
        scale = Record(lambda model: scale.locals["rewards"].__imul__(factor), "step")
        model = make("CartPole-v1", standardize_utilities=False).learn(60, scale)
        return model.theta

    assert th.equal(thetas(1.0), thetas(-9.0))
