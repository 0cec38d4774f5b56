"""Estimators: exact where they say so, of the order that they say, and one identity between two of them."""

from unittest.mock import Mock

import numpy as np
import pytest
import torch as th

from sb3_reinforce.estimation import (
    ESTIMATORS,
    central_difference,
    fit_quality,
    forward_difference,
    gaussian,
    regression_gradient,
)

N = 5


def normal(*shape, seed):
    return gaussian(int(np.prod(shape[:-1])), shape[-1], th.Generator().manual_seed(seed)).reshape(shape)


def linear(seed):
    slope = normal(1, N, seed=seed)[0]
    return lambda x: x @ slope + 7, slope


def exponential(x):
    """A utility whose gradient is exp(x)."""
    return x.exp().sum(-1)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_all_are_exact_on_linear_utilities(name):
    """As least-squares solutions are; an estimator of another kind is left out here and in the projection's test."""
    utility, slope = linear(0)
    theta, deltas = normal(1, N, seed=1)[0], normal(2 * N, N, seed=2)
    th.testing.assert_close(ESTIMATORS[name](utility, theta, deltas), slope)


def test_central_is_exact_on_quadratic_utilities():
    matrix, theta = normal(N, N, seed=0), normal(1, N, seed=1)[0]

    def utility(x):
        return ((x @ matrix) * x).sum(-1) + x.sum(-1)

    gradient = (matrix + matrix.T) @ theta + 1
    deltas = normal(N, N, seed=2)
    th.testing.assert_close(central_difference(utility, theta, deltas), gradient, rtol=1e-6, atol=1e-6)
    assert not th.allclose(forward_difference(utility, theta, deltas), gradient, rtol=1e-3)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_error_is_of_the_declared_order(name):
    order = {"forward": 1, "regression": 1, "central": 2}[name]
    theta = th.linspace(-1, 1, N, dtype=th.float64)
    deltas = normal(3 * N, N, seed=0)
    sizes = 2.0 ** -np.arange(4, 10)
    errors = [float((ESTIMATORS[name](exponential, theta, size * deltas) - theta.exp()).norm()) for size in sizes]
    measured, _ = np.polyfit(np.log(sizes), np.log(errors), 1)
    assert measured == pytest.approx(order, abs=0.1)


@pytest.mark.parametrize("k", [1, 2, N, 2 * N])
def test_regression_on_mirrored_perturbations_is_the_central_difference(k):
    theta, deltas = normal(1, N, seed=0)[0], normal(k, N, seed=1)

    def utility(x):
        return th.sin(3 * x).sum(-1) + 100

    mirrored = regression_gradient(utility, theta, th.cat([deltas, -deltas]))
    th.testing.assert_close(mirrored, central_difference(utility, theta, deltas))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_with_few_perturbations_the_estimate_is_the_projection_of_the_gradient(name):
    utility, slope = linear(0)
    deltas = normal(3, N, seed=1)
    directions = deltas - deltas.mean(0) if name == "regression" else deltas
    estimate = ESTIMATORS[name](utility, th.zeros(N).double(), deltas)
    # The solution of least norm lies in the span of the directions, where it agrees with the gradient
    th.testing.assert_close(estimate, th.linalg.pinv(directions) @ directions @ slope)


def test_nearly_collinear_perturbations_are_solved_to_what_their_condition_allows():
    utility, slope = linear(0)
    deltas = normal(1, N, seed=1) + 1e-6 * normal(2 * N, N, seed=2)
    # Of the normal equations, whose condition is the square, no digit would be left
    th.testing.assert_close(central_difference(utility, th.zeros(N).double(), deltas), slope, rtol=1e-6, atol=1e-6)


def test_n_top_is_the_central_difference_of_the_best_perturbations():
    theta, deltas = th.zeros(N).double(), normal(6, N, seed=0)
    best = th.maximum(exponential(deltas), exponential(-deltas)).argsort(descending=True)[:2]
    for n_top, rows in ((2, deltas[best]), (6, deltas)):
        estimate = central_difference(exponential, theta, deltas, n_top=n_top)
        th.testing.assert_close(estimate, central_difference(exponential, theta, rows))


@pytest.mark.parametrize("n_top", [0, -1, 7, 2.5])
def test_n_top_is_a_number_of_perturbations(n_top):
    evaluate = Mock()
    with pytest.raises((ValueError, TypeError), match="n_top must be"):
        central_difference(evaluate, th.zeros(N).double(), normal(6, N, seed=0), n_top=n_top)
    evaluate.assert_not_called()


def test_n_top_ranks_a_pair_by_its_better_utility():
    """As in ARS: the pair (5, −9) comes before (1, 0.5), whose mean is higher."""
    utilities = th.tensor([[5.0, 1.0], [-9.0, 0.5]]).double()
    estimate = central_difference(lambda x: utilities, th.zeros(2).double(), th.eye(2).double(), n_top=1)
    assert estimate.tolist() == [7.0, 0.0]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_design_without_direction_is_an_error_before_anything_is_evaluated(name):
    def utility(x):
        raise AssertionError("evaluated")

    equal = th.full((4, N), 0.1 if name == "regression" else 0.0).double()
    with pytest.raises(ValueError, match="4 perturbations have no usable direction"):
        ESTIMATORS[name](utility, th.zeros(N).double(), equal)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("shape", [(4, N + 1), (0, N), (N,), None])
