"""Faults of environments are named where they enter, before they touch parameters or statistics."""

from contextlib import nullcontext
from copy import deepcopy

import cloudpickle
import numpy as np
import pytest
import torch as th
from callbacks import At
from environments import Faulty, Wrapper, of_two
from gymnasium import spaces
from models import KINDS, all_kinds, both_extents, make, plain
from stable_baselines3.common.callbacks import CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize

from sb3_reinforce import FiniteDifference
from sb3_reinforce.envs.checks import BadData, check_finite

NAN, INF = float("nan"), float("inf")
bare_or_normalized = pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])


def statistics(env):
    return [np.copy(part) for rms in (env.obs_rms, env.ret_rms) for part in (rms.mean, rms.var, rms.count)]


def assert_finite_statistics(env):
    while isinstance(env, VecEnvWrapper):
        assert not isinstance(env, VecNormalize) or all(np.isfinite(part).all() for part in statistics(env))
        env = env.venv


def bad(value):
    return np.array([value, *[0] * 6], dtype=np.float32)


class Recording(VecNormalize):
    """Keeps its statistics after each step."""

    def __init__(self, env):
        super().__init__(env)
        self.seen = []

    def step_wait(self):
        result = super().step_wait()
        self.seen.append(statistics(self))
        return result


WIDE = spaces.Box(-INF, INF, (7,), np.float64)
NOT_FINITE = {
    "reward nan": dict(fault="reward", at=20, value=NAN),
    "observation nan": dict(fault="observation", at=20, value=bad(NAN)),
    "first observation": dict(fault="first observation", at=4, value=bad(INF)),
    "reset before training": dict(fault="first observation", at=1, value=bad(NAN)),
    "in the first update": dict(fault="reward", at=4, value=NAN),
    "reward beyond float32": dict(fault="reward", at=20, value=1e200),
    "observation below float32": dict(fault="observation", at=20, value=np.full(7, -1e200), observation_space=WIDE),
}
WRAPPERS = {
    "bare": lambda env: env,
    "normalized": Recording,
    "normalized twice": lambda env: VecNormalize(VecFrameStack(VecNormalize(env), 2)),
}


@all_kinds
@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize("name", NOT_FINITE)
def test_numbers_that_are_not_finite(name, wrapper, kind):
    if (name, wrapper, kind) == ("reset before training", "bare", "search"):
        pytest.skip("The search resets the environments again, and no statistics have seen it")
    fault = NOT_FINITE[name]
    env = WRAPPERS[wrapper](of_two(**fault))
    model = make(kind, env)
    message = rf"{fault['fault'].split()[-1]} of .*environment 1.* is not finite"
    with np.errstate(invalid="ignore", over="ignore"), pytest.raises(ValueError, match=message) as caught:
        model.learn(400)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert_finite_statistics(env)
    if wrapper == "normalized":
        assert env.training and f"(num_timesteps={2 * len(env.seen)})" in str(caught.value)
        # The search freezes them during an update
        assert kind == "search" or not env.seen or all(map(np.array_equal, statistics(env), env.seen[-1]))
        env.venv = of_two(observation_space=fault.get("observation_space"))
        model.learn(32, reset_num_timesteps=False)
        assert_finite_statistics(env)


@both_extents
@pytest.mark.parametrize("value", [NAN, INF])
def test_a_terminal_observation_behind_vec_normalize(kind, value):
    env = VecFrameStack(VecNormalize(of_two(fault="observation", at=7, value=bad(value), truncate=True)), 2)
    with pytest.raises(ValueError, match=r"terminal observation of environment 1 is not finite.*num_timesteps=12\)"):
        make(kind, env).learn(100)


@pytest.mark.parametrize("truncate", [True, False])
def test_an_observation_of_the_very_last_step(truncate):
    """The critic's value of it would end up in the returns."""
    at = 7 if truncate else 8
    model = make("steps", Faulty("observation", at=at, value=bad(NAN), truncate=truncate), n_steps=at)
    before = plain(model.policy.state_dict())
    with pytest.raises(ValueError, match=rf"observation of environment 0 at step {at - truncate} "):
        model.learn(at)
    assert plain(model.policy.state_dict()) == before


