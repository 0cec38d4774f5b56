"""What is logged of the gradient's quality."""

from copy import deepcopy

import pytest
import torch as th
from callbacks import Record
from environments import Tree
from stable_baselines3.common.callbacks import CallbackList, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import GradientQualityCallback, PitfallCallback, gradients_by_episode
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


def actor_of(model):
    """The actor's parameters, shape ``(n,)``."""
    return th.cat([p.detach().flatten() for name, p in model.policy.named_parameters() if "value_net" not in name])


def test_it_logs_every_so_many_rollouts():
    thetas = Record(actor_of, "rollout_start")
    _, history = train([thetas, GradientQualityCallback(2, ("mean", "value"))])
    variances = {f"gradient/variance/{name}" for name in ("none", "mean", "value")}
    assert set(history) == variances | {"gradient/snr", "gradient/noise_scale", "gradient/cosine"}
    assert len(history["gradient/snr"]) == 2
    # Of the last two updates before the fourth rollout
    before, after = th.stack(thetas.records[1:4]).diff(dim=0)
    assert history["gradient/cosine"] == [pytest.approx(float(th.cosine_similarity(before, after, dim=0)), abs=1e-5)]


def test_the_policy_can_be_copied_after_each_rollout():
    copies = Record(lambda model: deepcopy(model.policy), "rollout_end")
    train([GradientQualityCallback(3), copies])
    assert len(copies.records) == 4


def test_no_cosine_joins_updates_with_a_rollout_in_between_at_which_the_actor_was_frozen():
    def freeze(model):
        model.policy.action_net.requires_grad_(model.num_timesteps != 256)
        model.policy.mlp_extractor.policy_net.requires_grad_(model.num_timesteps != 256)

    frozen = Record(freeze, "rollout_start")
    _, history = train([frozen, GradientQualityCallback(1)], 640)
    assert len(history["gradient/snr"]) == 4
    assert "gradient/cosine" not in history


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

    callback = GradientQualityCallback(1, [counted], max_episodes=5)
    model, history = train(callback, 1, baseline="none", n_episodes=12, learning_rate=0.0)
    used = given[0]
    assert used.used_episodes.tolist() == model.rollout.used_episodes[[0, 3, 6, 8, 11]].tolist()
    assert evenly_spread(model.rollout, 12) is model.rollout
    gradients = gradients_by_episode(used, used.returns)[0].double()
    trace = float(gradients.var(0).sum())
    signal = float(gradients.mean(0).square().sum()) - trace / 5
    # Of the mean of all twelve episodes, as far as five know it
    assert history["gradient/snr"] == [pytest.approx(12 * signal / trace, rel=1e-3)]


def test_it_keeps_what_it_knows_from_one_learn_to_the_next():
    callback = GradientQualityCallback(1)
    model, history = train(callback, 64)
    assert "gradient/cosine" not in history
    # Two further rollouts
    model.learn(256, callback, reset_num_timesteps=False)
    assert len(model.logger.history["gradient/cosine"]) == 1


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


def test_wrong_baselines_are_refused_before_learn_resets_its_counters():
    with pytest.raises(ValueError, match="did you mean 'time_mean'"):
        GradientQualityCallback(1, "timemean")


@pytest.mark.parametrize("callback", [GradientQualityCallback, PitfallCallback])
def test_callbacks_that_do_not_pass_on_the_ends_of_rollouts_are_refused(callback):
    model = REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 2), device="cpu")
    own = callback()
    message = rf"{callback.__name__} must be given to learn\(\), not to EveryNTimesteps"
    for called in (own, CallbackList([own])):
        with pytest.raises(ValueError, match=message):
            model.learn(64, EveryNTimesteps(32, called))
    for called in (own, CallbackList([own])):
        assert model.learn(64, called).num_timesteps == 64
