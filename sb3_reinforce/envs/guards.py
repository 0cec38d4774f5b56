"""
Guards of the environments while a model learns or is measured: a fault is named where it enters, before it does harm.

``step_wait`` and ``reset`` are replaced on instances: on the innermost VecEnv, if it is a ``DummyVecEnv`` and not of a
subclass, to check the form of observations; and on what lies right below each ``VecNormalize``, to check that numbers
are finite.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial, wraps
from typing import Any, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_reinforce.common.interruptions import interruptible
from sb3_reinforce.common.moments import normalizers
from sb3_reinforce.envs import stepping
from sb3_reinforce.envs.checks import BadData, check_finite
from sb3_reinforce.envs.starts import base_of, give_new_seeds, has_given_seeds
from sb3_reinforce.envs.workers import watch

Learn = TypeVar("Learn", bound=Callable[..., Any])


def guarded(learn: Learn) -> Learn:
    """Guard the environments during ``learn``, and make them independent around it; SIGTERM ends it as Ctrl-C does."""

    @wraps(learn)
    def run(model: Any, /, *args: Any, **kwargs: Any) -> Any:
        with interruptible(), guard(model.env):
            forget_seeds(model)
            try:
                return learn(model, *args, **kwargs)
            except BadData as error:
                raise ValueError(
                    f"{error} (num_timesteps={model.num_timesteps}). The policy has not been updated with it."
                ) from error
            finally:
                forget_seeds(model)

    return cast(Learn, run)


def forget_seeds(model: Any) -> None:
    """Let a model whose environments have given seeds start new episodes, with different random numbers."""
    if model.env is not None and has_given_seeds(model.env):
        give_new_seeds(model.env)
        model._last_obs = None


@contextmanager
def guard(env: VecEnv | None) -> Iterator[None]:
    """Within the block, the environments below ``env`` and its wrappers are guarded, and numbers may underflow."""
    base = None if env is None else base_of(env)
    # γ^t becomes 0, also for users who let NumPy raise errors. Ctrl-C at the end of a block of th.no_grad would leave
    # PyTorch's gradients off
    with ExitStack() as stack, np.errstate(under="ignore"), th.set_grad_enabled(th.is_grad_enabled()):
        # A subclass may have several environments behind one pipe
        if isinstance(base, SubprocVecEnv) and len(base.remotes) == base.num_envs:
            watch(base)
        # A user, or an outer learn(), may have replaced a method for stepping on this instance
        if type(base) is DummyVecEnv and {"step", "step_async", "step_wait", "reset"}.isdisjoint(vars(base)):
            replace(stack, base, "step_wait", partial(stepping.step_wait, base))
            replace(stack, base, "reset", partial(stepping.reset, base))
        for each in normalizers(env):
            below = each.venv
            replace(stack, below, "step_wait", partial(finite_step, below.step_wait))
            replace(stack, below, "reset", partial(finite_reset, below.reset))
        yield


def replace(stack: ExitStack, env: VecEnv, name: str, method: Callable[[], Any]) -> None:
    """Replace a method of this instance until the stack is left; a copy of the VecEnv stays guarded."""
    if name in vars(env):
        stack.callback(setattr, env, name, getattr(env, name))
    else:
        stack.callback(delattr, env, name)
    setattr(env, name, method)


def finite_step(step: Callable[[], VecEnvStepReturn]) -> VecEnvStepReturn:
    """What ``step`` returns, if all its numbers are finite; ``dones`` as booleans, with which VecNormalize indexes."""
    obs, rewards, dones, infos = step()
    check_finite("The reward", rewards, (None,))
    check_finite("The observation", obs, (None,))
    for i in np.flatnonzero(dones).tolist():
        check_finite("The terminal observation", infos[i].get("terminal_observation", 0), (None, i))
    return obs, rewards, np.asarray(dones, dtype=bool), infos


def finite_reset(reset: Callable[[], VecEnvObs]) -> VecEnvObs:
    """What ``reset`` returns, if all its numbers are finite."""
    obs = reset()
    check_finite("The observation", obs, (None,))
    return obs
