"""Faults of environments are named where they come in, before parameters or statistics are touched by them."""

import gc
import os
import signal
import threading
import time
from copy import deepcopy

import cloudpickle
import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from models import KINDS, make
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

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
        if self.fault in signal.Signals.__members__ and when == "step":
            os.kill(os.getppid(), signal.Signals[self.fault])
            # The answer comes when the learner has long stopped waiting for it
            time.sleep(0.2)


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
        assert type(env.venv) is DummyVecEnv and "_save_obs" not in vars(env.venv)
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
    with pytest.raises(
        ValueError, match=r"reward of environment 1 is not finite: nan \(step 19 since learn\(\) began\)"
    ):
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
    "ragged": [[0.0], [0.0, 1.0]],
}
# Where the second environment returns it, and in which step of all of them
WHEN = {
    "step": (dict(fault="observation", at=5), 4),
    "end": (dict(fault="observation", at=LENGTH), LENGTH - 1),
    "truncation": (dict(fault="observation", at=LENGTH, truncate=True), LENGTH - 1),
    "reset": (dict(fault="first observation", at=2), LENGTH - 1),
}
WRAPPERS = {"bare": lambda env: env, "monitor": VecMonitor, "normalize": VecNormalize}


@pytest.mark.parametrize("kind", ["steps", "search"])
@pytest.mark.parametrize("name", MALFORMED)
@pytest.mark.parametrize("when", WHEN)
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_observations_of_another_form(wrapper, when, name, kind):
    fault, step = WHEN[when]
    # The search resets its environments once more before its first step
    fault = fault | {"at": 3} if (when, kind) == ("reset", "search") else fault
    model = make(kind, WRAPPERS[wrapper](of_two(value=MALFORMED[name], **fault)))
    with pytest.raises(ValueError, match=rf"observation of environment 1 must .*\(step {step} since learn\(\) began\)"):
        model.learn(400)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@pytest.mark.parametrize("wrapper", ["bare", "normalize"])
@pytest.mark.parametrize("when", WHEN)
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_observations_of_another_form_from_a_worker(when, wrapper):
    fault, step = WHEN[when]
    for name in ("too long", "a string", "complex"):
        env = of_three("fork", value=MALFORMED[name], **fault)
        model = make("steps", WRAPPERS[wrapper](env))
        with pytest.raises(ValueError, match=rf"observation of environment 1 must .*\(step {step} since"):
            model.learn(400)
        env.close()


@all_kinds
@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)], ids=str)
@pytest.mark.parametrize("value", [-1, 3, 0.5])
def test_categories_that_the_space_does_not_have(value, space, kind):
    value = np.full(space.shape, value)[()]
    env = of_two(fault="observation", at=5, value=value, observation_space=space)
    with pytest.raises(ValueError, match=r"observation of environment 1 must .*\(step 4 since"):
        make(kind, env).learn(400)


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


@pytest.mark.parametrize("kind", ["steps", "search"])
@pytest.mark.parametrize("value", ["x", "1.0", np.ones(2), 1j, np.complex128(1), None], ids=repr)
@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_rewards_that_are_no_numbers(wrapper, value, kind):
    model = make(kind, WRAPPERS[wrapper](of_two(fault="reward", at=5, value=value)))
    with pytest.raises(ValueError, match=r"reward of environment 1 must be a number.*\(step 4 since"):
        model.learn(400)


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_rewards_of_a_worker_that_are_no_numbers():
    for value in ("x", np.ones(2), 1j):
        env = of_three("fork", fault="reward", at=5, value=value)
        with pytest.raises(ValueError, match=r"reward of environment 1 must be a number.*\(step 4 since"):
            make("steps", env).learn(400)
        env.close()


@all_kinds
@pytest.mark.parametrize("value", [np.float64(2), np.int64(2), np.array(2.0), th.tensor(2.0), True, 2], ids=repr)
def test_forms_that_stand_for_a_reward_are_taken(value, kind):
    model = make(kind, Corridor((3,), reward=lambda t, action: value)).learn(32)
    assert model.ep_info_buffer[0]["r"] == 3 * float(value)


