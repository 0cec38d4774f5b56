"""Statistics of sampled gradients against Gaussians whose statistics are known, and against enumeration."""

import sys
from itertools import product

import numpy as np
import pytest
import torch as th
from enumeration import assert_equal, episode_terms, expectation, log_prob_of
from environments import Tree

from sb3_reinforce.diagnostics.estimator_comparison import compare_to_reference
from sb3_reinforce.diagnostics.statistics import (
    Moments,
    compute_moments,
    gradient_statistics,
    noise_scale,
    signal_to_noise,
    variance,
)
from sb3_reinforce.diagnostics.tables import as_text, interval, resample_counts

MEAN = th.tensor([1.0, -2.0, 0.5, 0.0, 1.5, 0.0, 1.0, -1.0], dtype=th.float64)
FACTOR = th.randn(8, 8, dtype=th.float64, generator=th.Generator().manual_seed(3))
TRACE, SIGNAL = float(FACTOR.square().sum()), float(MEAN @ MEAN)


def draw(m, generator):
    """Gradients of mean MEAN and covariance FACTORᵀ FACTOR, whose trace is TRACE."""
    return MEAN + th.randn(m, 8, dtype=th.float64, generator=generator) @ FACTOR


@pytest.mark.parametrize("counts", [(1.0, 1.0, 1.0, 1.0), (3.0, 0.0, 2.0, 1.0)])
def test_counts_are_repeated_samples_without_their_pairs_with_themselves(counts):
    gradients = draw(4, th.Generator().manual_seed(1))
    found = compute_moments(gradients @ gradients.T, th.tensor([counts], dtype=th.float64))
    labels = [sample for sample, count in enumerate(counts) for _ in range(int(count))]
    pairs = [gradients[i] @ gradients[j] for i, j in product(labels, repeat=2) if i != j]
    th.testing.assert_close(found.signal[0], th.stack(pairs).mean())
    apart = [(gradients[i] - gradients[j]).square().sum() / 2 for i, j in product(labels, repeat=2) if i != j]
    th.testing.assert_close(variance(found)[0], th.stack(apart).mean())


def test_variance_and_signal_are_unbiased_on_the_tree():
    """Σ over all samples of 3 episodes of p(sample) · statistic is the statistic of the distribution."""
    trajectories = Tree().trajectories()
    gradients = th.stack([episode_terms(trajectory, True)[0] for trajectory in trajectories])
    log_probs = th.stack([log_prob_of(trajectory) for trajectory in trajectories])
    p = log_probs.exp()
    signal = (p @ gradients).square().sum()
    trace = p @ gradients.square().sum(1) - signal

    def estimates(sample):
        chosen = th.stack(sample)
        found = compute_moments(chosen @ chosen.T, th.ones(1, 3, dtype=th.float64))
        return th.stack([variance(found)[0], found.signal[0]])

    assert_equal(expectation(estimates, gradients, log_probs, 3), th.stack([trace, signal]))


def test_ratios_are_each_others_inverse_and_no_signal_is_an_infinite_noise_scale():
    some, nothing = Moments(th.tensor(5.0), th.tensor(1.0)), Moments(th.tensor(5.0), th.tensor(-1.0))
    assert float(signal_to_noise(some)) == 1 / float(noise_scale(some)) == 0.25
    assert noise_scale(nothing) == th.inf
    assert signal_to_noise(nothing) < 0


def test_resamples_have_m_samples_of_which_two_differ():
    counts = resample_counts(2, 200, seed=0)
    assert counts[0].tolist() == [1, 1]
    assert (counts.sum(1) == 2).all()
    assert ((counts > 0).sum(1) == 2).all()
    assert th.equal(counts, resample_counts(2, 200, seed=0))
    assert not th.equal(resample_counts(9, 5, seed=0), resample_counts(9, 5, seed=1))


def test_95_percent_intervals_of_32_samples_cover_the_truth_in_90_to_98_percent_of_500_repetitions():
    generator, covered = th.Generator().manual_seed(0), th.zeros(4)
    reference = th.ones(8, dtype=th.float64) + MEAN
    truth = [TRACE, SIGNAL / TRACE, TRACE / SIGNAL, float(MEAN @ reference / MEAN.norm() / reference.norm())]
    for seed in range(500):
        gradients = draw(32, generator)
        found = gradient_statistics(gradients, reference, n_resamples=400, seed=seed)
        th.testing.assert_close(found.mean, gradients.mean(0))
        estimates = [found.variance, found.snr, found.noise_scale, found.cosine]
        covered += th.tensor([e.low <= t <= e.high for e, t in zip(estimates, truth, strict=True)]).float()
    assert ((0.90 <= covered / 500) & (covered / 500 <= 0.98)).all(), covered / 500


