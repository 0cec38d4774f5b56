"""Ctrl-C, SIGTERM, callbacks and exceptions stop training, and leave a model that can be saved and trained on."""

import os
import signal
import threading

import numpy as np
import pytest
import torch as th
from environments import Corridor
from models import KINDS, make
from stable_baselines3.common.callbacks import BaseCallback

from sb3_reinforce import REINFORCE

all_kinds = pytest.mark.parametrize("kind", KINDS)


class At(BaseCallback):
    """Does something at one step."""

    def __init__(self, step, act):
        super().__init__()
        self.step, self.act = step, act

    def _on_step(self):
        return self.act() if self.n_calls == self.step else True


def fail():
    raise RuntimeError("callback")


WAYS = {
    "false": lambda: False,
    "exception": fail,
    "SIGINT": lambda: os.kill(os.getpid(), signal.SIGINT) or True,
    "SIGTERM": lambda: os.kill(os.getpid(), signal.SIGTERM) or True,
}


@all_kinds
@pytest.mark.parametrize("way", WAYS)
def test_a_run_that_is_stopped_can_be_saved_and_gone_on_with(way, kind, tmp_path):
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    model = make(kind, Corridor((7,)), learning_rate=lambda progress: 1e-3 * progress)
    if way == "false":
        model.learn(400, At(40, WAYS[way]))
    else:
        with pytest.raises(RuntimeError if way == "exception" else KeyboardInterrupt):
            model.learn(400, At(40, WAYS[way]))
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == handlers
    assert model.num_timesteps == 40 and model._n_updates > 0
    assert_books_agree(model)
    model.save(tmp_path / "model")
    for one in (model, KINDS[kind][0].load(tmp_path / "model", env=Corridor((7,)), device="cpu")):
        one.learn(360, reset_num_timesteps=False)
        assert_books_agree(one)
        assert one.num_timesteps >= 400 and one._current_progress_remaining >= 0


def assert_books_agree(model):
    """As many steps in the optimizer as updates, at the rate of the progress of the last of them."""
    states = model.policy.optimizer.state_dict()["state"].values()
    assert {int(state["step"]) for state in states} == {model._n_updates}
    if isinstance(model, REINFORCE):
        # The search looks at the schedules when an update begins, and may have begun another one
        rate = model.policy.optimizer.param_groups[0]["lr"]
        assert rate == pytest.approx(model.lr_schedule(model._current_progress_remaining))


@all_kinds
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_update_is_finished_before_a_signal_is_handled(number, kind):
    model = make(kind, Corridor((7,)))
    model.policy.optimizer.register_step_pre_hook(
        lambda optimizer, *rest: os.kill(os.getpid(), number) if model._n_updates == 2 else None
    )
    critic_steps = []
    if kind == "steps":
        model.critic_optimizer.register_step_post_hook(lambda *rest: critic_steps.append(1))
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000)
    assert model._n_updates == 3
    assert_books_agree(model)
    if kind == "steps":
        assert len(critic_steps) == 3 * model.n_critic_updates


@pytest.mark.parametrize("order", [(signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)])
def test_each_signal_of_an_update_is_handled(order):
    seen = []
    before = signal.signal(signal.SIGTERM, lambda number, frame: seen.append(number))
    model = make("steps", Corridor((7,)))

    def both_signals(*rest):
        if model._n_updates == 2:
            for number in order:
                signal.raise_signal(number)

    model.policy.optimizer.register_step_pre_hook(both_signals)
    try:
        with pytest.raises(KeyboardInterrupt):
            model.learn(1000)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert seen == [signal.SIGTERM] and model._n_updates == 3


def test_sigterm_is_left_to_a_user_who_handles_it():
    seen = []
    before = signal.signal(signal.SIGTERM, lambda *signaled: seen.append(signaled))
    try:
        model = make("steps", Corridor()).learn(64, At(3, WAYS["SIGTERM"]))
    finally:
        signal.signal(signal.SIGTERM, before)
    assert len(seen) == 1 and model.num_timesteps == 64


def test_a_handler_that_a_callback_sets_stays():
    before = signal.getsignal(signal.SIGTERM)

    def own(number, frame):
        raise SystemExit

    try:
        make("steps", Corridor()).learn(64, At(3, lambda: signal.signal(signal.SIGTERM, own) or True))
        assert signal.getsignal(signal.SIGTERM) is own
    finally:
        signal.signal(signal.SIGTERM, before)


def test_training_in_another_thread_sets_no_handlers():
    model, errors = make("steps", Corridor()), []

    def learn():
        try:
            model.learn(64)
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=learn)
    thread.start()
    thread.join()
    assert not errors and model.num_timesteps == 64


@all_kinds
def test_a_refused_step_of_the_very_last_update(kind):
    """Rewards that are finite, but whose gradient is not."""
    extra = {"standardize_utilities": False} if kind == "search" else {"normalize_advantage": False}
    model = make(kind, Corridor((7,), reward=lambda t, action: 3e38 * (1 - 2 * (action == 0))), **extra)
    before = [parameter.clone() for parameter in model.policy.parameters()]
    with np.errstate(over="ignore"), pytest.raises(ValueError, match="finite"):
        model.learn(1)
    assert all(map(th.equal, before, model.policy.parameters())) and model._n_updates == 0
    model.set_env(Corridor((7,)))
    model.learn(64, reset_num_timesteps=False)
