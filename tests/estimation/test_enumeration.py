"""The expected gradient by exact enumeration against ∇E[G_0], for each baseline and each option."""

from itertools import product

import pytest
import torch as th
from enumeration import (
    assert_equal,
    discounted_return,
    episode_terms,
    estimate,
    expected_gradient,
    gradient_of_return,
    log_prob_of,
    make_model,
    rollout_of,
    trajectories_of,
    true_gradient,
)
from environments import Tree

from sb3_reinforce.estimation import baselines
from sb3_reinforce.estimation.baselines import score_products


@pytest.mark.parametrize(
    ("baseline", "n_episodes", "ragged"),
    [
        *product(["none", "leave_one_out"], [2], [False, True]),
        *product(["optimal"], [3], [False, True]),
    ],
)
@pytest.mark.parametrize("reward_to_go", [False, True])
def test_none_leave_one_out_and_optimal_are_unbiased(baseline, n_episodes, reward_to_go, ragged):
    model = make_model(ragged, baseline=baseline, reward_to_go=reward_to_go, n_episodes=n_episodes)
    assert_equal(expected_gradient(model, n_episodes), gradient_of_return(model))


def test_optimal_in_sample_would_be_biased():
    """What the test above guards against: the same scalar, estimated on the episodes that it is applied to."""

    def in_sample(rollout):
        products, squares = score_products(rollout)
        return th.full_like(rollout.returns, float(products.sum() / squares.sum()))

    model = make_model(baseline=in_sample, n_episodes=3)
    assert (expected_gradient(model, 3) - gradient_of_return(model)).abs().max() > 1e-3


def test_value_is_unbiased_whatever_the_critic_says():
    model = make_model(baseline="value")
    with th.no_grad():
        model.policy.value_net.weight.normal_(std=10.0)
    assert_equal(expected_gradient(model), gradient_of_return(model))


@pytest.mark.parametrize("n_episodes", [2, 3])
@pytest.mark.parametrize("reward_to_go", [False, True])
def test_time_mean_is_short_by_one_nth(reward_to_go, n_episodes):
    model = make_model(baseline="time_mean", reward_to_go=reward_to_go, n_episodes=n_episodes)
    assert_equal(expected_gradient(model, n_episodes), (n_episodes - 1) / n_episodes * gradient_of_return(model))


@pytest.mark.parametrize(
    ("baseline", "m", "ragged", "factor"),
    [
        ("leave_one_out", 2, False, 1),
        ("leave_one_out", 3, True, 1),
        ("optimal", 2, True, 1),
        pytest.param("optimal", 3, True, 1, marks=pytest.mark.slow),
        ("time_mean", 2, False, 1 / 2),
        pytest.param("time_mean", 3, False, 2 / 3, marks=pytest.mark.slow),
    ],
)
def test_groups_that_share_their_start(baseline, m, ragged, factor):
    """Given two starts, whose rewards have the scales 1 and 10, the expectation is the mean of their gradients."""
    model = make_model(ragged, baseline=baseline, n_episodes=2 * m)
    model.episodes_per_start = m
    scales = (1.0,) * m + (10.0,) * m

    def estimate_scaled(model, batch):
        scaled = [
            [(node, action, scale * reward) for node, action, reward in episode]
            for scale, episode in zip(scales, batch, strict=True)
        ]
        return estimate(model, scaled)

    assert_equal(expected_gradient(model, 2 * m, estimate_scaled), factor * 5.5 * gradient_of_return(model))


def test_mean_is_biased_as_documented():
    """E[ĝ] = ∇E[Σ_t γ^t r_t] − ∇E[mean of the episode's returns] / N, for episodes of one length and no γ^t."""
    model = make_model(baseline="mean", discount_scores=False)
    without = expected_gradient(make_model(baseline="none", discount_scores=False))

    def mean_return(trajectory):
        return sum(discounted_return(trajectory, t) for t in range(2)) / 2

    assert_equal(expected_gradient(model), without - true_gradient(trajectories_of(model), mean_return) / 2)


def test_dividing_by_steps_is_biased_where_lengths_depend_on_actions():
    """The sum before the division is not; the ratio is not even parallel to ∇E[G_0]."""
    model = make_model(ragged=True, baseline="none", normalize_by="steps")

    def sum_of(model, batch):
        return estimate(model, batch) * sum(map(len, batch))

    gradient = expected_gradient(model)
    assert_equal(expected_gradient(model, statistic=sum_of), 2 * gradient_of_return(model))
    assert th.cosine_similarity(gradient.flatten(), gradient_of_return(model).flatten(), dim=0) < 1 - 1e-4


@pytest.mark.parametrize("numbers_at_once", [baselines.CHUNK, 1])
@pytest.mark.parametrize("reward_to_go", [False, True])
def test_optimal_is_its_formula_on_the_other_episodes(reward_to_go, numbers_at_once, monkeypatch):
    """Also where the scores of one episode at a time fit into memory."""
    monkeypatch.setattr(baselines, "CHUNK", numbers_at_once)
    model = make_model(ragged=True, baseline="optimal", reward_to_go=reward_to_go, n_episodes=3)
    for batch in product(Tree(ragged=True).trajectories(), repeat=3):
        _, ours = rollout_of(model, batch)
        terms = [episode_terms(trajectory, reward_to_go) for trajectory in batch]
        for i in range(3):
            others = [terms[j] for j in range(3) if j != i]
            expected = sum(a @ s for a, s in others) / sum(s @ s for _, s in others)
            th.testing.assert_close(ours[0, i], expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("reward_to_go", [False, True])
def test_that_formula_minimizes_the_trace_of_the_covariance(reward_to_go):
    trajectories = Tree().trajectories()
    probabilities = th.stack([log_prob_of(trajectory) for trajectory in trajectories]).exp()
    a, s = (th.stack(part) for part in zip(*(episode_terms(t, reward_to_go) for t in trajectories), strict=True))

    model = make_model(reward_to_go=reward_to_go)

    def trace(constant):
        model.baseline = lambda rollout: th.full_like(rollout.returns, float(constant))
        gradients = th.stack([estimate(model, [trajectory]).flatten() for trajectory in trajectories])
        return probabilities @ (gradients - probabilities @ gradients).square().sum(1)

    best = (probabilities @ (a * s).sum(1)) / (probabilities @ s.square().sum(1))
    assert trace(best) < min(trace(best - 0.01), trace(best + 0.01))
    assert abs(trace(best + 0.01) - trace(best - 0.01)) < 1e-10
