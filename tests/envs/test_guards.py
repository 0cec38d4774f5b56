"""Faults of environments are named where they come in, before parameters or statistics are touched by them."""

from copy import deepcopy

import cloudpickle
import numpy as np
import pytest
import torch as th
from environments import Corridor, Faulty
from gymnasium import spaces
from models import KINDS, make, plain
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize

NAN, INF = float("nan"), float("inf")
all_kinds = pytest.mark.parametrize("kind", KINDS)


def of_two(**fault):
    """Two environments, of which the second has the fault."""
    space = {"observation_space": fault.get("observation_space"), "truncate": fault.get("truncate", False)}
    return DummyVecEnv([lambda: Faulty(**space), lambda: Faulty(**fault)])


def statistics(env):
    rms = (env.obs_rms, env.ret_rms)
    return [np.copy(part) for each in rms for part in (each.mean, each.var, each.count)]


def bad(value):
    return np.array([value, *[0] * 6], dtype=np.float32)


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
def test_numbers_that_are_not_finite(name, normalized, kind):
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
    env = VecFrameStack(VecNormalize(of_two(fault="observation", at=7, value=bad(value), truncate=True)), 2)
    with pytest.raises(ValueError, match=r"terminal observation of environment 1 is not finite.*step 6 since"):
        make(kind, env).learn(100)


@pytest.mark.parametrize("truncate", [True, False])
def test_an_observation_of_the_very_last_step(truncate):
    """In which the critic's value of it would end up in the returns."""
    at = 7 if truncate else 8
    model = make("steps", Faulty("observation", at=at, value=bad(NAN), truncate=truncate), n_steps=at)
    before = plain(model.policy.state_dict())
    with pytest.raises(ValueError, match="observation of environment 0"):
        model.learn(at)
    assert plain(model.policy.state_dict()) == before


class Watch(BaseCallback):
    """Keeps the parameters of the last step."""

    def _on_step(self):
        self.seen = plain(self.model.policy.state_dict())
        return True


@all_kinds
@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (dict(fault="raise in step", value=KeyboardInterrupt()), KeyboardInterrupt),
        (dict(fault="raise in step"), OSError),
        (dict(fault="reward", value=NAN), ValueError),
        (dict(fault="observation", value=bad(INF)), ValueError),
    ],
)
def test_after_a_fault_the_model_is_the_last_good_one(fault, error, wrapper, kind, tmp_path):
    """It can be saved, and goes on."""
    env, callback = wrapper(of_two(at=52, **fault)), Watch()
    model = make(kind, env)
    with pytest.raises(error):
        model.learn(400, callback=callback)
    assert model._n_updates > 0 and plain(model.policy.state_dict()) == callback.seen
    model.save(tmp_path / "model")
    loaded = KINDS[kind][0].load(tmp_path / "model", env=of_two())
    assert plain(loaded.policy.state_dict()) == callback.seen and loaded.learn(32).num_timesteps >= 32
    assert model.learn(32, reset_num_timesteps=False).num_timesteps >= 32


