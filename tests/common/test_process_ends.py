"""However one process ends, all end, and the last good model stays."""

import os
import signal
import socket
import subprocess
from functools import partial
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client

import gymnasium as gym
import pytest
from callbacks import At
from environments import Corridor
from models import KINDS, make, plain
from processes import TORCHRUN, in_processes
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce.common import processes
from sb3_reinforce.common.processes import ProcessError, Processes


class Acts(gym.Wrapper):
    """Calls a function in its 30th step."""

    def __init__(self, env, act):
        super().__init__(env)
        self.act = act
        self.n_steps = 0

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
    return ProcessError(f"Process {rank} of 2 has stopped: {error}")


DEAD = ProcessError("Process 1 of 2 has died, or ended without a message")
INTERRUPTED = "KeyboardInterrupt"
# What happens in which process, the errors of both, and with which kinds of updates
STOPS = {
    "callback returns False": (0, "callback", lambda model: False, (None, None), KINDS),
    "callback raises": (0, "callback", fail, (OSError("broken"), named(0, "OSError: broken")), ["steps"]),
    "environment raises": (1, "step", fail, (named(1, "OSError: broken"), OSError("broken")), ["steps", "search"]),
    "SIGINT": (1, "step", partial(send, signal.SIGINT), (named(1, INTERRUPTED), KeyboardInterrupt()), ["steps"]),
    "SIGTERM": (0, "step", partial(send, signal.SIGTERM), (KeyboardInterrupt(), named(0, INTERRUPTED)), ["search"]),
    "SIGKILL": (1, "step", partial(send, signal.SIGKILL), (DEAD, None), ["steps", "search"]),
}  # fmt: skip


def stop(rank, kind, name, folder):
    where, how, act, *_ = STOPS[name]
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
    return repr(error), model._n_updates > 0, policy


@pytest.mark.parametrize(("name", "kind"), [(name, kind) for name, values in STOPS.items() for kind in values[-1]])
def test_an_end_in_one_process_ends_all_and_leaves_the_last_good_model(name, kind, tmp_path):
    first, second = in_processes(2, partial(stop, kind=kind, name=name, folder=tmp_path), tmp_path)
    errors = STOPS[name][3]
    assert first[:2] == (repr(errors[0]), True)
    assert [path.name for path in tmp_path.glob("model*")] == ["model_0.zip"]
    assert second is None if name == "SIGKILL" else second[0] == repr(errors[1])
    # Both have dropped the same rollout
    assert name != "callback returns False" or first[2] == second[2]
    loaded = KINDS[kind][0].load(tmp_path / "model_0", env=Corridor((3,)), device="cpu")
    assert plain(loaded.policy.state_dict()) == first[2]
    loaded.learn(20)


def meet(rank):
    """Strangers connect before process 1: one leaves at once, one speaks HTTP, one has another key."""

    def connect_after_strangers(address, authkey):
        socket.create_connection(address).close()
        with socket.create_connection(address) as stranger:
            stranger.sendall(b"GET / HTTP/1.1")
        with pytest.raises(AuthenticationError):
            Client(address, authkey=b"another")
        return Client(address, authkey=authkey)

    processes.Client = connect_after_strangers
    with Processes() as group:
        return group.exchange(rank)


def test_strangers_are_not_let_in(tmp_path):
    assert in_processes(2, meet, tmp_path) == [[0, 1], [0, 1]]


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
    script = [tmp_path / "train.py", tmp_path / "model"]
    ended = subprocess.run([*TORCHRUN, *script], capture_output=True, text=True, timeout=120)
    assert f"ProcessError: {DEAD}" in ended.stderr
    # Only process 0 prints
    assert ended.stdout.count("Using cpu device") == 1
    assert KINDS["steps"][0].load(tmp_path / "model.zip")._n_updates == 6