def test_perturbations_that_do_not_fit_theta_are_an_error_before_anything_is_evaluated(name, shape):
    deltas = th.full((4, N), th.nan) if shape is None else th.rand(shape)
    with pytest.raises(ValueError, match=rf"deltas must be .* \({N},\) the shape of theta"):
        ESTIMATORS[name](lambda x: pytest.fail("evaluated"), th.zeros(N).double(), deltas.double())


@pytest.mark.parametrize("name", ESTIMATORS)
def test_perturbations_may_be_of_another_precision(name):
    theta, deltas = th.zeros(N).double(), normal(2 * N, N, seed=0).float()
    expected = ESTIMATORS[name](exponential, theta, deltas.double())
    assert th.equal(ESTIMATORS[name](exponential, theta, deltas), expected)
    coordinates = th.eye(N, dtype=th.long)
    expected = ESTIMATORS[name](exponential, theta, coordinates.double())
    assert th.equal(ESTIMATORS[name](exponential, theta, coordinates), expected)
    single = ESTIMATORS[name](lambda x: exponential(x).float(), theta, coordinates)
    th.testing.assert_close(single, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize(
    ("utility", "got"),
    [
        (lambda x: exponential(x).sum(), r"of shape \(\)"),
        (lambda x: x, rf"of shape \(.*{N}\)"),
        (lambda x: exponential(x).numpy(), "array"),
        (lambda x: th.nan * exponential(x), "nan"),
    ],
)
def test_a_utility_must_return_one_number_for_each_candidate(name, utility, got):
    with pytest.raises(ValueError, match=rf"utility must return .*, got .*{got}"):
        ESTIMATORS[name](utility, th.zeros(N).double(), normal(2 * N, N, seed=0))


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("theta", [th.zeros(N, dtype=th.long), np.zeros(N)], ids=type)
def test_theta_must_be_a_tensor_of_floats(name, theta):
    with pytest.raises(TypeError, match="theta must be a tensor of floats"):
        ESTIMATORS[name](lambda x: pytest.fail("evaluated"), theta, th.eye(N))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_perturbations_that_are_no_tensor_are_named(name):
    with pytest.raises(TypeError, match="deltas must be a tensor, got array"):
        ESTIMATORS[name](lambda x: pytest.fail("evaluated"), th.zeros(N).double(), np.eye(N))


def test_fit_quality_agrees_with_the_textbook():
    m = 400
    slope, deltas, noise = normal(1, N, seed=0)[0], normal(m, N, seed=1), normal(m, 1, seed=2)[:, 0]
    utilities = 3 + deltas @ slope + 0.5 * noise
    gradient = regression_gradient(lambda x: utilities, th.zeros(N).double(), deltas)
    fit = fit_quality(deltas, utilities, gradient)
    design = th.cat([th.ones(m, 1).double(), deltas], dim=1)
    hat = design @ th.linalg.inv(design.T @ design) @ design.T
    residuals = utilities - hat @ utilities
    variance = residuals @ residuals / (m - N - 1)
    assert fit.residual_std == pytest.approx(float(variance**0.5))
    assert fit.r_squared == pytest.approx(float(1 - residuals.var() / utilities.var()))
    assert fit.standard_error is not None
    th.testing.assert_close(fit.standard_error, (variance * th.linalg.inv(design.T @ design).diag()[1:]).sqrt())


def test_fit_quality_compares_within_columns():
    """Pairs that differ much between columns are the textbook's regression of their differences on 2Δ."""
    k = 40
    slope, deltas, noise, levels = (normal(*shape, seed=i) for i, shape in enumerate([(1, N), (k, N), (2, k), (1, k)]))
    plus_and_minus = th.stack([deltas, -deltas])
    utilities = 100 * levels + plus_and_minus @ slope[0] + 0.5 * noise
    gradient = central_difference(lambda x: utilities, th.zeros(N).double(), deltas)
    fit = fit_quality(plus_and_minus.reshape(-1, N), utilities.flatten(), gradient, th.arange(k).repeat(2))
    differences = utilities[0] - utilities[1]
    residuals = differences - 2 * deltas @ gradient
    variance = residuals @ residuals / (k - N)
    assert fit.residual_std == pytest.approx(float((variance / 2) ** 0.5))
    assert fit.r_squared == pytest.approx(float(1 - residuals @ residuals / (differences @ differences)))
    assert fit.standard_error is not None
    covariance = variance * th.linalg.inv(4 * deltas.T @ deltas)
    th.testing.assert_close(fit.standard_error, covariance.diag().sqrt())


def test_fit_quality_without_degrees_of_freedom_or_variance_is_not_made_up():
    deltas = normal(3, N, seed=0)
    fit = fit_quality(deltas, th.ones(3).double(), th.zeros(N).double())
    assert np.isnan(fit.r_squared) and np.isnan(fit.residual_std) and fit.standard_error is None
