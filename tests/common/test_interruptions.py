"""Ctrl-C, SIGTERM, callbacks and exceptions stop training, and leave a model that can be saved and trained on."""

import signal
import threading
from contextlib import nullcontext
from itertools import product

import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Corridor, Faulty
from gymnasium.wrappers import TimeLimit
from models import KINDS, all_kinds, make, plain
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_reinforce import REINFORCE, reinforce
from sb3_reinforce.common.interruptions import interruptible, uninterrupted


def fail(model):
    raise RuntimeError("callback")


# What a callback does at step 40, or an environment at step 52, and the error that ends training
STOPS = {
    "callback returns False": (lambda model: False, {}, None),
    "callback raises": (fail, {}, RuntimeError),
    "SIGINT": (lambda model: signal.raise_signal(signal.SIGINT), {}, KeyboardInterrupt),
    "SIGTERM": (lambda model: signal.raise_signal(signal.SIGTERM), {}, KeyboardInterrupt),
    "Ctrl-C in a step": (None, {"fault": "raise in step", "value": KeyboardInterrupt()}, KeyboardInterrupt),
    "environment raises": (None, {"fault": "raise in step", "value": TypeError("the user's own")}, TypeError),
    "reward": (None, {"fault": "reward", "value": float("nan")}, ValueError),
    "observation": (None, {"fault": "observation", "value": np.full(7, np.inf)}, ValueError),
}


# Whole episodes stop at the same places as steps; without VecNormalize, other checks find what is not finite
STOPPED = [
    *product(("steps", "search"), STOPS, [VecNormalize]),
    *product(("steps", "search"), ("reward", "observation"), [lambda env: env]),
    *product(["episodes"], ("callback returns False", "environment raises"), [VecNormalize]),
]


@pytest.mark.parametrize(("kind", "stop", "wrapper"), STOPPED)
def test_a_stopped_model_is_the_last_good_one_and_can_be_saved_and_trained_on(kind, stop, wrapper, tmp_path):
    act, fault, error = STOPS[stop]
    model = make(kind, wrapper(DummyVecEnv([lambda: Faulty(at=52, **fault)])), learning_rate=lambda left: 1e-3 * left)
    policies = Record(lambda model: plain(model.policy.state_dict()), at="step")
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with pytest.raises(error) if error else nullcontext():
        model.learn(100, [policies, At(40, act)] if act else policies)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == handlers
    assert model.num_timesteps == 40 or fault
    assert model._n_updates > 0 and plain(model.policy.state_dict()) == policies.records[-1]
    assert_counters_agree(model)
    model.save(tmp_path / "model")
    loaded = KINDS[kind][0].load(tmp_path / "model", env=Faulty(), device="cpu")
    assert plain(loaded.policy.state_dict()) == policies.records[-1]
    for each in (model, loaded):
        each.learn(60, reset_num_timesteps=False)
        assert_counters_agree(each)
        assert each.num_timesteps >= 100 and each._current_progress_remaining >= 0


def assert_counters_agree(model):
    """As many steps in the optimizer as updates, at the rate of the progress at the last update."""
    states = model.policy.optimizer.state_dict()["state"].values()
    assert {int(state["step"]) for state in states} == {model._n_updates}
    if isinstance(model, REINFORCE):
        # The search reads the schedules when an update starts, and may have started another one
        rate = model.policy.optimizer.param_groups[0]["lr"]
        assert rate == pytest.approx(model.lr_schedule(model._current_progress_remaining))


def fail_in_reset(env, number):
    reset, calls = env.reset, iter(range(1, 100))

    def reset_and_fail(**kwargs):
        returned = reset(**kwargs)
        if next(calls) == number:
            raise OSError("after the reset")
        return returned

    env.reset = reset_and_fail


def test_after_a_reset_that_fails_episodes_start_again():
    """Not with the last observation of the run before."""
    env = Corridor((50,))
    model = make("steps", env).learn(20)
    fail_in_reset(env, 1)
    with pytest.raises(OSError, match="after the reset"):
        model.learn(20)
    rollouts = Record(lambda model: (model.rollout.observations[:, 0].argmax(-1), model.rollout.timesteps[:, 0]))
    model.learn(16, rollouts, reset_num_timesteps=False)
    assert plain(rollouts.records) == plain([[th.arange(i, i + 8)] * 2 for i in (0, 8)])


