"""What is logged of the gradient's quality, and that training is the same with and without it."""

import subprocess
import sys

import pytest
import torch as th
from environments import Corridor, Tree
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger, configure

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import GradientQualityCallback
from sb3_reinforce.diagnostics.quality_callback import evenly_spread
from sb3_reinforce.estimation.scores import episode_gradients


class Recorded(Logger):
    """Keeps every value that was recorded."""

    def __init__(self):
        super().__init__(folder=None, output_formats=[])
        self.history = {}

    def record(self, key, value, exclude=None):
        self.history.setdefault(key, []).append(value)


def train(callback=None, timesteps=512, **kwargs):
    env = make_vec_env("CartPole-v1", 4, seed=0)
    model = REINFORCE("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    model.set_logger(Recorded())
    return model.learn(timesteps, callback)


@pytest.mark.parametrize("kwargs", [{}, {"baseline": "leave_one_out", "n_episodes": 6}])
def test_training_is_the_same_with_it(kwargs):
    with_it, without = train(GradientQualityCallback(1), **kwargs), train(**kwargs)
    for ours, theirs in zip(with_it.policy.parameters(), without.policy.parameters(), strict=True):
        assert th.equal(ours, theirs)
    assert with_it.num_timesteps == without.num_timesteps


def test_it_logs_every_so_many_rollouts():
    history = train(GradientQualityCallback(2, ("mean", "value"))).logger.history
    keys = {key for key in history if key.startswith("gradient/")}
    variances = {f"gradient/variance/{name}" for name in ("none", "mean", "value")}
    assert keys == variances | {"gradient/snr", "gradient/noise_scale", "gradient/cosine"}
    assert len(history["gradient/snr"]) == 2
    assert len(history["gradient/cosine"]) == 1
    assert -1 <= history["gradient/cosine"][0] <= 1


def test_it_serves_one_model_after_another():
    callback = GradientQualityCallback(1)
    histories = [train(callback).logger.history for _ in range(2)]
    assert histories[0] == histories[1]


def test_the_variance_is_that_of_the_episodes_gradients():
    callback = GradientQualityCallback(1)
    model = train(callback, 1, baseline="none", n_episodes=8, learning_rate=0.0)
    rollout = model.rollout
    gradients = th.stack([gradient for (gradient,) in episode_gradients(rollout, rollout.returns)]).double()
    trace = float(gradients.var(0).sum())
    signal = float(gradients.mean(0).square().sum()) - trace / 8
    history = model.logger.history
    assert history["gradient/variance/none"] == [pytest.approx(trace, rel=1e-4)]
    assert history["gradient/snr"] == [pytest.approx(8 * signal / trace, rel=1e-3)]


def test_the_signal_to_noise_ratio_is_that_of_the_weights_of_training():
    model = train(GradientQualityCallback(1), 1, baseline="mean", n_episodes=8, learning_rate=0.0)
    rollout = model.rollout
    weights = rollout.returns - rollout.returns[rollout.used].mean()
    gradients = th.stack([gradient for (gradient,) in episode_gradients(rollout, weights)]).double()
    trace = float(gradients.var(0).sum())
    signal = float(gradients.mean(0).square().sum()) - trace / 8
    assert model.logger.history["gradient/snr"] == [pytest.approx(8 * signal / trace, rel=1e-3)]


def test_no_baseline_is_given_more_episodes_than_allowed():
    given = []

    def counted(rollout):
        given.append(len(th.unique(rollout.episodes[rollout.used])))
        return rollout.returns * 0

    train(GradientQualityCallback(1, [counted], max_episodes=4), 1, baseline="none", n_episodes=20)
    assert given == [4]


def test_no_more_episodes_than_allowed_are_looked_at():
    model = train(timesteps=1, baseline="none", n_episodes=12)
    few = evenly_spread(model.rollout, 5)
    assert len(th.unique(few.episodes[few.used])) == 5
    assert few.used.sum() < model.rollout.used.sum()
    assert evenly_spread(model.rollout, 12) is model.rollout


def test_of_finite_differences_it_logs_the_cosine_between_updates():
    model = FiniteDifference("LinearPolicy", Tree(), learning_rate=0.1, seed=0)
    model.set_logger(Recorded())
    thetas = []

    class Thetas(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            thetas.append(model.theta)

    history = model.learn(200, [Thetas(), GradientQualityCallback(1)]).logger.history
    assert {key for key in history if key.startswith("gradient/")} == {"gradient/cosine"}
    steps = th.stack(thetas).diff(dim=0)
    expected = th.cosine_similarity(steps[1:], steps[:-1]).tolist()
    assert len(expected) >= 2
    assert history["gradient/cosine"] == pytest.approx(expected)


def test_a_single_episode_has_no_variance_to_log():
    model = REINFORCE("MlpPolicy", Tree(), baseline="none", n_episodes=1, device="cpu")
    model.set_logger(Recorded())
    history = model.learn(8, GradientQualityCallback(1)).logger.history
    assert "gradient/snr" not in history
    assert len(history["gradient/cosine"]) == 2


def test_tensorboard_gets_it(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    model = REINFORCE("MlpPolicy", Corridor((2, 3)), device="cpu")
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(96, GradientQualityCallback(1), log_interval=1)
    tags = EventAccumulator(str(tmp_path)).Reload().Tags()["scalars"]
    assert {"gradient/snr", "gradient/noise_scale", "gradient/variance/none", "gradient/variance/time_mean"} <= set(
        tags
    )


def test_a_users_mistake_is_named():
    for kwargs, message in (
        ({"every": 0}, "every must be at least 1, got 0"),
        ({"max_episodes": 1}, "max_episodes must be at least 2, got 1"),
    ):
        with pytest.raises(ValueError, match=message):
            GradientQualityCallback(**kwargs)
    with pytest.raises(ValueError, match="got 'median'"):
        train(GradientQualityCallback(baselines=("median",)))
    with pytest.raises(ValueError, match="no critic"):
        train(GradientQualityCallback(baselines=("value",)), baseline="none")


def test_nothing_here_needs_the_extras():
    """Neither training nor the lab, but for its pictures, where matplotlib and pandas cannot be imported."""
    script = """
import sys
sys.modules.update({"matplotlib": None, "pandas": None})
from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import GradientQualityCallback, PitfallCallback, check_gradient, compare_baselines
model = REINFORCE("MlpPolicy", "CartPole-v1", device="cpu", seed=0)
model.learn(128, [GradientQualityCallback(1), PitfallCallback()])
print(compare_baselines(model, 5), check_gradient(model).passed)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("True\n")
