"""
How environments are stepped: as their own ``step`` does it, but a ``DummyVecEnv`` without its deep copies.

With 64 CartPoles these are a fourth of its time.
"""

from collections.abc import Callable
from copy import deepcopy
from functools import partial

import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from stable_baselines3.common.vec_env.util import dict_to_obs

from sb3_reinforce.environment_checks import as_reward


def stepper(env: VecEnv) -> Callable[[np.ndarray], VecEnvStepReturn]:
    """
    How to step an environment. A subclass of ``DummyVecEnv``, or one on which a method for stepping was replaced, is
    asked itself.

    :param env: The environments
    :return: A function of actions of shape ``(n_envs, ...)``
    """
    if type(env) is DummyVecEnv and not vars(env).keys() & {"step", "step_async", "step_wait"}:
        return partial(step_in_turn, env)
    return env.step


def step_in_turn(env: DummyVecEnv, actions: np.ndarray) -> VecEnvStepReturn:
    """
    What ``env.step(actions)`` returns, without a deep copy of every info at every step.

    The infos are copies, but what lies inside their values is the environment's own.

    :param env: The environments
    :param actions: Shape ``(n_envs, ...)``
    :raises BadData: If a reward is no number
    """
    env.step_async(actions)
    infos = []
    for i, (single, action) in enumerate(zip(env.envs, actions, strict=True)):
        obs, reward, terminated, truncated, info = single.step(action)
        env.buf_rews[i] = reward if type(reward) is float else as_reward(reward, i)
        info = {**info, "TimeLimit.truncated": truncated and not terminated}
        env.buf_dones[i] = terminated or truncated
        if terminated or truncated:
            env._save_obs(i, obs)
            # An environment may write its next observation into the same array
            info["terminal_observation"] = deepcopy(obs)
            obs, env.reset_infos[i] = single.reset()
        env._save_obs(i, obs)
        infos.append(info)
    env.buf_infos = infos
    rows = {key: part.copy() for key, part in env.buf_obs.items()}
    return dict_to_obs(env.observation_space, rows), env.buf_rews.copy(), env.buf_dones.copy(), infos.copy()
