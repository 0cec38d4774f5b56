"""Stepping environments in other processes without waiting for ever for one that has died."""

from collections.abc import Callable
from functools import partial
from multiprocessing.connection import wait
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


def step(env: VecEnv, actions: np.ndarray) -> VecEnvStepReturn:
    """
    ``env.step(actions)``; if a worker of a ``SubprocVecEnv`` dies, an error that names it.

    Without this, with ``start_method="fork"``, the step would never return: the other workers hold the dead one's end
    of its pipe open.

    :param env: The environments
    :param actions: Shape ``(n_envs, ...)``
    :raises ConnectionError: If a worker is dead
    """
    workers: Any = env.unwrapped
    if not isinstance(workers, SubprocVecEnv):
        return env.step(actions)
    check_alive(workers)
    env.step_async(actions)
    for remote, process in zip(workers.remotes, workers.processes, strict=True):
        wait([remote, process.sentinel])
    check_alive(workers)
    return env.step_wait()


def stepper(env: VecEnv) -> Callable[[np.ndarray], VecEnvStepReturn]:
    """
    How to step an environment: as ``step`` where it has workers, else by its own ``step``, which costs nothing more.

    :param env: The environments
    """
    return partial(step, env) if isinstance(env.unwrapped, SubprocVecEnv) else env.step


def check_alive(workers: SubprocVecEnv) -> None:
    """
    Check that no worker has died.

    :param workers: The environments
    :raises ConnectionError: Naming the one that has
    """
    for i, process in enumerate(workers.processes):
        if not process.is_alive():
            raise ConnectionError(f"The worker of environment {i} died (exit code {process.exitcode})")