def test_after_a_reset_between_rollouts_that_fails_episodes_start_again():
    """Also where the user changes from whole episodes to steps."""
    cut, whole = TimeLimit(Corridor((7,)), 3), Corridor((7,))
    # After the reset at the start and the one after its first episode
    fail_in_reset(whole, 3)
    model = make("episodes", DummyVecEnv([lambda: cut, lambda: whole]), baseline="value")
    with pytest.raises(OSError, match="after the reset"):
        model.learn(100)
    assert model.num_timesteps == 14 and model.rollout is None
    model.n_episodes, model.n_steps = None, 8
    rollout = model.learn(8, reset_num_timesteps=False).rollout
    assert th.equal(rollout.timesteps, rollout.observations.argmax(-1))
    assert not rollout.timesteps[0].any()


def test_an_error_at_the_start_of_a_rollout_leaves_the_last_one_for_train():
    model = make("steps", Corridor((50,)))
    starts = Record(lambda model: model.num_timesteps < 8 or fail(model), at="rollout_start")
    with pytest.raises(RuntimeError, match="callback"):
        model.learn(16, starts)
    np.testing.assert_array_equal(model.rollout_buffer.returns, model.rollout.returns.float())
    assert model.rollout_buffer.returns.any()


def test_timesteps_are_right_after_an_interruption_behind_a_rollout(monkeypatch):
    model = make("steps", Corridor((50,)))

    def interrupt(env):
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(reinforce, "has_given_seeds", interrupt)
    with pytest.raises(KeyboardInterrupt):
        model.learn(16)
    model.learn(8, reset_num_timesteps=False)
    rollout = model.rollout
    assert th.equal(rollout.timesteps[:, 0], rollout.observations[:, 0].argmax(-1))


@all_kinds
def test_an_interruption_leaves_gradients_on(kind):
    """Where it comes as a block of ``th.no_grad`` ends."""

    class Ending(Corridor):
        def step(self, action):
            th.set_grad_enabled(False)
            raise KeyboardInterrupt

    with th.enable_grad():
        with pytest.raises(KeyboardInterrupt):
            make(kind, Ending()).learn(8)
        assert th.is_grad_enabled()


def signal_in_third_update(model, *numbers):
    def send(*_):
        if model._n_updates == 2:
            for number in numbers:
                signal.raise_signal(number)

    model.policy.optimizer.register_step_pre_hook(send)


@all_kinds
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_update_is_finished_before_a_signal_is_handled(number, kind):
    model, critic_steps = make(kind, Corridor((7,))), []
    signal_in_third_update(model, number)
    if kind == "steps":
        model.critic_optimizer.register_step_post_hook(lambda *_: critic_steps.append(1))
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000)
    assert model._n_updates == 3
    assert_counters_agree(model)
    assert len(critic_steps) == (3 * model.n_critic_updates if kind == "steps" else 0)


@pytest.mark.parametrize("order", [(signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)])
def test_each_signal_of_an_update_is_handled(order):
    seen = []
    signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    model = make("steps", Corridor((7,)))
    signal_in_third_update(model, *order)
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000)
    assert seen == [signal.SIGTERM] and model._n_updates == 3


def test_sigterm_is_left_to_a_user_who_handles_it():
    seen = []
    signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    assert make("steps", Corridor()).learn(64, At(3, STOPS["SIGTERM"][0])).num_timesteps == 64
    assert seen == [signal.SIGTERM]


def test_training_in_another_thread_sets_no_handlers():
    model = make("steps", Corridor())
    thread = threading.Thread(target=model.learn, args=(64,))
    thread.start()
    thread.join()
    # An exception in the thread would be a warning, and so an error
    assert model.num_timesteps == 64


def test_a_block_within_a_block_waits_for_the_end_of_both():
    finished = []
    with pytest.raises(KeyboardInterrupt), interruptible(), uninterrupted:
        with uninterrupted:
            signal.raise_signal(signal.SIGINT)
        finished.append(True)
    assert finished


def test_a_block_in_another_thread_delays_no_signal():
    inside, end = threading.Event(), threading.Event()

    def block():
        with uninterrupted:
            inside.set()
            end.wait()

    thread = threading.Thread(target=block)
    thread.start()
    inside.wait()
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():
            signal.raise_signal(signal.SIGINT)
            pytest.fail("the signal waits for the other thread")
    finally:
        end.set()
        thread.join()