def of_three(start_method, **fault):
    truncate = {"truncate": fault.get("truncate", False)}
    envs = [lambda: Faulty(**truncate), lambda: Faulty(**fault), lambda: Faulty(**truncate)]
    return SubprocVecEnv(envs, start_method=start_method)


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
    env.close()
    watchdog.cancel()
    assert all(not process.is_alive() for process in env.processes)
    model.save(tmp_path / "model")
    model.set_env(DummyVecEnv([Faulty] * 3))
    assert model.learn(32).num_timesteps >= 32


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_the_only_worker_dies():
    """Nobody else holds its end of the pipe open then."""
    env = SubprocVecEnv([lambda: Faulty(fault="die in step", at=2)], start_method="fork")
    with pytest.raises(ConnectionError, match="worker of environment 0 died: it was killed by SIGKILL"):
        make("steps", env).learn(24)
    env.close()
    assert env.closed


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


class Twice(VecEnvWrapper):
    """Makes two steps with the same actions."""

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.again = actions

    def step_wait(self):
        self.venv.step(self.again)
        return self.venv.step(self.again)


def test_wrappers_that_make_several_steps_are_guarded_too():
    env = VecNormalize(Twice(of_two(fault="reward", at=5, value=NAN)))
    with pytest.raises(ValueError, match="reward of environment 1"):
        make("steps", env).learn(400)
    assert all(np.isfinite(part).all() for part in statistics(env))