@bare_or_normalized
@both_extents
def test_actions_that_are_not_finite_are_not_blamed_on_the_environment(kind, wrapper):
    """The standard deviation of gSDE overflows."""
    model = make(kind, wrapper(make_vec_env("Pendulum-v1", 2)), use_sde=True)
    model.policy.log_std.data.fill_(90.0)
    with pytest.raises(ValueError, match=r"action of environment 0 is not finite.*\(num_timesteps=0\)"):
        model.learn(400)


class Suffering(Wrapper):
    """An observation becomes NaN once, and actions that are NaN spoil the rewards."""

    n_steps = 0

    def step_async(self, actions):
        self.is_spoiled = np.isnan(actions).any(axis=1)
        self.venv.step_async(np.nan_to_num(actions))

    def step_wait(self):
        obs, rewards, *rest = self.venv.step_wait()
        self.n_steps += 1
        if self.n_steps == 5:
            obs[1, 0] = NAN
        return obs, np.where(self.is_spoiled, NAN, rewards), *rest


@both_extents
@pytest.mark.parametrize("wrapper", [Suffering, lambda env: VecFrameStack(Suffering(env), 2)])
def test_an_observation_that_is_not_finite_leads_to_no_action(kind, wrapper):
    model = make(kind, wrapper(make_vec_env("Pendulum-v1", 2)))
    with pytest.raises(ValueError, match=r"observation of environment 1 at step 5 of the rollout is not finite"):
        model.learn(800)


class Huge(Wrapper):
    """Observations whose weighted sums overflow."""

    def reset(self):
        return np.full_like(self.venv.reset(), 3e38)

    def step_wait(self):
        obs, *rest = self.venv.step_wait()
        return np.full_like(obs, 3e38), *rest


def test_a_search_finds_actions_that_are_not_finite():
    env = Huge(make_vec_env("Pendulum-v1", 2))
    kwargs = {"estimator": "central", "delta_std": 1.0, "policy_kwargs": {"activation_fn": th.nn.ReLU}}
    model = FiniteDifference("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    with (
        np.errstate(over="ignore", invalid="ignore"),
        pytest.raises(ValueError, match="The policy's action of environment"),
    ):
        model.learn(800)


class Spoiling(Wrapper):
    """Makes a reward or an observation NaN in result number ``at``, of which the first is the result of a reset."""

    def __init__(self, env, what, at):
        super().__init__(env)
        self.what, self.at = what, at

    def spoil(self, obs, rewards):
        self.at -= 1
        if self.at == 0:
            {"reward": rewards, "observation": obs[:, 0]}[self.what][1] = NAN

    def reset(self):
        obs = self.venv.reset()
        self.spoil(obs, None)
        return obs

    def step_wait(self):
        obs, rewards, *rest = self.venv.step_wait()
        self.spoil(obs, rewards)
        return obs, rewards, *rest


class Twice(Wrapper):
    """Makes two steps with the same actions."""

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        self.venv.step(self.actions)
        return self.venv.step(self.actions)


@all_kinds
@pytest.mark.parametrize(
    ("what", "make_env"),
    [
        ("reward", lambda: Spoiling(VecMonitor(of_two()), "reward", 12)),
        ("observation", lambda: Spoiling(VecMonitor(of_two()), "observation", 12)),
        ("observation", lambda: Spoiling(VecMonitor(of_two()), "observation", 1)),
        ("reward", lambda: Twice(of_two(fault="reward", at=6, value=NAN))),
    ],
)
def test_numbers_that_a_wrapper_below_vec_normalize_spoils(what, make_env, kind):
    env = VecNormalize(make_env())
    model = make(kind, env)
    with pytest.raises(ValueError, match=f"{what} of environment 1 is not finite"):
        model.learn(400)
    assert_finite_statistics(env)
    assert model.learn(32, reset_num_timesteps=False).num_timesteps >= 32


class Copyable(Wrapper):
    """Leaves out what cannot be copied of a wrapper."""

    def __getstate__(self):
        return {key: value for key, value in vars(self).items() if key != "class_attributes"}

    def __setstate__(self, state):
        vars(self).update(state)


