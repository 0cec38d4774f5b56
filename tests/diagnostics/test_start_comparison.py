"""The share of the variance between starts, and what groups would gain, on a task where both are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch as th
from environments import Corridor, Reused, Scales, Tree
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import compare_starts
from sb3_reinforce.diagnostics.start_comparison import by_start, group_grams, sample_starts
from sb3_reinforce.diagnostics.statistics import gram
from sb3_reinforce.estimation import gradients_by_episode, leave_one_out


def make_model(n_envs=16, **kwargs):
    # A policy that hardly learns stays uniform
    env = DummyVecEnv([lambda: Scales(**kwargs)] * n_envs)
    return REINFORCE("MlpPolicy", env, baseline="leave_one_out", seed=0)


@pytest.mark.parametrize("scale", [0.5, pytest.param(2.0, marks=pytest.mark.slow)])
def test_the_share_and_the_gains_are_found(scale):
    """
    With rewards ``scale · x ± 1`` the share is ``scale² / (scale² + 1)``.

    For a uniform policy ĝ is proportional to the mean of ``e_i A_i`` with e_i = ±1: alone, A_i = scale · x + e_i has
    the variance scale²; in a group, the mean of ``1 − e_i mean_{j≠i} e_j`` has ``2 / (m (m − 1))``.
    """
    report = compare_starts(make_model(scale=scale), n_starts=200, confidence=0.99)
    assert report.share.low <= scale**2 / (scale**2 + 1) <= report.share.high
    assert report.share.high - report.share.low < 0.3
    for m, gain in report.gains.items():
        # The baseline of independent episodes is a mean of 199 returns
        expected = (scale**2 + (scale**2 + 1) / 199) * (m - 1) / 2
        assert gain.low <= expected <= gain.high
        assert gain.high < 4 * gain.low


@pytest.mark.parametrize("n_envs", [1, 3, 16])
def test_starts_are_the_same_whatever_the_number_of_environments(n_envs):
    """Eight episodes of a start follow each other over the environments; 3 of them need a multiple of 3 starts."""
    report = compare_starts(make_model(n_envs, scale=1000.0), n_starts=5 if n_envs == 3 else 6)
    assert report.share.value > 0.999


def test_environments_that_reuse_their_arrays_have_the_same_report():
    reports = []
    for wrap in (lambda env: env, Reused):
        env = wrap(make_vec_env("CartPole-v1", 8))
        model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", seed=0, device="cpu")
        reports.append(str(compare_starts(model, n_starts=4)))
    assert reports[0] == reports[1]


def test_an_environment_that_ignores_seeds_is_refused():
    with pytest.raises(ValueError, match="cannot share their start"):
        compare_starts(make_model(ignores_seed=True))


@pytest.mark.parametrize("discount_scores", [False, True])
@pytest.mark.parametrize("env", [lambda: Tree(ragged=True), lambda: Corridor((1, 2, 6), lambda t, a: t + a)])
def test_ragged_episodes_have_the_gradients_of_training(env, discount_scores):
    """The lengths differ within groups of eight, or between them; the baseline is the one that training would have."""
    arguments = {"baseline": "leave_one_out", "gamma": 0.5, "discount_scores": discount_scores}
    model = REINFORCE("MlpPolicy", DummyVecEnv([env] * 8), seed=0, **arguments)
    rollouts = sample_starts(model, 8)
    returns = by_start([rollout.returns * rollout.used for rollout in rollouts])
    used = by_start([rollout.used.double() for rollout in rollouts])
    assert not used.all()
    grams = group_grams(rollouts, returns, used)
    for m in (2, 4, 8):
        means = []
        for rollout in rollouts:
            grouped = replace(rollout, episodes_per_start=m)
            discounts = 0.5 ** (discount_scores * rollout.timesteps.double())
            [gradients] = gradients_by_episode(grouped, discounts * (grouped.returns - leave_one_out(grouped)))
            means.append(gradients.double().reshape(-1, m, gradients.shape[1]).mean(1))
        found = th.stack(means)
        expected = gram(found.mean(1))
        expected.diagonal().copy_(found.square().sum(2).mean(1))
        th.testing.assert_close(grams[m], expected)


def test_where_all_returns_are_equal_nothing_is_known():
    model = REINFORCE("MlpPolicy", DummyVecEnv([lambda: Corridor((3,), lambda t, action: 0.1 + t)] * 8), seed=0)
    report = compare_starts(model, n_starts=8)
    assert all(np.isnan(estimate.value) for estimate in (report.share, *report.gains.values()))
    assert "nan" not in str(report)


def test_the_report_can_be_read():
    text = str(compare_starts(make_model(), n_starts=8))
    assert "between starts" in text and all(f"episodes_per_start={m}" in text for m in (2, 4, 8))
    assert np.isfinite(compare_starts(make_model(scale=0.0), n_starts=8).share.value)
