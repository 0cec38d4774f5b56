"""Baselines compared on the same episodes: against closed forms on a bandit, and on CartPole."""

import numpy as np
import pytest
import torch as th
from environments import Corridor, Tree
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import REINFORCE
from sb3_reinforce.baseline_gradients import componentwise_residuals
from sb3_reinforce.baselines import BASELINES
from sb3_reinforce.diagnostics import compare_baselines, gradients_by_episode, sample
from sb3_reinforce.scores import episode_gradients


class GaussianBandit(Corridor):
    """One step, two actions, rewards N(3, 4) and N(5, 4): the chapter's experiment."""

    def __init__(self):
        super().__init__((1,), self.draw)

    def draw(self, t, action):
        return self.np_random.normal([3.0, 5.0][action], 2.0)


def uniform_bandit(**kwargs):
    model = REINFORCE(
        "MlpPolicy", make_vec_env(GaussianBandit, 4, seed=0), policy_kwargs={"net_arch": []}, device="cpu", **kwargs
    )
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
    return model


def test_the_bandit_has_its_known_variances_in_order():
    """
    At π = (½, ½) each of four score components is ± ½, so ‖score‖² = 1 and tr Σ = E(r − b)² − ‖E g‖².

    E[r] = 4 and Var r = 4 + 1, so E r² = 21; E g has norm 1, since each component is ± ¼ (3 − 5).
    """
    table = compare_baselines(uniform_bandit(baseline="none"), n_episodes=2000, n_resamples=100)
    none, mean, optimal = (table[name].variance for name in ("none", "mean", "optimal"))
    for estimate, truth in ((none, 21 - 1), (mean, 5 - 1), (optimal, 5 - 1)):
        assert estimate.value == pytest.approx(truth, rel=0.1)
    assert none.low > mean.high
    assert mean.value >= optimal.value * (1 - 1e-2)
    assert table["none"].snr.low < 1 / 20 < table["none"].snr.high
    assert table["mean"].ratio.low < 4 / 20 < table["mean"].ratio.high


def test_no_constant_can_pass_the_floor():
    model = REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 4, seed=0), seed=0, device="cpu")
    constants = [lambda rollout, b=b: th.full_like(rollout.returns, b) for b in (-5.0, 1.0, 10.0, 20.0, 40.0)]
    for index, constant in enumerate(constants):
        constant.__name__ = f"constant_{index}"
    table = compare_baselines(model, 30, [*constants, "mean"])
    assert len(table) == 8
    assert all(table["floor"].variance.value <= row.variance.value for row in table)


def test_the_floor_is_the_best_constant_of_each_component():
    weighted, scores = th.randn(40, 3).double(), th.randn(40, 3).double()
    residual = componentwise_residuals(weighted, scores).var(0)
    for k in range(3):
        tried = [(weighted[:, k] - b * scores[:, k]).var() for b in th.linspace(-2, 2, 4001).double()]
        assert residual[k] == pytest.approx(float(min(tried)), abs=1e-5)
        assert residual[k] <= min(tried)


def test_rows_are_the_variances_of_the_gradients_themselves():
    model = REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 3, seed=1), seed=1, device="cpu")
    th.manual_seed(0)
    model.env.seed(7)
    table = compare_baselines(model, 12)
    th.manual_seed(0)
    model.env.seed(7)
    rollout = sample(model, 12)
    for name, baseline in BASELINES.items():
        weights = rollout.discounts * (rollout.returns - baseline(rollout))
        gradients = th.stack([gradient for (gradient,) in episode_gradients(rollout, weights)]).double()
        assert table[name].variance.value == pytest.approx(float(gradients.var(0).sum()), rel=1e-4)


def test_time_or_state_halve_the_variance_on_cartpole():
    env = make_vec_env("CartPole-v1", 8, seed=0)
    table = compare_baselines(REINFORCE("MlpPolicy", env, seed=0, device="cpu").learn(5_000), 100)
    assert min(table["value"].ratio.value, table["time_mean"].ratio.value) <= 0.5
    assert min(table["value"].ratio.high, table["time_mean"].ratio.high) < 0.7


def test_bias_is_told_where_theory_knows_it():
    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10)
    assert [table[name].bias for name in ("none", "leave_one_out", "value", "optimal")] == [0, 0, 0, 0]
    assert table["time_mean"].bias == 1 / 10
    assert np.isnan(table["mean"].bias)
    assert np.isnan(compare_baselines(REINFORCE("MlpPolicy", Tree(True), device="cpu"), 10)["time_mean"].bias)
    assert compare_baselines(uniform_bandit(), 10)["mean"].bias == 1 / 10


def test_the_model_is_as_it_was_and_goes_on():
    env = VecNormalize(make_vec_env("Pendulum-v1", 2, seed=0))
    model = REINFORCE("MlpPolicy", env, n_steps=8, seed=0, device="cpu").learn(16)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    state = model.num_timesteps, env.obs_rms.count, env.ret_rms.count, len(model.ep_info_buffer), model.logger
    compare_baselines(model, 4)
    assert state == (model.num_timesteps, env.obs_rms.count, env.ret_rms.count, len(model.ep_info_buffer), model.logger)
    assert env.training
    assert (model.n_steps, model.n_episodes, model.baseline) == (8, None, "value")
    assert all(th.equal(value, before[name]) for name, value in model.policy.state_dict().items())
    model.learn(16, reset_num_timesteps=False)
    assert model.num_timesteps == 32


def half(rollout):
    return rollout.returns * 0 + 0.5


def test_a_users_function_is_a_row_and_the_table_prints():
    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10, half)
    assert table.names == ["none", "half", "floor"]
    assert str(table).splitlines()[1].split() == ["baseline", "variance", "ratio", "snr", "bias", "seconds"]
    assert [record["baseline"] for record in table.to_records()] == table.names
    assert table.to_records()[1]["variance_low"] == table["half"].variance.low
    with pytest.raises(ValueError, match=r"'none', 'half', 'floor', got 'mean'"):
        table["mean"]


def test_a_table_becomes_a_data_frame():
    pandas = pytest.importorskip("pandas")
    frame = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 10).to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame.loc["none", "ratio"] == 1


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_episodes": 2}, "n_episodes must be at least 3, got 2"),
        ({"n_episodes": 10.0}, "n_episodes must be an integer"),
        ({"baselines": ("median",)}, r"baselines must be.*'time_mean'.*got 'median'"),
        ({"baselines": (3,)}, "baselines must be a name or a callable, got 3"),
        ({"baselines": ("value",)}, "no critic.*'none'"),
        ({"n_resamples": 0}, "n_resamples"),
        ({"confidence": 2.0}, "confidence"),
    ],
)
def test_a_users_mistake_is_named(kwargs, message):
    with pytest.raises((ValueError, TypeError), match=message):
        compare_baselines(REINFORCE("MlpPolicy", Tree(), baseline="none", device="cpu"), **kwargs)


def test_other_models_are_refused():
    with pytest.raises(TypeError, match="must be a REINFORCE"):
        compare_baselines(A2C("MlpPolicy", "CartPole-v1", device="cpu"))
    model = REINFORCE("MlpPolicy", Tree(), device="cpu")
    model.env = None
    with pytest.raises(ValueError, match="set_env"):
        compare_baselines(model)


def test_gradients_by_episode_is_public():
    rollout = sample(REINFORCE("MlpPolicy", Tree(), device="cpu"), 4)
    assert gradients_by_episode(rollout, rollout.returns).shape[:2] == (1, 4)
