"""W processes of n environments are one process with W·n: the same parameters, steps, logs, and ends."""

import os
import signal
import subprocess
import sys
from functools import partial

import enumeration
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import At
from environments import Corridor
from models import KINDS, Scaled, all_kinds, make, plain
from processes import ActAsRecorded, RecordRollouts, Replay, in_processes, logged
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import is_leader
from sb3_reinforce.common.processes import ProcessError
from sb3_reinforce.estimation import BASELINES
from sb3_reinforce.recurrent import RecurrentREINFORCE
from sb3_reinforce.sampling.collection import ROWS
from sb3_reinforce.sampling.columns import Columns, join

SEARCHES = {
    "central": {"estimator": "central", "n_delta": 3},
    "two utilities": {"estimator": "forward", "n_delta": 5, "perturbation": "coordinate"},
    "regression": {"estimator": "regression", "n_delta": 40, "n_eval_episodes": 2},
}


def search(n_envs, rank, **kwargs):
    model = make("search", make_vec_env("CartPole-v1", n_envs), seed=5, **{"common_random_numbers": True, **kwargs})
    model.learn(10**6, lambda values, _: model._n_updates < 5)
    return plain(model.theta), model._n_updates, len(model.ep_info_buffer)


@pytest.mark.parametrize("kwargs", SEARCHES.values(), ids=SEARCHES)
def test_finite_difference_has_the_same_parameters_bit_for_bit(kwargs, tmp_path):
    alone = search(4, 0, **kwargs)
    for size in (2, 4):
        answers = in_processes(size, partial(search, 4 // size, **kwargs), tmp_path)
        assert [answer[:2] for answer in answers] == [alone[:2]] * size
        assert answers[0][2] == alone[2]


EXTENTS = {"steps": {"n_steps": 12}, "episodes": {"n_steps": None, "n_episodes": 5}}
ROLLOUTS = {
    f"{name} {extent}": ({"baseline": name, **kwargs}, lambda env: env)
    for name in BASELINES
    for extent, kwargs in EXTENTS.items()
} | {
    "shared extractor": ({"policy_kwargs": {"net_arch": [4], "features_extractor_class": Scaled}}, lambda env: env),
    "total return": ({"baseline": "mean", "reward_to_go": False, **EXTENTS["steps"]}, lambda env: env),
    "normalized": ({"normalize_advantage": True, "normalize_by": "episodes", **EXTENTS["episodes"]}, VecNormalize),
    "schedules": ({"temperature": lambda left: 1 + left, "learning_rate": lambda left: 0.01 * left}, VecNormalize),
    "fewer episodes than processes": ({"n_steps": None, "n_episodes": 2}, lambda env: env),
    "recurrent": ({"n_episodes": 5, "baseline": "value"}, lambda env: env),
    "recurrent steps": ({"n_steps": 5, "baseline": "value"}, lambda env: env),
}


def corridors(n_envs, wrapper=lambda env: env, lengths=(2, 3, 4), reward=lambda t, action: float(action) - t, **kwargs):
    return wrapper(make_vec_env(lambda: Corridor(lengths, reward, **kwargs), n_envs))


def build(name, env):
    kwargs, wrapper = ROLLOUTS[name]
    if name.startswith("recurrent"):
        policy_kwargs = {"lstm_hidden_size": 4, "net_arch": [4]}
        return RecurrentREINFORCE("MlpLstmPolicy", env, policy_kwargs=policy_kwargs, seed=1, device="cpu", **kwargs)
    return make("steps", wrapper(env) if not isinstance(env, Replay) else env, seed=1, **kwargs)


def state_of(model):
    return plain(model.policy.state_dict()), plain(model.get_parameters()), logged(model), model.num_timesteps


def learn_all(rank):
    """The rollouts and last states of all models, in this process."""
    answers = {}
    for name in ROLLOUTS:
        model = build(name, corridors(1, truncate=True))
        callback = RecordRollouts()
        model.learn(100, callback)
        answers[name] = (*state_of(model), callback.rollouts)
    return answers


@pytest.fixture(scope="module")
def of_three_processes(tmp_path_factory):
    return in_processes(3, learn_all, tmp_path_factory.mktemp("group"))


@pytest.mark.filterwarnings("ignore:Episodes that n_steps cuts")
@pytest.mark.parametrize("name", ROLLOUTS)
def test_reinforce_is_one_process_that_collects_the_same_rollouts(name, of_three_processes):
    policy, *state, num_timesteps, rollouts = of_three_processes[0][name]
    model = build(name, corridors(1, truncate=True))
    model = build(name, Replay(model, rollouts, starts_over=model.n_episodes is not None))
    callback = ActAsRecorded(rollouts)
    # Processes that have played their episodes make fewer steps than the environments of one process
    model.learn(100 if model.n_steps else 10**6, callback)
    assert [*state_of(model)[:-1]] == [policy, *state]
    assert [rollout.log for rollout in callback.rollouts] == [rollout.log for rollout in rollouts]
    assert len(rollouts) > 1 and 100 <= num_timesteps <= model.num_timesteps
    for other in of_three_processes[1:]:
        assert other[name][0] == policy and not other[name][-1]


@pytest.mark.parametrize("baseline", ["none", "leave_one_out"])
def test_the_expected_gradient_of_two_processes_is_exact(baseline, monkeypatch):
    """Each process plays one episode; the shorter one is padded."""
    fill = enumeration.fill

    def fill_in_parts(model, batch):
        parts = []
        for episode in batch:
            buffer, dones = fill(model, [episode])
            columns = Columns(dones, {}, buffer.observations[-1], np.ones(1, dtype=int))
            parts.append((columns, {name: getattr(buffer, name) for name in ROWS}))
        return buffer, join(buffer, parts).dones

    model = enumeration.make_model(ragged=True, baseline=baseline)
    monkeypatch.setattr(enumeration, "fill", fill_in_parts)
    enumeration.assert_equal(enumeration.expected_gradient(model), enumeration.gradient_of_return(model))


def seen_seeds(rank):
    model = make("steps", corridors(2, VecNormalize, (3,), reward=lambda t, action: float(t)), seed=10, n_steps=3)
    model.learn(60)
    moments = [(rms.mean, rms.var, rms.count) for rms in (model.env.obs_rms, model.env.ret_rms)]
    return model.env.get_attr("np_random_seed"), model.num_timesteps, moments, len(model.ep_info_buffer)


def test_seeds_steps_episodes_and_moments_are_those_of_one_process(tmp_path):
    """In a task whose observations and rewards do not depend on the actions."""
    model = make("steps", corridors(4, VecNormalize, (3,), lambda t, action: float(t)), seed=10, n_steps=3)
    model.learn(60)
    first, second = in_processes(2, seen_seeds, tmp_path)
    assert first[0] + second[0] == model.env.get_attr("np_random_seed")
    assert first[1] == second[1] == model.num_timesteps == 60
    assert first[3] == len(model.ep_info_buffer) == 20
    for rms, found, same in zip((model.env.obs_rms, model.env.ret_rms), first[2], second[2], strict=True):
        for value, one, other in zip((rms.mean, rms.var, rms.count), found, same, strict=True):
            assert np.allclose(one, value, rtol=1e-9, atol=0) and np.array_equal(one, other)


def without_a_seed(rank):
    th.manual_seed(0)
    model = make("steps", corridors(2))
    model.learn(16)
    return [*model.env.get_attr("np_random_seed"), th.initial_seed()]


def test_processes_without_a_seed_differ_even_if_the_script_seeds_pytorch(tmp_path):
    first, second = in_processes(2, without_a_seed, tmp_path)
    assert {*first}.isdisjoint(second)


class Acts(gym.Wrapper):
    """Calls a function in its 30th step."""

    def __init__(self, env, act):
        super().__init__(env)
        self.act, self.n_steps = act, 0

    def step(self, action):
        self.n_steps += 1
        if self.n_steps == 30:
            self.act()
        return super().step(action)


def fail(*_):
    raise OSError("broken")


def send(number, *_):
    os.kill(os.getpid(), number)


def named(rank, error):
    return f"Process {rank} of 2 has stopped: {error}"


DEAD = "Process 1 of 2 has died, or ended without a message"
# What happens in which process, and the errors of both
STOPS = {
    "callback returns False": (0, "callback", lambda model: False, (None, None)),
    "callback raises": (0, "callback", fail, (OSError("broken"), ProcessError(named(0, "OSError: broken")))),
    "environment raises": (1, "step", fail, (ProcessError(named(1, "OSError: broken")), OSError("broken"))),
    "SIGINT": (
        1,
        "step",
        partial(send, signal.SIGINT),
        (ProcessError(named(1, "KeyboardInterrupt")), KeyboardInterrupt()),
    ),
    "SIGTERM": (
        0,
        "step",
        partial(send, signal.SIGTERM),
        (KeyboardInterrupt(), ProcessError(named(0, "KeyboardInterrupt"))),
    ),
    "SIGKILL": (1, "step", partial(send, signal.SIGKILL), (ProcessError(DEAD), None)),
}


def stop(rank, kind, name, folder):
    where, how, act, _ = STOPS[name]
    env = make_vec_env(lambda: Acts(Corridor((3,)), act if (rank, how) == (where, "step") else lambda: None), 1)
    model = make(kind, env, seed=0, **({"n_episodes": 8} if kind == "episodes" else {}))
    error = None
    try:
        model.learn(10**6, At(30, act) if how == "callback" else None)
    except BaseException as raised:
        error = raised
    policy = plain(model.policy.state_dict())
    model.save(folder / f"model_{rank}")
    # Alone
    os.environ["SB3_REINFORCE_PROCESSES"] = "0"
    model.learn(20, reset_num_timesteps=False)
    return repr(error), model._n_updates > 0, policy, [path.name for path in folder.glob("model*")]


@all_kinds
@pytest.mark.parametrize("name", STOPS)
def test_an_end_in_one_process_ends_all_and_leaves_the_last_good_model(name, kind, tmp_path):
    answers = in_processes(2, partial(stop, kind=kind, name=name, folder=tmp_path), tmp_path)
    errors = STOPS[name][-1]
    assert answers[0][:2] == (repr(errors[0]), True) and answers[0][3] == ["model_0.zip"]
    if name == "SIGKILL":
        assert answers[1] is None
    else:
        assert answers[1][0] == repr(errors[1])
    loaded = KINDS[kind][0].load(tmp_path / "model_0", env=Corridor((3,)), device="cpu")
    assert plain(loaded.policy.state_dict()) == answers[0][2]
    loaded.learn(20)


def differ(rank, name):
    kwargs = {"gamma": 0.9 + 0.05 * rank} if name == "gamma" else {}
    model = make("steps", corridors(1 + rank if name == "n_envs" else 1), **kwargs)
    model.learn(10)


@pytest.mark.parametrize("name", ["gamma", "n_envs"])
def test_processes_with_other_arguments_are_refused(name, tmp_path):
    first, second = in_processes(2, partial(differ, name=name), tmp_path)
    assert isinstance(first, ValueError) and "must be started with the same arguments" in str(first)
    assert name in str(first) and "process 1" in str(first)
    assert str(second) == str(first)


def test_a_process_without_a_group_is_the_leader_and_the_switch_turns_a_group_off(tmp_path, monkeypatch):
    assert is_leader()
    assert in_processes(2, lambda rank: is_leader(), tmp_path) == [True, False]
    monkeypatch.setenv("SB3_REINFORCE_PROCESSES", "0")
    assert in_processes(2, lambda rank: is_leader(), tmp_path) == [True, True]


SCRIPT = """
import os, signal, sys
import gymnasium as gym
from sb3_reinforce import REINFORCE, is_leader

class Dies(gym.Wrapper):
    n_steps = 0

    def step(self, action):
        self.n_steps += 1
        if self.n_steps == 100 and not is_leader():
            os.kill(os.getpid(), signal.SIGKILL)
        return super().step(action)

model = REINFORCE("MlpPolicy", Dies(gym.make("CartPole-v1")), n_steps=16, device="cpu", verbose=1)
try:
    model.learn(10**6)
finally:
    model.save(sys.argv[1])
"""


def test_torchrun_is_found_and_the_model_is_saved_after_a_process_has_died(tmp_path):
    (tmp_path / "train.py").write_text(SCRIPT)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    script = [tmp_path / "train.py", tmp_path / "model"]
    ended = subprocess.run([*command, *script], capture_output=True, text=True, timeout=120)
    assert f"ProcessError: {DEAD}" in ended.stderr
    # Only process 0 prints
    assert ended.stdout.count("Using cpu device") == 1
    assert KINDS["steps"][0].load(tmp_path / "model.zip")._n_updates == 6
