"""Faults of environments are named where they come in, before parameters or statistics are touched by them."""

import gc
import os
import signal
import threading

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from models import KINDS, make
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize

NAN, INF = float("nan"), float("inf")
LENGTH = 7
all_kinds = pytest.mark.parametrize("kind", KINDS)


class Faulty(Corridor):
    """
    Does something at one step of its life, or at one reset.

    :param fault: What: returns a reward, an observation, or raises, or dies
    :param at: When
    :param value: What it returns then
    :param truncate: Whether episodes end by truncation
    :param observation_space: Its space, if it is another
    """

    def __init__(self, fault=None, at=0, value=None, truncate=False, observation_space=None):
        super().__init__((LENGTH,), truncate=truncate)
        self.observation_space = observation_space or self.observation_space
        self.fault, self.at, self.value, self.n_steps, self.n_resets = fault, at, value, 0, 0

    def observe(self):
        if self.observation_space.shape == (LENGTH,):
            return super().observe()
        return np.zeros(self.observation_space.shape, self.observation_space.dtype)

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed, options=options)
        self.n_resets += 1
        if self.n_resets == self.at:
            self.go_wrong("reset")
            obs = self.value if self.fault == "first observation" else obs
        return obs, info

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.n_steps += 1
        if self.n_steps == self.at:
            self.go_wrong("step")
            reward = self.value if self.fault == "reward" else reward
            obs = self.value if self.fault == "observation" else obs
        return obs, reward, terminated, truncated, info

    def go_wrong(self, when):
        if self.fault == f"raise in {when}":
            raise OSError("the simulator has gone")
        if self.fault == f"die in {when}":
            os.kill(os.getpid(), signal.SIGKILL)


def of_two(**fault):
    """Two environments, of which the second has the fault."""
    space = {"observation_space": fault.get("observation_space"), "truncate": fault.get("truncate", False)}
    return DummyVecEnv([lambda: Faulty(**space), lambda: Faulty(**fault)])


def statistics(env):
    rms = (env.obs_rms, env.ret_rms)
    return [np.copy(part) for each in rms for part in (each.mean, each.var, each.count)]


def bad(value):
    return np.array([value, *[0] * (LENGTH - 1)], dtype=np.float32)


NOT_FINITE = {
    "reward nan": dict(fault="reward", at=20, value=NAN),
    "reward -inf": dict(fault="reward", at=20, value=-INF),
    "reward None": dict(fault="reward", at=20, value=None),
    "observation nan": dict(fault="observation", at=20, value=bad(NAN)),
    "observation inf": dict(fault="observation", at=20, value=bad(INF)),
    "first observation": dict(fault="first observation", at=2, value=bad(NAN)),
    "later first observation": dict(fault="first observation", at=4, value=bad(INF)),
    "reset before training": dict(fault="first observation", at=1, value=bad(NAN)),
    "in the first update": dict(fault="reward", at=3, value=NAN),
}


@all_kinds
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("name", NOT_FINITE)
def test_numbers_that_are_not_finite(name, normalized, kind, tmp_path):
    if name == "reset before training" and kind == "search" and not normalized:
        pytest.skip("The search resets the environments again, and no statistics have seen it")
    env = of_two(**NOT_FINITE[name])
    env = VecNormalize(env) if normalized else env
    model = make(kind, env)
    with np.errstate(invalid="ignore"), pytest.raises(ValueError, match="environment 1"):
        model.learn(400)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    if normalized:
        assert all(np.isfinite(part).all() for part in statistics(env)) and env.training
        assert not {"reset", "step_wait", "_save_obs"} & vars(env.venv).keys()
    model.save(tmp_path / "model")
    assert KINDS[kind][0].load(tmp_path / "model", env=of_two()).learn(32).num_timesteps >= 32
    if normalized:
        env.venv = of_two()
        model.learn(32, reset_num_timesteps=False)
        assert all(np.isfinite(part).all() for part in statistics(env))


@all_kinds
def test_statistics_are_those_before_the_bad_step(kind):
    """And not, say, put back to those of some earlier update."""
    seen = []

    class Watching(VecNormalize):
        def step_wait(self):
            result = super().step_wait()
            seen.append(statistics(self))
            return result

    env = Watching(of_two(fault="reward", at=20, value=NAN))
    with pytest.raises(ValueError, match=r"reward of environment 1 is not finite: nan \(step 19 since learn\(\) began\)"):
        make(kind, env).learn(400)
    assert len(seen) == 19
    if kind != "search":
        assert all(map(np.array_equal, statistics(env), seen[-1]))


@pytest.mark.parametrize("kind", ["steps", "episodes"])
@pytest.mark.parametrize("value", [NAN, INF])
def test_a_terminal_observation_behind_vec_normalize(kind, value):
    env = VecFrameStack(VecNormalize(of_two(fault="observation", at=LENGTH, value=bad(value), truncate=True)), 2)
    with pytest.raises(ValueError, match=r"terminal observation of environment 1 is not finite.*step 6 since"):
        make(kind, env).learn(100)


