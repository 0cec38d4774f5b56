"""Baselines compared on the same episodes: against closed forms on a bandit, and on CartPole."""

import sys
from functools import partial

import numpy as np
import pandas
import pytest
import torch as th
from environments import Corridor, NumericEnds, Tree
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import (
    baseline_comparison,
    compare_baselines,
    compare_starts,
    gradients_by_episode,
    sample,
)
from sb3_reinforce.diagnostics.baseline_comparison import componentwise_residuals
from sb3_reinforce.diagnostics.tables import Estimate
from sb3_reinforce.estimation.baselines import BASELINES
from sb3_reinforce.estimation.scores import gradient_blocks


class GaussianBandit(Corridor):
    """One step, two actions, rewards N(3, 4) and N(5, 4): the chapter's experiment."""

    def __init__(self):
        super().__init__((1,), self.draw)

    def draw(self, t, action):
        return self.np_random.normal([3.0, 5.0][action], 2.0)


def bandit(better=0.5):
    """A model that takes the better action, of mean 5, with a probability."""
    model = REINFORCE(
        "MlpPolicy",
        make_vec_env(GaussianBandit, 4, seed=0),
        policy_kwargs={"net_arch": []},
        seed=0,
        device="cpu",
    )
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
        model.policy.action_net.bias.copy_(th.tensor([1 - better, better]).log())
    return model


@pytest.mark.parametrize("n_episodes", [7, 10])
def test_equal_returns_leave_no_gradient(n_episodes):
    """Their mean differs from each by rounding."""
    model = REINFORCE("MlpPolicy", make_vec_env(lambda: Corridor((5,)), 2, seed=0), gamma=0.99, device="cpu")
    table = compare_baselines(model, n_episodes, baselines=["leave_one_out", "time_mean"])
    rows = [table[name] for name in ("leave_one_out", "time_mean")]
    assert [row.variance.value for row in rows] == [0.0, 0.0]
    assert all(np.isnan(row.snr.value) for row in rows)


@pytest.mark.parametrize("better", [0.5, 0.8, pytest.param(0.2, marks=pytest.mark.slow)])
def test_the_bandit_has_its_known_variances(better):
    """
    ``tr Σ = E‖s (r − b)‖² − ‖E g‖²`` with b = 0, b = E r, and the best constant, ``E[‖s‖² r] / E‖s‖²``.

    The score s has the components 1(a' = a) − π(a') for the weights and again for the biases, so ‖s‖² is 4 times the
    squared probability of the other action. A reward of mean μ and variance 4 has E r² = 4 + μ². Mean and best constant
    are equal at p = q, with p of one action and q of the other, and the mean the worse one everywhere else.
    """
    pq = better * (1 - better)
    signal = 16 * pq**2
    none = 4 * pq * ((4 + 5**2) * (1 - better) + (4 + 3**2) * better) - signal
    truths = {"none": none, "mean": 16 * pq * (2 - 4 * pq), "optimal": 16 * pq}
    table = compare_baselines(bandit(better), 2000, truths, reference="mean", n_resamples=200, confidence=0.99)
    for name, truth in truths.items():
        assert table[name].variance.low < truth < table[name].variance.high
        # "mean" has (n − 1)/n of the gradient: its variance is 1.0010 times too small
        assert table[name].ratio.low / 1.0011 <= truth / truths["mean"] <= 1.0011 * table[name].ratio.high
        assert table[name].snr.low < signal / truth < table[name].snr.high
    assert table["none"].ratio.low > 1
    assert (table["optimal"].ratio.high < 1) == (better != 0.5)


def test_with_scores_of_one_length_optimal_is_the_mean_of_the_others():
    """r_i − r̄ is (N − 1)/N times r_i less the mean of the others: the ratio is the same number in every resample."""
    ratio = compare_baselines(bandit(), 20, reference="mean", n_resamples=20)["optimal"].ratio
    assert (ratio.low, ratio.value, ratio.high) == pytest.approx(3 * ((20 / 19) ** 2,), rel=1e-4)


def test_the_floor_is_the_best_constant_of_each_component():
    weighted, scores = th.randn(40, 3).double(), th.randn(40, 3).double()
    residual = componentwise_residuals(weighted, scores).var(0)
    for k in range(3):
        tried = [(weighted[:, k] - b * scores[:, k]).var() for b in th.linspace(-2, 2, 4001).double()]
        assert residual[k] == pytest.approx(float(min(tried)), abs=1e-5)
        assert residual[k] <= min(tried)


