"""What watches over the environments while a model learns: faults are named where they come in, before they do harm."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_reinforce.common.interruptions import interruptible
from sb3_reinforce.envs.checks import BadData, check_finite, save_obs
from sb3_reinforce.envs.stepping import stepper
from sb3_reinforce.envs.workers import watch

Model = TypeVar("Model", bound=BaseAlgorithm)
Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def guarded(
    learn: Callable[Concatenate[Model, Arguments], Result],
) -> Callable[Concatenate[Model, Arguments], Result]:
    """
    Watch over the environments of a model while it learns, and let SIGTERM end it as Ctrl-C does.

    :param learn: A method of an algorithm
    :return: The same method
    """

    @wraps(learn)
    def run(model: Model, /, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        with interruptible(), watched(model.env):
            try:
                return learn(model, *args, **kwargs)
            except BadData as error:
                step = (model.num_timesteps - model._num_timesteps_at_start) // model.n_envs
                raise ValueError(
                    f"{error} (step {step} since learn() began). The policy has not been updated with it."
                ) from error

    return run


@contextmanager
def watched(env: VecEnv | None) -> Iterator[None]:
    """
    Within the block, what is malformed is refused where it comes in, and so is what is not finite, where wrappers would
    keep it in their statistics or clip it, and so hide it.

    :param env: The environments with all their wrappers
    """
    base = None if env is None else env.unwrapped
    with ExitStack() as stack:
        if isinstance(base, SubprocVecEnv):
            watch(base)
        if getattr(type(base), "_save_obs", None) is DummyVecEnv._save_obs and "_save_obs" not in vars(base):
            vars(base)["_save_obs"] = partial(save_obs, cast(DummyVecEnv, base))
            stack.callback(vars(base).pop, "_save_obs", None)
        wrappers = []
        while isinstance(env, VecEnvWrapper):
            wrappers.append(env)
            env = env.venv
        for wrapper in wrappers:
            # What another wrapper has made of finite numbers may not be finite, but what VecNormalize has, is
            is_checked = isinstance(wrapper.venv, VecNormalize)
            if isinstance(wrapper, VecNormalize) and isinstance(wrapper.venv, VecEnvWrapper) and not is_checked:
                own = vars(wrapper.venv)
                for name, check in {"step_wait": checked_step, "reset": checked_reset}.items():
                    if name not in own:
                        own[name] = partial(check, getattr(wrapper.venv, name))
                        stack.callback(own.pop, name, None)
        if wrappers and not isinstance(env, Guard):
            guard = Guard(cast(VecEnv, env), any(isinstance(wrapper, VecNormalize) for wrapper in wrappers))
            wrappers[-1].venv = cast(VecEnv, guard)
            stack.callback(setattr, wrappers[-1], "venv", env)
        yield


class Guard:
    """
    Stands for environments below their wrappers while a model learns: names what is malformed, steps a ``DummyVecEnv``
    without its deep copies, and refuses numbers that are not finite.

    No ``VecEnvWrapper``, since ``EvalCallback`` compares those of its environment with those of the model's.

    :param venv: The environments
    :param has_statistics: Whether a wrapper above it keeps statistics; if not, the algorithm checks the numbers itself
    """

    def __init__(self, venv: VecEnv, has_statistics: bool):
        self.venv, self.has_statistics, self.stepper = venv, has_statistics, stepper(venv)
        self.actions = np.empty(0)

    def reset(self) -> VecEnvObs:
        """Reset the environments."""
        return checked_reset(self.venv.reset) if self.has_statistics else self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """
        Take the actions of the next step.

        :param actions: Shape ``(n_envs, ...)``
        """
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Make the step."""
        step = partial(self.stepper, self.actions)
        return checked_step(step) if self.has_statistics else step()

    def step(self, actions: np.ndarray) -> VecEnvStepReturn:
        """
        Make a step, for wrappers that make several at a time.

        :param actions: Shape ``(n_envs, ...)``
        """
        self.step_async(actions)
        return self.step_wait()

    def __getattr__(self, name: str) -> Any:
        return getattr(self.venv, name)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy of the environments is not guarded
        return cast, (VecEnv, self.venv)


def check_numbers(obs: VecEnvObs, rewards: np.ndarray, dones: np.ndarray, infos: Any) -> VecEnvStepReturn:
    """
    Check that what a step returned is finite.

    :param obs: What the step returned, as are all others
    :param rewards: Shape ``(n_envs,)``
    :param dones: Shape ``(n_envs,)``
    :param infos: The infos of the environments
    :raises BadData: Naming the environment
    """
    check_finite("The reward", rewards, (None,))
    check_finite("The observation", obs, (None,))
    for i in np.flatnonzero(dones).tolist() if np.count_nonzero(dones) else ():
        check_finite("The terminal observation", infos[i].get("terminal_observation", 0), (None, i))
    return obs, rewards, dones, infos


def checked_step(step: Callable[[], VecEnvStepReturn]) -> VecEnvStepReturn:
    """
    What a step returns, checked.

    :param step: The step
    :raises BadData: If it returns a number that is not finite
    """
    return check_numbers(*step())


def checked_reset(reset: Callable[[], VecEnvObs]) -> VecEnvObs:
    """
    What a reset returns, checked.

    :param reset: The reset
    :raises BadData: If it returns a number that is not finite
    """
    obs = reset()
    check_finite("The observation", obs, (None,))
    return obs