@pytest.mark.parametrize("copied", [deepcopy, lambda env: cloudpickle.loads(cloudpickle.dumps(env))])
def test_a_copy_that_a_callback_makes_is_independent(copied):
    """It moves no other environment, and its rewards are its own; it is guarded too."""
    env = VecNormalize(Copyable(of_two()))

    def act(model):
        before, copy = env.get_attr("n_steps"), copied(env.venv)
        assert type(copy) is type(env.venv)
        single = copy.unwrapped.envs[1]
        single.fault, single.at, single.value = "reward", single.n_steps + 1, 7.0
        copy.reset()
        assert copy.step(np.zeros(2, int))[1].tolist() == [1.0, 7.0]
        assert copy.unwrapped.get_attr("n_steps") == [before[0] + 1] * 2 and env.get_attr("n_steps") == before
        single.at, single.value = single.n_steps + 1, "x"
        with pytest.raises(ValueError, match="reward of environment 1 must be a number"):
            make("steps", copy).learn(8)

    assert make("steps", env).learn(40, callback=At(3, act)).num_timesteps >= 40


@all_kinds
def test_environments_may_be_used_in_a_callback(kind, tmp_path):
    """They can be queried, saved and evaluated, and keep what a user sets on them."""

    def stacked():
        return VecFrameStack(DummyVecEnv([lambda: Monitor(Faulty())] * 2), 2)

    env = VecNormalize(stacked())
    evaluation = EvalCallback(VecNormalize(stacked()), n_eval_episodes=1, eval_freq=5, verbose=0)

    def act(model):
        model.save(tmp_path / "model")
        env.save(tmp_path / "statistics")
        assert env.env_is_wrapped(Monitor) == [True, True] and env.unwrapped.num_envs == 2
        with pytest.raises(AttributeError):
            env.no_such_attribute  # noqa: B018
        env.mark = env.venv.mark = env.venv.venv.mark = "the user's"

    model = make(kind, env).learn(40, callback=CallbackList([At(3, act), evaluation]))
    assert model.num_timesteps >= 40 and evaluation.n_calls > 5
    assert [vars(each)["mark"] for each in (env, env.venv, env.unwrapped)] == ["the user's"] * 3
    VecNormalize.load(tmp_path / "statistics", stacked())
    assert KINDS[kind][0].load(tmp_path / "model", env=stacked(), device="cpu").learn(16).num_timesteps >= 16


@all_kinds
@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
def test_afterwards_the_environments_are_as_before(error, kind):
    """Also where learning ends with an exception."""
    env = VecNormalize(VecMonitor(of_two(fault="raise in step" if error else "", at=20, value=error)))
    stack = [env, env.venv, env.unwrapped]
    replaced = [vars(each).keys() & dir(VecEnvWrapper) for each in stack]
    with pytest.raises(error) if error else nullcontext():
        make(kind, env).learn(100)
    assert [env, env.venv, env.unwrapped] == stack
    assert [vars(each).keys() & dir(VecEnvWrapper) for each in stack] == replaced
    env.reset()
    env.unwrapped.envs[0].fault, env.unwrapped.envs[0].value = "reward", NAN
    env.unwrapped.envs[0].at = env.unwrapped.envs[0].n_steps + 1
    env.step(np.zeros(2, int))


@all_kinds
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_learning_within_a_callback(fault, kind):
    """The environments are still guarded after another model has learned with them."""
    env = VecNormalize(of_two(fault=fault, at=40, value=NAN if fault == "reward" else np.zeros(1)))
    other = make("steps", env)
    with pytest.raises(ValueError, match=f"The {fault} of environment 1"):
        make(kind, env).learn(400, callback=At(3, lambda model: other.learn(24)))
    assert other.num_timesteps == 32
    assert_finite_statistics(env)


@pytest.mark.parametrize("value", [4e38, -1e39, 1e200])
def test_what_float32_cannot_hold_is_named_whatever_numpy_warns_of(value):
    with np.errstate(over="raise"), pytest.raises(BadData, match=r"of environment 1 is not finite.*float32 ends at"):
        check_finite("The reward", np.array([0.0, value]), (None,))