@pytest.mark.parametrize(("floats", "discount_scores"), [(1, False), (5000, True), (2**26, False)])
def test_rows_are_the_variances_of_the_gradients_however_much_is_held(monkeypatch, floats, discount_scores):
    env = make_vec_env("CartPole-v1", 3, seed=1)
    model = REINFORCE(
        "MlpPolicy", env, gamma=0.9, discount_scores=discount_scores, policy_kwargs={"net_arch": [5]}, seed=1,
        device="cpu",
    )  # fmt: skip
    sizes = []

    def blocks(*args):
        for block in gradient_blocks(*args, floats=floats):
            sizes.append(block.numel())
            yield block

    monkeypatch.setattr(baseline_comparison, "gradient_blocks", blocks)
    model.env.seed(7)
    table = compare_baselines(model, 6, seed=5)
    # The scores and a weight for each baseline, of six episodes
    assert max(sizes) <= max(floats, (len(BASELINES) + 1) * 6)
    th.manual_seed(5)
    model.env.seed(7)
    rollout = sample(model, 6)
    discounts = 0.9 ** (discount_scores * rollout.timesteps.double())
    for name, baseline in BASELINES.items():
        weights = discounts * (rollout.returns - baseline(rollout))
        gradients = gradients_by_episode(rollout, weights)[0].double()
        assert table[name].variance.value == pytest.approx(float(gradients.var(0).sum()), rel=1e-4)
        assert table[name].seconds > 0
    weighted, scores = gradients_by_episode(rollout, discounts * rollout.returns, discounts).double()
    floor = float(componentwise_residuals(weighted, scores).var(0).sum())
    assert table["floor"].variance.value == pytest.approx(floor, rel=1e-4)


def test_time_or_state_halve_the_variance_on_cartpole():
    env = make_vec_env("CartPole-v1", 8, seed=0)
    table = compare_baselines(REINFORCE("MlpPolicy", env, seed=0, device="cpu").learn(5_000), 100)
    assert min(table["value"].ratio.value, table["time_mean"].ratio.value) <= 0.5
    assert min(table["value"].ratio.high, table["time_mean"].ratio.high) < 1


def test_a_progress_bar_counts_the_episodes(capsys):
    """What an environment plays beyond its share does not count; of each start there are eight."""
    env = NumericEnds(make_vec_env(lambda: Tree(ragged=True), 3, seed=0))
    model = REINFORCE("MlpPolicy", env, device="cpu")
    for compare, n, shown in ((compare_baselines, 20, "20/20"), (compare_starts, 5, "48/48")):
        compare(model, n, progress_bar=True)
        assert f"| {shown} [" in capsys.readouterr().err


def test_bias_is_known_where_theory_knows_it():
    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10)
    assert [table[name].bias for name in ("none", "leave_one_out", "value", "optimal")] == [0, 0, 0, 0]
    assert table["time_mean"].bias == 1 / 10
    assert np.isnan(table["mean"].bias)
    assert np.isnan(compare_baselines(REINFORCE("MlpPolicy", Tree(True), device="cpu"), 10)["time_mean"].bias)
    assert compare_baselines(bandit(), 10)["mean"].bias == 1 / 10


def test_a_users_function_is_a_row_and_the_table_prints():
    def half(rollout):
        return th.full_like(rollout.returns, 0.5)

    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10, half)
    assert table.names == ["none", "half", "floor"] and "half" in table and "mean" not in table
    assert set(table.legend) == {*table.columns[1:], "[a, b]"}
    assert all(text in str(table) for text in table.legend.values())
    assert str(table).splitlines()[1].split() == ["baseline", "variance", "ratio", "snr", "bias", "seconds"]
    assert [line.split()[0] for line in str(table).splitlines()[2:5]] == table.names
    assert str(table["half"].variance) in str(table)
    assert str(Estimate(1.0, 0.5, 2.25)) == "1 [0.5, 2.25]"
    assert [record["baseline"] for record in table.to_records()] == table.names
    assert table.to_records()[1]["variance_low"] == table["half"].variance.low
    with pytest.raises(ValueError, match=r"'none', 'half', 'floor', got 'mean'"):
        table["mean"]


def test_baselines_without_a_name_are_numbered():
    def constant(rollout, value):
        return th.full_like(rollout.returns, value)

    baselines = [partial(constant, value=value) for value in (0.5, 1.0)]
    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10, baselines)
    assert table.names == ["none", "partial_1", "partial_2", "floor"]


def test_a_table_becomes_a_data_frame_if_there_is_pandas(monkeypatch):
    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10)
    frame = table.to_pandas()
    assert isinstance(frame, pandas.DataFrame) and frame.index.tolist() == table.names
    for row in table:
        assert frame.loc[row.baseline, "ratio"] == row.ratio.value
        assert frame.loc[row.baseline, "variance_low"] == row.variance.low
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pandas"):
        table.to_pandas()
