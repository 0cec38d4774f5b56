"""Memory does not grow, one environment works and so do 256, and two identical runs are bit-identical."""

import gc
import tracemalloc

import gymnasium as gym
import pytest
import torch as th
from environments import Corridor
from models import KINDS, make
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_reinforce.envs.vec_env import GymnasiumVecEnv

all_kinds = pytest.mark.parametrize("kind", KINDS)


class Sizes(BaseCallback):
    """Notes the memory in use at the end of every fiftieth update."""

    def __init__(self):
        super().__init__()
        self.sizes, self.n_updates = [], 0

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.n_updates += 1
        if self.n_updates % 50 == 0:
            gc.collect()
            self.sizes.append(tracemalloc.get_traced_memory()[0])


@all_kinds
def test_memory_does_not_grow_with_updates_or_episodes(kind):
    # Without a Monitor, which keeps three numbers of every episode
    model, callback = make(kind, DummyVecEnv([lambda: Corridor((2, 6))] * 2)), Sizes()
    tracemalloc.start()
    model.learn({"steps": 3200, "episodes": 2800, "search": 4000}[kind], callback)
    tracemalloc.stop()
    assert len(callback.sizes) >= 4
    # A rollout that was kept would be kilobytes an update; the caches of NumPy and PyTorch fill up at a hundredth
    assert callback.sizes[-1] - callback.sizes[1] < 250 * 50 * (len(callback.sizes) - 2), callback.sizes


@all_kinds
@pytest.mark.parametrize("n_envs", [1, 256])
def test_numbers_of_environments(n_envs, kind):
    model = make(kind, make_vec_env(lambda: Corridor((2, 3)), n_envs)).learn(8 * n_envs)
    assert model.num_timesteps >= 8 * n_envs and model._n_updates >= 1


VEC_ENVS = {
    "dummy": lambda: make_vec_env("CartPole-v1", 3, seed=5, vec_env_cls=DummyVecEnv),
    "subproc": lambda: make_vec_env("CartPole-v1", 3, seed=5, vec_env_cls=SubprocVecEnv),
    "gymnasium": lambda: VecMonitor(
        GymnasiumVecEnv(gym.make_vec("CartPole-v1", 3, vectorization_mode="vector_entry_point"))
    ),
}


@all_kinds
@pytest.mark.parametrize("vec_env", VEC_ENVS)
def test_two_identical_runs_are_bit_identical(vec_env, kind):
    outcomes = []
    for _ in range(2):
        env = VEC_ENVS[vec_env]()
        env.seed(5)
        model = make(kind, env, seed=5).learn(300)
        outcomes.append([*model.policy.parameters(), th.tensor(model.num_timesteps)])
        env.close()
    assert all(map(th.equal, *outcomes))