@pytest.mark.parametrize(
    ("m", "scale"), [(10, 0.2), *(pytest.param(*case, marks=pytest.mark.slow) for case in [(10, 0.5), (20, 1.0)])]
)
def test_where_little_is_seen_of_the_gradient_its_cosine_is_covered_all_the_same(m, scale):
    """Signal-to-noise ratios of the mean from 0.08 to 4; the reference is as noisy where it is made of samples too."""
    generator, covered, both = th.Generator().manual_seed(0), 0, 0
    reference = th.ones(8, dtype=th.float64) + MEAN
    truth = float(MEAN @ reference / MEAN.norm() / reference.norm())
    shift = (scale - 1) * MEAN
    for seed in range(500):
        gradients, others = draw(m, generator) + shift, draw(m, generator) + shift + scale * th.ones(8)
        found = gradient_statistics(gradients, reference, n_resamples=200, seed=seed).cosine
        covered += found.low <= truth <= found.high
        found = compare_to_reference(gradients, others, 200, 0.95, seed)[0]
        both += found.low <= truth <= found.high
    assert min(covered, both) >= 450, (covered, both)


def test_the_largest_seed_is_taken():
    gradients = draw(8, th.Generator().manual_seed(0))
    assert compare_to_reference(gradients, gradients + 1, 10, 0.95, sys.maxsize)[0].low <= 1


def test_without_a_signal_the_cosine_is_not_known():
    gradients, reference = th.tensor([[1.0, 1.0], [-1.0, 1.0], [0.0, -2.0]]), th.tensor([1.0, 0.0])
    found = gradient_statistics(gradients, reference).cosine
    assert found.value != found.value
    assert (found.low, found.high) == (-1, 1)
    assert as_text(found) == "-"


def test_the_noise_of_the_reference_does_not_lower_the_cosine():
    """With the norm of the mean of 40 noisy samples it would be too small by a factor near √(1 / 1.13) = 0.94."""
    generator, shift = th.Generator().manual_seed(2), th.tensor([1.0, 1, 1, 1, 0, 0, 0, 0], dtype=th.float64)
    truth = float(MEAN @ (MEAN + shift) / MEAN.norm() / (MEAN + shift).norm())
    values = []
    for _ in range(400):
        gradients, reference = draw(400, generator), draw(40, generator) + shift
        values.append(compare_to_reference(gradients, reference, 1, 0.95, 0)[0].value)
    assert abs(np.mean(values) - truth) < 4 * np.std(values) / 20 < 0.03


@pytest.mark.parametrize("name", ["variance", "snr", "noise_scale", "cosine"])
def test_more_confidence_takes_a_wider_interval_and_another_seed_other_resamples(name):
    gradients = draw(32, th.Generator().manual_seed(1))

    def found(**kwargs):
        statistics = gradient_statistics(gradients, MEAN.roll(1), n_resamples=200, **kwargs)
        return getattr(statistics, name)

    wide, narrow = found(confidence=0.99), found(confidence=0.5)
    assert wide.low < narrow.low < narrow.high < wide.high
    assert found(seed=1).low != found(seed=0).low


def test_an_interval_holds_its_estimate_and_can_be_infinite():
    values = th.cat([th.tensor([2.0]), th.linspace(0, 4, 99), th.tensor([th.inf])]).double()
    assert interval(values, 0.9).low < interval(values, 0.9).value < interval(values, 0.9).high
    assert interval(values, 0.999).high == th.inf


def test_unknown_values_count_as_beyond_both_ends():
    """As many of 1,000 as lie beyond an end of 95 % at most; else the ends are not known."""
    values = th.arange(1001).double()
    values[1:25] = th.nan
    found = interval(values, 0.95)
    assert (found.low, found.high) == (25, 1000)
    values[25] = th.nan
    found = interval(values, 0.95)
    assert np.isnan([found.low, found.high]).all()


def test_a_few_resamples_without_a_variance_leave_the_interval_known():
    """Few episodes of a task with sparse rewards have a gradient, and some resamples have none of them."""
    gradients = th.cat([draw(4, th.Generator().manual_seed(5)), th.zeros(96, 8, dtype=th.float64)])
    counts = resample_counts(100, 1000, 0)
    assert (counts[1:, :4].sum(1) == 0).any(), "0 / 0 there"
    snr = gradient_statistics(gradients).snr
    assert snr.low < snr.value < snr.high
    # A third of the resamples do not have the only one
    for few in (gradients[3:], th.zeros(5, 8)):
        snr = gradient_statistics(few).snr
        assert np.isnan([snr.low, snr.high]).all()


@pytest.mark.parametrize(
    ("gradients", "kwargs", "message"),
    [
        (th.ones(1, 3), {}, r"m >= 2.*\(1, 3\)"),
        (th.ones(3), {}, r"shape \(m, n\).*\(3,\)"),
        (th.tensor([[1.0], [float("nan")]]), {}, "finite, and sample 1"),
        ([[1.0], [2.0]], {}, "must be a tensor"),
        (th.ones(2, 3), {"reference": th.ones(2)}, r"reference.*\(2,\)"),
        (th.ones(2, 3), {"reference": th.zeros(3)}, r"reference.*norm 0"),
        (th.ones(2, 3), {"reference": [1.0, 1.0, 1.0]}, "reference must be a tensor"),
        (th.ones(2, 3), {"confidence": 95}, "confidence"),
        (th.ones(2, 3), {"n_resamples": 0}, "n_resamples"),
    ],
)
def test_what_cannot_be_measured_is_named(gradients, kwargs, message):
    with pytest.raises((ValueError, TypeError), match=message):
        gradient_statistics(gradients, **kwargs)
