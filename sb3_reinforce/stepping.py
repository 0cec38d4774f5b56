"""
How environments are stepped: as their own ``step`` does it, with two differences.

A ``DummyVecEnv`` is stepped without its deep copies, which with 64 CartPoles are a fourth of its time, and a
``SubprocVecEnv`` without waiting for ever for a worker that has died.
"""

from collections.abc import Callable
from copy import deepcopy
from functools import partial
from multiprocessing.connection import wait
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


def stepper(env: VecEnv) -> Callable[[np.ndarray], VecEnvStepReturn]:
    """
    How to step an environment. A subclass of ``DummyVecEnv``, or one on which a method for stepping was replaced, is
    asked itself.

    :param env: The environments
    :return: A function of actions of shape ``(n_envs, ...)``
    """
    if isinstance(env.unwrapped, SubprocVecEnv):
        return partial(step_workers, env)
    if type(env) is DummyVecEnv and not vars(env).keys() & {"step", "step_async", "step_wait"}:
        return partial(step_in_turn, env)
    return env.step


def step_in_turn(env: DummyVecEnv, actions: np.ndarray) -> VecEnvStepReturn:
    """
    What ``env.step(actions)`` returns, without a deep copy of every info at every step.

    The infos are copies, but what lies inside their values is the environment's own.

    :param env: The environments
    :param actions: Shape ``(n_envs, ...)``
    """
    env.step_async(actions)
    rewards, dones, infos = env.buf_rews, env.buf_dones, []
    # One array, unless observations are dicts
    rows: Any = env.buf_obs.get(None)  # type: ignore[call-overload]
    for i, (single, action) in enumerate(zip(env.envs, actions, strict=True)):
        obs, rewards[i], terminated, truncated, info = single.step(action)
        info = {**info, "TimeLimit.truncated": truncated and not terminated}
        dones[i] = is_done = terminated or truncated
        if is_done:
            # An environment may write its next observation into the same array
            info["terminal_observation"] = deepcopy(obs)
            obs, env.reset_infos[i] = single.reset()
        if rows is None:
            env._save_obs(i, obs)
        else:
            rows[i] = obs
        infos.append(info)
    env.buf_infos = infos
    return env._obs_from_buf() if rows is None else rows.copy(), rewards.copy(), dones.copy(), infos.copy()


def step_workers(env: VecEnv, actions: np.ndarray) -> VecEnvStepReturn:
    """
    ``env.step(actions)``; if a worker dies, an error that names it.

    Without this, with ``start_method="fork"``, the step would never return: the other workers hold the dead one's end
    of its pipe open.

    :param env: Environments over a ``SubprocVecEnv``
    :param actions: Shape ``(n_envs, ...)``
    :raises ConnectionError: If a worker is dead
    """
    workers: Any = env.unwrapped
    try:
        env.step_async(actions)
        for remote, process in zip(workers.remotes, workers.processes, strict=True):
            if remote not in wait([remote, process.sentinel]):
                raise EOFError
        return env.step_wait()
    except (EOFError, ConnectionError) as error:
        sentinels = [process.sentinel for process in workers.processes]
        # A pipe may close a moment before its process is gone
        gone = wait(sentinels, timeout=5)
        dead = [i for i, sentinel in enumerate(sentinels) if sentinel in gone]
        if not dead:
            raise
        raise ConnectionError(f"The worker of environment {', '.join(map(str, dead))} died") from error
