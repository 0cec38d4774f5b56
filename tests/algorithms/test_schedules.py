"""Learning rates, the temperature and the floor under the noise follow their schedules and what callbacks set."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Corridor
from gymnasium import spaces
from models import both, make
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce import REINFORCE


def rate_of(optimizer):
    return optimizer.param_groups[0]["lr"]


def test_an_overshooting_last_rollout_trains_at_no_negative_rate():
    model = make("steps", n_steps=60, learning_rate=lambda progress: progress * 1e-3)
    rates = Record(lambda model: rate_of(model.policy.optimizer), at="step")
    model.learn(100, callback=rates, log_interval=None)
    assert model.num_timesteps == 120 and rate_of(model.policy.optimizer) == 0 and min(rates.records) >= 0


def temperature_of(model):
    """τ, as the output of the last layer shows it."""
    layer, x = model.policy.action_net, th.ones(1, model.policy.action_net.in_features)
    with th.no_grad():
        return (th.nn.functional.linear(x, layer.weight, layer.bias) / layer(x)).mean().item()


def test_schedules_are_followed():
    def falling(start):
        return LinearSchedule(start, start / 2, 1.0)

    model = make(
        "steps", n_steps=16, learning_rate=falling(1e-3), critic_learning_rate=falling(4e-3), ent_coef=falling(0.1),
        temperature=falling(2.0),
    )  # fmt: skip
    temperatures = Record(temperature_of, at="rollout_start")
    model.learn(64, callback=temperatures)
    assert temperatures.records == pytest.approx([2.0, 1.75, 1.5, 1.25])
    assert rate_of(model.policy.optimizer) == pytest.approx(5e-4)
    assert rate_of(model.critic_optimizer) == pytest.approx(2e-3)
    model.learn(16, callback=temperatures)
    assert temperatures.records[-1] == pytest.approx(2.0)


def test_the_schedule_of_the_entropy_bonus_is_followed():
    """At the end of training the gradient is the one without a bonus, if the schedule has fallen to 0."""
    norms = []
    for ent_coef in (lambda progress: 100.0 * (progress > 0.75), 0.0, 100.0):
        model = make("steps", ent_coef=ent_coef, learning_rate=0.0, max_grad_norm=None, seed=0)
        with th.no_grad():
            model.policy.action_net.bias[0] = 2.0
        norms.append(model.learn(16).logger.name_to_value["train/grad_norm"])
    assert norms[0] == pytest.approx(norms[1]) and norms[2] > 2 * norms[1]


@both
@pytest.mark.parametrize(("name", "value"), [("learning_rate", 0.25), ("lr_schedule", lambda progress: 0.25)])
def test_a_learning_rate_set_later_is_the_rate_of_each_optimizer(name, value, kind):
    model = make(kind, learning_rate=1e-3).learn(16)
    setattr(model, name, value)
    model.learn(16, reset_num_timesteps=False)
    optimizers = [model.policy.optimizer, getattr(model, "critic_optimizer", model.policy.optimizer)]
    assert [rate_of(optimizer) for optimizer in optimizers] == [0.25, 0.25]


@pytest.mark.parametrize("space", [spaces.Discrete(2), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3)], ids=str)
def test_temperature_divides_the_logits(space):
    models = [make("steps", Corridor(action_space=space), temperature=t, seed=0) for t in (1.0, 0.25)]
    with th.no_grad():
        models[0].policy.action_net.weight.mul_(4)
        models[0].policy.action_net.bias.mul_(4)
    obs = th.randn(5, 3)
    actions = th.zeros((5, *space.shape), dtype=th.long if space.shape == () else th.float)
    th.testing.assert_close(*(model.policy.evaluate_actions(obs, actions)[1:] for model in models))


def test_a_temperature_that_a_callback_sets_at_the_start_of_a_rollout_acts_in_it():
    change = Record(lambda model: setattr(model, "temperature", 5.0 + model.num_timesteps), at="rollout_start")
    temperatures = Record(temperature_of, at="step")
    make("steps", n_steps=4).learn(8, callback=[change, temperatures])
    assert temperatures.records == pytest.approx([5.0] * 4 + [9.0] * 4)


def test_temperature_may_fall_to_zero_before_the_end(tmp_path):
    """A loaded model acts at the last temperature."""
    temperatures = Record(temperature_of)
    model = make("steps", n_steps=16, temperature=LinearSchedule(1.0, 0.0, 0.5)).learn(64, callback=temperatures)
    assert temperatures.records == pytest.approx([1.0, 0.5, 1e-3, 1e-3])
    model.save(tmp_path / "model")
    assert temperature_of(REINFORCE.load(tmp_path / "model", device="cpu")) == pytest.approx(1e-3)


@pytest.mark.parametrize("use_sde", [True, False])
def test_min_std_is_a_floor_after_a_load(use_sde, tmp_path):
    low = {"policy_kwargs": {"log_std_init": -3.0}, "use_sde": use_sde}
    REINFORCE("MlpPolicy", "Pendulum-v1", **low).save(tmp_path / "model")
    model = REINFORCE.load(tmp_path / "model", env=gym.make("Pendulum-v1"), min_std=0.5, learning_rate=0.0)
    assert model.learn(32).policy.log_std.exp().min().item() == pytest.approx(0.5)


@pytest.mark.parametrize("use_sde", [True, False])
def test_a_floor_follows_its_schedule(use_sde, tmp_path):
    def narrow(model):
        model.policy.log_std.data.fill_(-9.0)

    kwargs = {"min_std": LinearSchedule(0.8, 0.4, 1.0), "n_steps": 16, "learning_rate": 0.0, "use_sde": use_sde}
    model = REINFORCE("MlpPolicy", "Pendulum-v1", **kwargs, device="cpu")
    stds = Record(lambda model: model.policy.log_std.exp().mean().item(), at="step")
    model.learn(64, callback=[Record(narrow, at="rollout_start"), Record(narrow, at="rollout_end"), stds])
    assert stds.records == pytest.approx([0.8] * 16 + [0.7] * 16 + [0.6] * 16 + [0.5] * 16)
    # A model that is saved has the floor of the progress made
    assert model.policy.log_std.exp().mean().item() == pytest.approx(0.4)
    assert model.logger.name_to_value["train/std"] == pytest.approx(0.4)
    model.save(tmp_path / "model")
    model = REINFORCE.load(tmp_path / "model", env=model.env)
    narrow(model)
    model.learn(16, callback=stds)
    assert stds.records[-1] == pytest.approx(0.8)


def test_min_std_above_1_is_refused_where_the_deviation_is_no_exponential():
    arguments = {"use_sde": True, "policy_kwargs": {"use_expln": True, "log_std_init": -3.0}}
    policy = REINFORCE("MlpPolicy", "Pendulum-v1", min_std=0.5, **arguments).policy
    assert policy.action_dist.get_std(policy.log_std).min().item() == pytest.approx(0.5)
    with pytest.raises(ValueError, match="min_std must be at most 1 with use_expln=True, got 5"):
        REINFORCE("MlpPolicy", "Pendulum-v1", min_std=5.0, **arguments)


def test_a_floor_that_a_callback_sets_at_the_start_of_a_rollout_holds_for_the_noise_of_gsde():
    change = Record(lambda model: setattr(model, "min_std", 100.0), at="rollout_start")
    arguments = {"use_sde": True, "sde_sample_freq": -1, "policy_kwargs": {"log_std_init": -3.0}}
    model = REINFORCE("MlpPolicy", "Pendulum-v1", n_steps=64, seed=0, **arguments).learn(64, callback=change)
    assert np.std(model.rollout_buffer.actions) > 10


def test_what_a_callback_sets_is_used():
    values = {"ent_coef": 1e6, "temperature": 3.0, "gamma": 0.5}
    model = make("steps", Corridor((100,)), max_grad_norm=None)
    returns = model.learn(32, callback=At(8, lambda model: vars(model).update(values))).rollout.returns
    assert model.logger.name_to_value["train/grad_norm"] > 100
    assert temperature_of(model) == pytest.approx(3)
    th.testing.assert_close(returns[:-1], 1 + 0.5 * returns[1:])


def test_a_policy_that_is_saved_alone_has_no_temperature(tmp_path):
    model = make("steps", temperature=0.25, seed=0)
    model.policy.save(tmp_path / "policy")
    obs = th.zeros(1, 4) + 1
    alone = type(model.policy).load(tmp_path / "policy", device="cpu").get_distribution(obs).distribution
    with th.no_grad():
        own = model.policy.get_distribution(obs).distribution
    th.testing.assert_close(own.probs, (alone.logits / 0.25).softmax(-1).detach())


def test_a_schedule_may_end_below_zero_by_rounding():
    """LinearSchedule(0.1, 0, 0.4) is −1.4e-17 after two fifths of the training."""
    schedule = LinearSchedule(0.1, 0.0, 0.4)
    assert schedule(0.6) < 0
    model = make("steps", ent_coef=schedule, learning_rate=schedule).learn(80)
    assert model._scheduled("ent_coef") == 0 and model.num_timesteps == 80