def test_an_observation_of_the_very_last_step():
    model = make("steps", of_two(fault="observation", at=8, value=bad(NAN)))
    before = [parameter.clone() for parameter in model.policy.parameters()]
    with pytest.raises(ValueError, match="observation of environment 1"):
        model.learn(16)
    assert all(map(th.equal, before, model.policy.parameters()))


MALFORMED = {
    "too long": np.zeros(LENGTH + 1, np.float32),
    "one number": np.zeros(1, np.float32),
    "a scalar": 0.0,
    "a string": "x",
    "strings": np.array(["x"] * LENGTH),
    "None": None,
    "a dict": {"x": 1},
    "complex": np.ones(LENGTH) * 1j,
    "objects": np.array([None] * LENGTH),
}


@pytest.mark.parametrize("kind", ["steps", "search"])
@pytest.mark.parametrize("name", MALFORMED)
@pytest.mark.parametrize("fault", ["observation", "first observation"])
def test_observations_of_another_form(fault, name, kind):
    env = of_two(fault=fault, at=5 if fault == "observation" else 2, value=MALFORMED[name])
    model = make(kind, env)
    with pytest.raises(ValueError, match=r"observation of environment 1 must .*shape"):
        model.learn(400)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@all_kinds
def test_numbers_with_a_fraction_are_no_pixels(kind):
    space = spaces.Box(0, 255, (36, 36, 1), np.uint8)
    env = of_two(fault="first observation", at=1, value=np.full(space.shape, 0.5), observation_space=space)
    with pytest.raises(ValueError, match=r"environment 1 must have .*uint8.*float64"):
        make(kind, env, "CnnPolicy").learn(8)


@all_kinds
def test_a_dict_observation_names_its_keys(kind):
    class Dicts(Corridor):
        observation_space = property(
            lambda self: spaces.Dict(a=spaces.Box(0, 1, (2,)), b=spaces.Discrete(2)), lambda self, space: None
        )

        def observe(self):
            return {"a": np.zeros(2, np.float32)}

    with pytest.raises(ValueError, match=r"environment 0 must be a dict with keys \['a', 'b'\], got \['a'\]"):
        make(kind, Dicts(), "MultiInputPolicy").learn(8)


@all_kinds
def test_forms_that_stand_for_an_observation_are_taken(kind):
    """Lists, other floats and integers: what NumPy turns into the numbers of the space without a loss of meaning."""
    for form in (list, np.float64, lambda obs: obs.astype(int)):

        class Form(Corridor):
            def observe(self, form=form):
                return form(super().observe())

        assert make(kind, Form((3,))).learn(32).num_timesteps >= 32


@all_kinds
@pytest.mark.parametrize("value", ["x", np.ones(2), 1j])
def test_rewards_that_are_no_numbers(value, kind):
    model = make(kind, of_two(fault="reward", at=5, value=value))
    with pytest.raises(ValueError, match="reward of environment 1 must be a number"):
        model.learn(400)


def of_three(start_method, **fault):
    return SubprocVecEnv([Faulty, lambda: Faulty(**fault), Faulty], start_method=start_method)


def end(env):
    """End the workers, and let a hang of the test itself not last."""
    for process in env.processes:
        process.kill()
        process.join()
    env.closed = True


@pytest.mark.parametrize("kind", ["episodes", "search"])
@pytest.mark.parametrize(
    ("start_method", "fault"),
    [
        *(("fork", f"{end} in {when}") for end in ("raise", "die") for when in ("step", "reset")),
        ("forkserver", "raise in step"),
        ("spawn", "raise in step"),
    ],
)
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_worker_that_goes_wrong_is_named_with_its_exception(fault, start_method, kind, tmp_path):
    env = of_three(start_method, fault=fault, at=2)
    model = make(kind, env, **({"common_random_numbers": True} if kind == "search" else {}))
    watchdog = threading.Timer(60, end, [env])
    watchdog.start()
    end_of_it = r"raised OSError: the simulator has gone" if "raise" in fault else "was killed by SIGKILL"
    with pytest.raises(ConnectionError, match=f"worker of environment 1 died: it {end_of_it}"):
        model.learn(10_000)
    watchdog.cancel()
    end(env)
    model.save(tmp_path / "model")
    model.set_env(DummyVecEnv([Faulty] * 3))
    assert model.learn(32).num_timesteps >= 32


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_worker_that_died_between_two_runs():
    """The plain VecEnv would wait for ever in its reset, and in a call of a callback."""
    env = of_three("fork")
    model = make("steps", env).learn(24)
    env.processes[1].kill()
    watchdog = threading.Timer(60, end, [env])
    watchdog.start()
    for call in (lambda: model.learn(24), env.reset, lambda: env.get_attr("n_steps")):
        with pytest.raises(ConnectionError, match="worker of environment 1 died: it was killed by SIGKILL"):
            call()
    watchdog.cancel()
    end(env)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_folder_for_the_workers_notes_is_removed_with_the_environment():
    env = of_three("fork")
    make("steps", env).learn(24)
    folder = env.remotes[0].note.parent
    assert folder.is_dir()
    env.close()
    del env
    gc.collect()
    assert not folder.exists()
