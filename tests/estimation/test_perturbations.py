"""Directions: unit standard deviation, as documented, and a function of the generator alone."""

import pytest
import torch as th

from sb3_reinforce.estimation import PERTURBATIONS, coordinate, gaussian, rademacher, regression_gradient, sphere
from sb3_reinforce.estimation.perturbations import default_n_delta, sample_deltas


def generator(seed=0):
    return th.Generator().manual_seed(seed)


@pytest.mark.parametrize("name", PERTURBATIONS)
def test_shape_type_and_reproducibility(name):
    first, again, other = (PERTURBATIONS[name](7, 5, generator(seed)) for seed in (0, 0, 1))
    assert first.shape == (7, 5) and first.dtype == th.float64
    assert th.equal(first, again)
    assert not th.equal(first, other)


@pytest.mark.parametrize("name", sorted(PERTURBATIONS.keys() - {"coordinate"}))
def test_moments_of_random_directions(name):
    """Mean zero, identity covariance, and E δ_i⁴ of each kind, in four dimensions."""
    fourth_moment = {"sphere": 3 * 4 / (4 + 2), "gaussian": 3, "rademacher": 1}[name]
    k = 100_000
    deltas = PERTURBATIONS[name](k, 4, generator())
    assert abs(deltas.pow(4).mean() - fourth_moment) <= 5 * deltas.pow(4).std() / k**0.5
    # Standard errors: 1/√k of a mean, at most √2/√k of a second moment; five of them
    th.testing.assert_close(deltas.mean(0), th.zeros(4).double(), rtol=0, atol=5 * k**-0.5)
    th.testing.assert_close(deltas.T @ deltas / k, th.eye(4).double(), rtol=0, atol=5 * (2 / k) ** 0.5)


def test_norms():
    for perturbation in (sphere, rademacher):
        norms = perturbation(9, 6, generator()).norm(dim=1)
        th.testing.assert_close(norms, th.full((9,), 6**0.5).double())
    assert set(rademacher(9, 6, generator()).unique().tolist()) == {-1.0, 1.0}


@pytest.mark.parametrize(("perturbation", "n"), [(sphere, 1), (rademacher, 1), (rademacher, 2)])
def test_a_few_signs_are_not_all_equal_and_still_have_the_moments(perturbation, n):
    """The regression would have no direction, with half of all pairs of signs."""
    draws = [sample_deltas(perturbation, 2, n, 0.5, source) for source in map(generator, range(2000))]
    assert all((deltas[0] != deltas[1]).any() for deltas in draws)
    # Standard errors of a mean of k independent signs, of 0.5; the two rows of a draw are not
    rows = th.stack([deltas[0] for deltas in draws])
    th.testing.assert_close(rows.mean(0), th.zeros(n).double(), rtol=0, atol=5 * 0.5 * 2000**-0.5)
    th.testing.assert_close(4 * rows.T @ rows / 2000, th.eye(n).double(), rtol=0, atol=5 * 2000**-0.5)


def test_a_few_coordinates_of_many_take_little_memory():
    deltas = coordinate(2, 300_000, generator())
    assert deltas.abs().sum(1).tolist() == [1.0, 1.0]


def test_coordinates_visit_all_parameters_with_alternating_sign():
    deltas = coordinate(10, 4, generator())
    assert th.equal(deltas.abs().sum(1), th.ones(10).double())
    signs = deltas[:4].sum(0)
    assert signs.abs().tolist() == [1, 1, 1, 1] and deltas[4:8].sum(0).equal(-signs)
    assert (deltas[8:] * signs).sum(1).tolist() == [1, 1]
    orders = coordinate(60, 20, generator()).abs().argmax(1).split(20)
    assert len({tuple(order.tolist()) for order in orders}) == 3


@pytest.mark.parametrize("k", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_a_regression_on_a_few_coordinates_expects_a_multiple_of_the_gradient(k):
    """``ĝ_i = g_i − s_i (s · g) / k`` of the k measured coordinates of n, with random signs s of mean 0."""
    n, gradient = 4, th.tensor([3.0, 2.0, 4.0, 1.0]).double()
    draws = (coordinate(k, n, source) for source in map(generator, range(4000)))
    estimates = th.stack([regression_gradient(lambda x: x @ gradient, th.zeros(n).double(), each) for each in draws])
    difference = estimates.mean(0) - k / n * (1 - 1 / k) * gradient
    assert (difference.abs() < 5 * estimates.std(0) / len(estimates) ** 0.5).all()


@pytest.mark.parametrize(("k", "n"), [(10, 5), (64, 42), (21, 43), (64, 300)])
def test_noise_is_multiplied_by_the_mean_of_an_inverse_wishart_matrix(k, n):
    """Noise of variance 1 in the differences gives ĝ = Δ⁺ ε a mean square of ‖Δ⁺‖², which is infinite for k = n."""
    assert default_n_delta(n, "central", "gaussian") == k
    squares = th.stack([th.linalg.pinv(gaussian(k, n, generator(seed))).square().sum() for seed in range(200)])
    expected = min(k, n) / (abs(n - k) - 1)
    assert abs(squares.mean() - expected) < 5 * squares.std() / 200**0.5


def test_the_default_number_of_perturbations():
    """At most twice the noise of a difference is in the estimate."""
    expected = {3: 6, 20: 40, 32: 64, 42: 64, 43: 21, 64: 32, 127: 63, 129: 64, 5000: 64}
    assert {n: default_n_delta(n, "forward", gaussian) for n in expected} == expected
    assert all(min(k, n) / (abs(n - k) - 1) <= 2 for n, k in expected.items())


@pytest.mark.parametrize("perturbation", ["coordinate", coordinate])
def test_coordinates_do_not_depend_on_each_other(perturbation):
    """Twice as many would make forward differences central."""
    for estimator in ("forward", "central"):
        assert [default_n_delta(n, estimator, perturbation) for n in (1, 20, 60, 99)] == [1, 20, 60, 64]
    assert default_n_delta(20, "regression", perturbation) == 40
