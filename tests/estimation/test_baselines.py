"""Each baseline on grids drawn by hand, and the cases in which there is nothing to average."""

from dataclasses import replace

import pytest
import torch as th

from sb3_reinforce import REINFORCE
from sb3_reinforce.estimation import BASELINES, Rollout, leave_one_out, mean, none, time_mean
from sb3_reinforce.estimation.baselines import sum_of_others
from sb3_reinforce.estimation.weights import compute_advantages


def make_rollout(returns, dones, timesteps, used=None, policy=None):
    returns = th.tensor(returns, dtype=th.float64)
    n_steps, n_envs = returns.shape
    return Rollout(
        observations=th.zeros(n_steps, n_envs, 4),
        actions=th.zeros(n_steps, n_envs, 1),
        rewards=th.zeros_like(returns),
        dones=th.tensor(dones, dtype=th.bool),
        timesteps=th.tensor(timesteps),
        used=th.ones(n_steps, n_envs, dtype=th.bool) if used is None else th.tensor(used, dtype=th.bool),
        returns=returns,
        discounts=th.ones_like(returns),
        values=None,
        policy=policy,
        denominator=n_steps * n_envs,
    )


# Three episodes: of 3 steps on the left, of 1 and 2 steps on the right; the last step on the right is not used
GRID = make_rollout(
    returns=[[10, 1], [20, 4], [30, 100]],
    dones=[[0, 1], [0, 0], [1, 0]],
    timesteps=[[0, 0], [1, 0], [2, 1]],
    used=[[1, 1], [1, 1], [1, 0]],
)


def test_episodes_are_numbered():
    assert GRID.episodes.tolist() == [[0, 1], [0, 2], [0, 2]]


@pytest.mark.parametrize(
    ("baseline", "expected"),
    [
        (none, [0, 0, 0, 0, 0]),
        (mean, [13, 13, 13, 13, 13]),
        (time_mean, [5, 5, 20, 5, 30]),
        (leave_one_out, [2.5, 7, 0, 5.5, 0]),
    ],
)
def test_a_baseline_averages_over_used_steps(baseline, expected):
    """All of them, those of the episodes that reach t, or those of the other episodes that do."""
    assert baseline(GRID)[GRID.used].tolist() == expected


def test_a_timestep_that_one_episode_reaches_has_a_defined_weight():
    alone = make_rollout([[3.0], [5.0]], dones=[[0], [1]], timesteps=[[0], [1]])
    assert time_mean(alone).tolist() == alone.returns.tolist()
    assert leave_one_out(alone).tolist() == [[0], [0]]


def test_a_difference_of_a_billionth_of_the_returns_is_no_rounding():
    pair = make_rollout([[1e6, 1e6 + 1e-3]], dones=[[1, 1]], timesteps=[[0, 0]])
    assert compute_advantages(pair, leave_one_out(pair)).ravel() == pytest.approx([-1e-3, 1e-3], rel=1e-3)


@pytest.mark.parametrize("baseline", ["mean", "time_mean", "leave_one_out", "optimal"])
def test_a_batch_without_variance_has_no_gradient(baseline):
    """Some baselines differ from equal returns by the rounding of float64, which compute_advantages removes."""
    model = REINFORCE("MlpPolicy", "CartPole-v1", device="cpu")
    same = make_rollout([[0.7] * 7], [[1] * 7], [[0] * 7], policy=model.policy)
    same.actions[0, ::2] = 1
    th.testing.assert_close(BASELINES[baseline](same), same.returns, rtol=1e-14, atol=0)
    assert not compute_advantages(same, BASELINES[baseline](same)).any()


@pytest.mark.parametrize("other", [1.0, 1e9])
def test_optimal_keeps_its_digits_beside_a_group_of_other_returns(other):
    model = REINFORCE("MlpPolicy", "CartPole-v1", device="cpu")
    returns = [[0.7, 0.7, 0.7, other, other, other]]
    groups = replace(make_rollout(returns, [[1] * 6], [[0] * 6], policy=model.policy), episodes_per_start=3)
    groups.actions[0, ::2] = 1
    assert len(groups.groups.unique()) == 2
    assert not compute_advantages(groups, BASELINES["optimal"](groups)).any()


def test_optimal_is_zero_where_no_other_episode_has_a_score():
    model = REINFORCE("MlpPolicy", "CartPole-v1", device="cpu")
    single = make_rollout([[7.0], [6.0]], [[0], [1]], [[0], [1]], policy=model.policy)
    assert BASELINES["optimal"](single).tolist() == [[0], [0]]


def test_timesteps_of_a_very_long_episode_cost_no_memory():
    late = make_rollout([[1.0, 2.0]], [[1, 1]], [[10**12, 10**12]])
    assert leave_one_out(late).tolist() == [[2, 1]]


def test_the_sum_of_others_keeps_what_is_small_beside_the_one_left_out():
    assert sum_of_others(th.tensor([1e20, 1.0, 2.0], dtype=th.float64)).tolist() == [3.0, 1e20, 1e20]