MALFORMED = {
    "too long": np.zeros(8, np.float32),
    "one number": np.zeros(1, np.float32),
    "a scalar": 0.0,
    "a string": "x",
    "strings": np.array(["x"] * 7),
    "None": None,
    "a dict": {"x": 1},
    "complex": np.ones(7) * 1j,
    "objects": np.array([None] * 7),
    "ragged": [[0.0], [0.0, 1.0]],
}
# Where the second environment returns it, and in which step of all of them
WHEN = {
    "step": (dict(fault="observation", at=5), 4),
    "end": (dict(fault="observation", at=7), 6),
    "truncation": (dict(fault="observation", at=7, truncate=True), 6),
    "reset": (dict(fault="first observation", at=2), 6),
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


@all_kinds
@pytest.mark.parametrize("value", ["x", np.ones(1), np.ones(2), None], ids=repr)
def test_rewards_that_monitor_cannot_add_up(value, kind):
    faults = [{}, dict(fault="reward", at=5, value=value)]
    env = DummyVecEnv([lambda fault=fault: Monitor(Faulty(**fault)) for fault in faults])
    with pytest.raises(ValueError, match=r"reward of environment 1 must be a number, got .*\(step 4 since"):
        make(kind, env).learn(400)


@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
@pytest.mark.parametrize("kind", ["steps", "episodes"])
def test_actions_that_are_not_finite_are_not_blamed_on_the_environment(kind, wrapper):
    """The standard deviation of gSDE overflows."""
    model = make(kind, wrapper(make_vec_env("Pendulum-v1", 2)), use_sde=True)
    model.policy.log_std.data.fill_(90.0)
    with pytest.raises(ValueError, match=r"action of environment 0 is not finite.*\(step 0 since"):
        model.learn(400)


class Picky(Corridor):
    """Refuses an action with an error of its own."""

    def step(self, action):
        raise TypeError("the action is not to my taste")


@all_kinds
def test_errors_of_an_environment_below_monitor_are_its_own(kind):
    with pytest.raises(TypeError, match="taste"):
        make(kind, Picky()).learn(8)


@all_kinds
@pytest.mark.parametrize("value", [np.float64(2), np.int64(2), np.array(2.0), th.tensor(2.0), True, 2], ids=repr)
def test_forms_that_stand_for_a_reward_are_taken(value, kind):
    model = make(kind, Corridor((3,), reward=lambda t, action: value)).learn(32)
    assert model.ep_info_buffer[0]["r"] == 3 * float(value)


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
    env = VecNormalize(Twice(of_two(fault="reward", at=6, value=NAN)))
    with pytest.raises(ValueError, match="reward of environment 1"):
        make("steps", env).learn(400)
    assert all(np.isfinite(part).all() for part in statistics(env))


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
    assert model.learn(32, reset_num_timesteps=False).num_timesteps >= 32


@all_kinds
@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
@pytest.mark.parametrize(
    ("fault", "value"), [("reward", 1e200), ("reward", -1e60), ("observation", np.full(7, -1e200))]
)
def test_numbers_beyond_float32_are_not_taken_for_finite_ones(fault, value, wrapper, kind):
    space = spaces.Box(-INF, INF, (7,), np.float64)
    env = wrapper(of_two(fault=fault, at=20, value=value, observation_space=space))
    model = make(kind, env)
    told = rf"{fault} of .*environment 1.* is not finite"
    with np.errstate(over="ignore"), pytest.raises(ValueError, match=told):
        model.learn(400)


class Copyable(VecEnvWrapper):
    """A wrapper without what cannot be copied of one."""

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
@pytest.mark.parametrize("wrapper", [lambda env: env, Copyable])
def test_a_copy_that_a_callback_makes_leads_a_life_of_its_own(wrapper, copied, kind):
    """It moves no other environment, and its numbers are nobody's business; trained on, it is guarded."""
    env = VecNormalize(wrapper(of_two()))

    def act(model):
        before, copy = env.get_attr("n_steps"), copied(env.venv)
        assert type(copy) is type(env.venv)
        single = copy.unwrapped.envs[1]
        single.fault, single.at, single.value = "reward", single.n_steps + 1, NAN
        copy.reset()
        assert np.isnan(copy.step(np.zeros(2, int))[1]).tolist() == [False, True]
        assert copy.unwrapped.get_attr("n_steps") == [before[0] + 1] * 2 and env.get_attr("n_steps") == before
        single.at, single.value = single.n_steps + 1, "x"
        with pytest.raises(ValueError, match="reward of environment 1 must be a number"):
            make("steps", copy).learn(8)

    assert make(kind, env).learn(40, callback=Once(act)).num_timesteps >= 40


@all_kinds
def test_environments_in_a_callback_are_as_ever(kind, tmp_path):
    """They can be asked, saved and evaluated beside, and what a user sets on them stays."""

    def stacked():
        return VecFrameStack(DummyVecEnv([lambda: Monitor(Faulty())] * 2), 2)

    env, calls = VecNormalize(stacked()), []
    step_wait = env.venv.step_wait
    evaluation = EvalCallback(VecNormalize(stacked()), n_eval_episodes=1, eval_freq=5, verbose=0)

    def act(model):
        model.save(tmp_path / "model")
        env.save(tmp_path / "statistics")
        assert env.env_is_wrapped(Monitor) == [True, True] and env.unwrapped.num_envs == 2
        with pytest.raises(AttributeError):
            env.no_such_attribute  # noqa: B018
        env.mark = env.venv.mark = env.venv.venv.mark = "the user's"
        env.venv.step_wait = lambda: calls.append("step") or step_wait()

    model = make(kind, env).learn(40, callback=CallbackList([Once(act), evaluation]))
    assert model.num_timesteps >= 40 and evaluation.n_calls > 5
    assert [vars(each)["mark"] for each in (env, env.venv, env.unwrapped)] == ["the user's"] * 3
    n_calls = len(calls)
    env.step(np.zeros(2, int))
    assert n_calls > 1 and len(calls) == n_calls + 1
    VecNormalize.load(tmp_path / "statistics", stacked())
    assert KINDS[kind][0].load(tmp_path / "model", env=stacked(), device="cpu").learn(16).num_timesteps >= 16


@all_kinds
@pytest.mark.parametrize("error", [None, KeyboardInterrupt])
def test_afterwards_the_environments_are_as_before(error, kind):
    """Also where learning ends with an exception."""
    env = VecNormalize(VecMonitor(of_two(fault="raise in step" if error else "", at=20, value=error)))
    stack = [env, env.venv, env.unwrapped]
    replaced = [vars(each).keys() & dir(VecEnvWrapper) for each in stack]
    try:
        make(kind, env).learn(100)
    except KeyboardInterrupt:
        assert error
    assert [env, env.venv, env.unwrapped] == stack
    assert [vars(each).keys() & dir(VecEnvWrapper) for each in stack] == replaced
    env.reset()
    env.unwrapped.envs[0].fault, env.unwrapped.envs[0].value = "reward", NAN
    env.unwrapped.envs[0].at = env.unwrapped.envs[0].n_steps + 1
    env.step(np.zeros(2, int))


@all_kinds
@pytest.mark.parametrize("fault", ["reward", "observation"])
def test_learning_within_a_callback(fault, kind):
    """What another model has done with the same environments leaves them guarded."""
    env = VecNormalize(of_two(fault=fault, at=40, value=NAN if fault == "reward" else np.zeros(1)))
    other = make("steps", env)
    with pytest.raises(ValueError, match=f"The {fault} of environment 1"):
        make(kind, env).learn(400, callback=Once(lambda model: other.learn(24)))
    assert other.num_timesteps == 32
    assert all(np.isfinite(part).all() for part in statistics(env))
