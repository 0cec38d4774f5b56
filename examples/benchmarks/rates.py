"""What the timing scripts share: how fast a VecEnv steps, and how fast an algorithm learns on it."""

import time

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

# One pass of the critic over a rollout of 2048 steps, as A2C makes it
ONE_PASS = {"n_critic_updates": 1, "batch_size": 2048}


def bare(env: VecEnv, timesteps: int) -> float:
    """Steps a second of the VecEnv's own ``step`` with prepared actions and no learner."""
    actions = [np.stack([env.action_space.sample() for _ in range(env.num_envs)]) for _ in range(64)]
    env.reset()
    start = time.perf_counter()
    for step in range(timesteps // env.num_envs):
        env.step(actions[step % 64])
    return timesteps / (time.perf_counter() - start)


def learning(algorithm: type, policy: str, env: VecEnv, timesteps: int, **kwargs: object) -> float:
    """Steps a second of ``learn()``, after a first rollout that is not counted."""
    model = algorithm(policy, env, seed=0, **{"device": "cpu", **kwargs}).learn(1)
    before, start = model.num_timesteps, time.perf_counter()
    model.learn(timesteps, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (time.perf_counter() - start)
