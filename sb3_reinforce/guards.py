"""What watches over the environments while a model learns: faults are named where they come in, before they do harm."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecNormalize

from sb3_reinforce.environment_checks import check_finite
from sb3_reinforce.interruptions import interruptible
from sb3_reinforce.stepping import save_obs
from sb3_reinforce.workers import watch

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
        with ExitStack() as stack:
            if model.env is not None:
                base = model.env.unwrapped
                if isinstance(base, SubprocVecEnv):
                    watch(base)
                if getattr(type(base), "_save_obs", None) is DummyVecEnv._save_obs:
                    stack.enter_context(replaced(base, _save_obs=partial(save_obs, cast(DummyVecEnv, base))))
            vec_normalize = model.get_vec_normalize_env()
            if vec_normalize is not None:
                stack.enter_context(checked(vec_normalize))
            return learn(model, *args, **kwargs)

    return interruptible(run)


@contextmanager
def replaced(env: VecEnv, **methods: Callable[..., Any]) -> Iterator[None]:
    """
    Give an object other methods within the block.

    :param env: The object
    :param methods: The methods by name
    """
    before = {name: vars(env)[name] for name in methods if name in vars(env)}
    vars(env).update(methods)
    try:
        yield
    finally:
        for name in methods:
            del vars(env)[name]
        vars(env).update(before)


@contextmanager
def checked(vec_normalize: VecNormalize) -> Iterator[None]:
    """
    Within the block, numbers that are not finite are refused before they get into the statistics, which would keep them
    for good, or are clipped, and so hidden.

    :param vec_normalize: The wrapper
    """
    venv = vec_normalize.venv
    reset, step_wait, n_steps = venv.reset, venv.step_wait, 0
    check = partial(check_finite, since="since learn() began")

    def checked_reset() -> Any:
        obs = reset()
        check("The observation", obs, (n_steps,))
        return obs

    def checked_step_wait() -> Any:
        nonlocal n_steps
        obs, rewards, dones, infos = step_wait()
        check("The reward", rewards, (n_steps,))
        check("The observation", obs, (n_steps,))
        for i in np.flatnonzero(dones).tolist() if np.count_nonzero(dones) else ():
            check("The terminal observation", infos[i].get("terminal_observation", 0), (n_steps, i))
        n_steps += 1
        return obs, rewards, dones, infos

    with replaced(venv, reset=checked_reset, step_wait=checked_step_wait):
        yield
