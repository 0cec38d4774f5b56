"""What is logged of the gradient's quality."""

import pytest
import torch as th
from callbacks import Record
from environments import Tree
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import GradientQualityCallback, gradients_by_episode
from sb3_reinforce.diagnostics.sampling import evenly_spread
from sb3_reinforce.estimation.baselines import BASELINES


class Recorded(Logger):
    """Keeps every value of the gradient that was recorded."""

    def __init__(self):
        super().__init__(folder=None, output_formats=[])
        self.history = {}

    def record(self, key, value, exclude=None):
        if key.startswith("gradient/"):
            self.history.setdefault(key, []).append(value)


def train(callback, timesteps=512, model=None, **kwargs):
    """A model that was trained, and what was logged of its gradient."""
    env = make_vec_env("CartPole-v1", 4, seed=0)
    model = model or REINFORCE("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    model.set_logger(Recorded())
    return model.learn(timesteps, callback), model.logger.history


def test_it_logs_every_so_many_rollouts():
    _, history = train(GradientQualityCallback(2, ("mean", "value")))
    variances = {f"gradient/variance/{name}" for name in ("none", "mean", "value")}
    assert set(history) == variances | {"gradient/snr", "gradient/noise_scale", "gradient/cosine"}
    assert len(history["gradient/snr"]) == 2
    assert len(history["gradient/cosine"]) == 1
    assert -1 <= history["gradient/cosine"][0] <= 1


def test_episodes_of_one_start_are_not_taken_for_independent():
    _, history = train(GradientQualityCallback(1), 1024, baseline="leave_one_out", episodes_per_start=2)
    assert set(history) == {"gradient/cosine"}


def test_it_serves_one_model_after_another():
    callback = GradientQualityCallback(1, iter(["mean"]))
    (_, first), (_, second) = (train(callback) for _ in range(2))
    assert first == second


@pytest.mark.parametrize(
    "kwargs", [{"baseline": "none"}, {"baseline": "mean"}, {"baseline": "none", "normalize_advantage": True}]
)
def test_the_signal_to_noise_ratio_has_the_weights_of_training(kwargs):
    model, history = train(GradientQualityCallback(1), 1, n_episodes=8, learning_rate=0.0, **kwargs)
    rollout = model.rollout
    weights = rollout.returns - BASELINES[model.baseline](rollout)
    if model.normalize_advantage:
        weights = (weights - weights[rollout.used].mean()) / weights[rollout.used].std()
    gradients = gradients_by_episode(rollout, weights)[0].double()
    trace = float(gradients.var(0).sum())
    signal = float(gradients.mean(0).square().sum()) - trace / 8
    assert history["gradient/snr"] == [pytest.approx(8 * signal / trace, rel=1e-3)]
    scale = trace / signal if signal > 0 else float("inf")
    assert history["gradient/noise_scale"] == [pytest.approx(scale, rel=1e-3)]
    if kwargs == {"baseline": "none"}:
        assert history["gradient/variance/none"] == [pytest.approx(trace, rel=1e-4)]


def test_no_more_episodes_than_allowed_are_used():
    given = []

    def counted(rollout):
        given.append(rollout)
        return rollout.returns * 0

    model, _ = train(GradientQualityCallback(1, [counted], max_episodes=5), 1, baseline="none", n_episodes=12)
    assert len(th.unique(given[0].episodes[given[0].used])) == 5
    assert given[0].used.sum() < model.rollout.used.sum()
    assert evenly_spread(model.rollout, 12) is model.rollout


@pytest.mark.parametrize("every", [1, 5])
def test_of_finite_differences_it_logs_the_cosine_between_updates(every):
    model = FiniteDifference("LinearPolicy", Tree(), learning_rate=0.1, seed=0)
    thetas = Record(lambda model: model.theta, "rollout_start")
    _, history = train([thetas, GradientQualityCallback(every)], 300, model)
    assert set(history) == {"gradient/cosine"}
    steps = th.stack(thetas.records).diff(dim=0)
    expected = th.cosine_similarity(steps[1:], steps[:-1])[max(every - 3, 0) :: every].tolist()
    assert len(expected) >= 2
    assert history["gradient/cosine"] == pytest.approx(expected)


def test_a_single_episode_has_no_variance_to_log():
    model = REINFORCE("MlpPolicy", Tree(), baseline="none", n_episodes=1, device="cpu")
    _, history = train(GradientQualityCallback(1), 8, model)
    assert set(history) == {"gradient/cosine"}
    assert len(history["gradient/cosine"]) == 2