@pytest.mark.parametrize("kind", ["steps", "search"])
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM"])
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_step_of_workers_that_is_broken_off(number, kind):
    """The answers that nobody has waited for are not taken for those to what is asked next."""
    env = of_three("fork", fault=number, at=20)
    watchdog = threading.Timer(60, end, [env])
    watchdog.start()
    model = make(kind, env)
    with pytest.raises(KeyboardInterrupt):
        model.learn(400)
    before = env.get_attr("n_steps")
    n_steps = model.num_timesteps
    model.learn(90, reset_num_timesteps=False)
    made = [after - each for after, each in zip(env.get_attr("n_steps"), before, strict=True)]
    assert made == [(model.num_timesteps - n_steps) // 3] * 3
    env.close()
    watchdog.cancel()


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_workers_are_closed_after_a_step_that_is_broken_off():
    env = of_three("fork", fault="SIGTERM", at=5)
    watchdog = threading.Timer(60, end, [env])
    watchdog.start()
    with pytest.raises(KeyboardInterrupt):
        make("steps", env).learn(400)
    env.close()
    watchdog.cancel()
    assert [process.exitcode for process in env.processes] == [0, 0, 0]


class Once(BaseCallback):
    """Does something at the third step."""

    def __init__(self, act):
        super().__init__()
        self.act = act

    def _on_step(self):
        if self.n_calls == 3:
            self.act(self.model)
        return True


@all_kinds
def test_a_nested_vec_normalize_is_guarded_too(kind):
    inner = VecNormalize(of_two(fault="reward", at=20, value=NAN))
    outer = VecNormalize(VecFrameStack(inner, 2))
    with pytest.raises(ValueError, match="reward of environment 1 is not finite"):
        make(kind, outer).learn(400)
    assert all(np.isfinite(part).all() for env in (inner, outer) for part in statistics(env))


class Spoiling(VecEnvWrapper):
    """
    Makes of finite numbers ones that are not.

    :param what: Which numbers
    :param at: The step at which it does so; the reset if 0
    """

    def __init__(self, env, what, at):
        super().__init__(env)
        self.what, self.at, self.n_steps = what, at, 0

    def reset(self):
        obs = self.venv.reset()
        obs[1, 0] = NAN if self.at == 0 else obs[1, 0]
        self.at = -1 if self.at == 0 else self.at
        return obs

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        self.n_steps += 1
        if self.n_steps == self.at:
            {"reward": rewards, "observation": obs[:, 0]}[self.what][1] = NAN
        return obs, rewards, dones, infos


@all_kinds
@pytest.mark.parametrize(("what", "at"), [("reward", 11), ("observation", 11), ("observation", 0)])
def test_what_a_wrapper_below_vec_normalize_makes_of_the_numbers(what, at, kind):
    spoiling = Spoiling(VecMonitor(of_two()), what, at)
    env = VecNormalize(spoiling)
    model = make(kind, env)
    with pytest.raises(ValueError, match=f"{what} of environment 1 is not finite"):
        model.learn(400)
    assert all(np.isfinite(part).all() for part in statistics(env))
    assert not vars(spoiling).keys() & {"step_wait", "reset"}
    assert model.learn(32, reset_num_timesteps=False).num_timesteps >= 32


@all_kinds
@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
@pytest.mark.parametrize(
    ("fault", "value"), [("reward", 1e200), ("reward", -1e60), ("observation", np.full(LENGTH, -1e200))]
)
def test_numbers_beyond_float32_are_not_taken_for_finite_ones(fault, value, wrapper, kind):
    space = spaces.Box(-INF, INF, (LENGTH,), np.float64)
    env = wrapper(of_two(fault=fault, at=20, value=value, observation_space=space))
    model = make(kind, env)
    told = rf"{fault} of .*environment 1.* is not finite"
    with np.errstate(over="ignore"), pytest.raises(ValueError, match=told):
        model.learn(400)


@all_kinds
def test_environments_in_a_callback_are_as_ever(kind, tmp_path):
    """They can be asked, saved and copied while a model learns, and a copy leads a life of its own."""
    env = VecNormalize(DummyVecEnv([lambda: Monitor(Faulty())] * 2))

    def act(model):
        model.save(tmp_path / "model")
        env.save(tmp_path / "statistics")
        assert env.env_is_wrapped(Monitor) == [True, True] and env.unwrapped.num_envs == 2
        before = env.get_attr("n_steps")
        copy = deepcopy(env.venv)
        assert type(copy) is DummyVecEnv
        copy.reset()
        copy.step(np.zeros(2, int))
        assert copy.get_attr("n_steps") == [before[0] + 1] * 2 and env.get_attr("n_steps") == before
        with pytest.raises(AttributeError):
            env.no_such_attribute  # noqa: B018

    model = make(kind, env).learn(40, callback=Once(act))
    assert model.num_timesteps >= 40 and type(env.venv) is DummyVecEnv
    VecNormalize.load(tmp_path / "statistics", of_two())
    assert KINDS[kind][0].load(tmp_path / "model", env=of_two(), device="cpu").learn(16).num_timesteps >= 16


class Copyable(VecEnvWrapper):
    """As VecNormalize, without what cannot be copied of a wrapper."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()

    def __getstate__(self):
        return {key: value for key, value in vars(self).items() if key != "class_attributes"}

    def __setstate__(self, state):
        vars(self).update(state)


@all_kinds
@pytest.mark.parametrize("copied", [deepcopy, lambda env: cloudpickle.loads(cloudpickle.dumps(env))])
def test_a_copy_of_a_wrapper_below_vec_normalize_leads_a_life_of_its_own(copied, kind):
    env = VecNormalize(Copyable(DummyVecEnv([lambda: Monitor(Faulty())] * 2)))

    def act(model):
        before = env.get_attr("n_steps")
        copy = copied(env.venv)
        copy.reset()
        copy.step(np.zeros(2, int))
        assert copy.unwrapped.get_attr("n_steps") == [before[0] + 1] * 2 and env.get_attr("n_steps") == before

    assert make(kind, env).learn(40, callback=Once(act)).num_timesteps >= 40


@all_kinds
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_learning_within_a_callback(fault, kind):
    """What another model has done with the same environments leaves them guarded."""
    env = VecNormalize(of_two(fault=fault, at=40, value=NAN if fault == "reward" else np.zeros(1)))
    other = make("steps", env)
    bases = []
    look = Once(lambda model: bases.append(env.venv.venv))
    with pytest.raises(ValueError, match=f"The {fault} of environment 1"):
        make(kind, env).learn(400, callback=Once(lambda model: other.learn(24, callback=look)))
    assert len(bases) == 1 and type(bases[0]) is DummyVecEnv
    assert other.num_timesteps == 32 and type(env.venv) is DummyVecEnv and "_save_obs" not in vars(env.venv)
    assert all(np.isfinite(part).all() for part in statistics(env))
