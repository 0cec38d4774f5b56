"""
How fast does REINFORCE learn beside A2C, PPO, SBX's PPO and Tianshou's Reinforce?

CartPole-v1 in 8 environments, one thread, the defaults of each algorithm; Tianshou's Reinforce has the settings of its
test on this task. ``rate`` is the steps per second of the CPU after the first update. ``seconds`` of the CPU and
``steps`` are what it takes until the last 50 episodes of training have a mean return of 400; they are empty where that
takes more than ``--timesteps``. What is not installed is left out (``pip install sbx-rl tianshou``).

    python examples/benchmarks/peers.py --seeds 0 1 2 3 --output peers.csv
"""

import argparse
import contextlib
import csv
import importlib.util
import os
import time
import warnings
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE

# JAX would use all cores
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
N_ENVS = 8
TARGET = 400.0


class Watch:
    """Counts steps, keeps the last returns, and says when training may end."""

    def __init__(self, timesteps: int):
        self.timesteps = timesteps
        self.steps = 0
        self.returns: deque[float] = deque(maxlen=50)
        self.marks: list[tuple[int, float]] = []

    def env(self) -> gym.Env[Any, Any]:
        return Watched(gym.make("CartPole-v1"), self)

    def has_ended(self) -> bool:
        """To be asked before each rollout."""
        self.marks.append((self.steps, time.process_time()))
        # One rollout with the first update, and one to measure
        return len(self.marks) > 2 and (self.is_solved or self.steps >= self.timesteps)

    @property
    def is_solved(self) -> bool:
        return len(self.returns) == self.returns.maxlen and float(np.mean(self.returns)) >= TARGET

    def row(self) -> dict[str, object]:
        (_, start), (warm_steps, warm), *_, (steps, end) = self.marks
        row: dict[str, object] = {"rate": round((steps - warm_steps) / (end - warm))}
        if self.is_solved:
            row |= {"seconds": round(end - start, 2), "steps": steps}
        return row


class Watched(gym.Wrapper[Any, Any, Any, Any]):
    """An environment that reports to a ``Watch``."""

    def __init__(self, env: gym.Env[Any, Any], watch: Watch):
        super().__init__(env)
        self.watch = watch
        self.total = 0.0

    def step(self, action: Any) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        self.watch.steps += 1
        self.total += float(reward)
        if terminated or truncated:
            self.watch.returns.append(self.total)
            self.total = 0.0
        return obs, reward, terminated, truncated, info


class Solved(Exception):
    """Ends Tianshou's trainer."""


class StopWhenSolved(BaseCallback):
    def __init__(self, watch: Watch):
        super().__init__()
        self.watch = watch
        self.goes_on = True

    def _on_rollout_start(self) -> None:
        self.goes_on = not self.watch.has_ended()

    def _on_step(self) -> bool:
        return self.goes_on


def train_sb3(algorithm: Any, watch: Watch, seed: int, **kwargs: Any) -> None:
    env = make_vec_env(watch.env, N_ENVS, seed=seed)
    model = algorithm("MlpPolicy", env, seed=seed, device="cpu", **kwargs)
    model.learn(10**9, StopWhenSolved(watch), log_interval=None)


def train_sbx(watch: Watch, seed: int) -> None:
    import sbx

    train_sb3(sbx.PPO, watch, seed)


def train_tianshou(watch: Watch, seed: int) -> None:
    from tianshou.algorithm import Reinforce
    from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OnPolicyTrainerParams
    from tianshou.utils.net.common import Net

    th.manual_seed(seed)
    np.random.seed(seed)
    envs = DummyVectorEnv([watch.env for _ in range(N_ENVS)])
    envs.seed(seed)
    actor = Net(state_shape=4, action_shape=2, hidden_sizes=[64, 64], softmax=True)
    for layer in actor.modules():
        if isinstance(layer, th.nn.Linear):
            th.nn.init.orthogonal_(layer.weight, gain=2**0.5)
            th.nn.init.zeros_(layer.bias)
    policy = ProbabilisticActorPolicy(
        actor=actor,
        dist_fn=th.distributions.Categorical,
        action_space=gym.spaces.Discrete(2),
        action_scaling=False,
    )
    algorithm = Reinforce(policy=policy, gamma=0.95, return_standardization=True, optim=AdamOptimizerFactory(lr=1e-3))
    collector = Collector(algorithm, envs, VectorReplayBuffer(20_000, N_ENVS), exploration_noise=True)

    def stop(epoch: int, steps: int) -> None:
        if watch.has_ended():
            raise Solved

    with contextlib.suppress(Solved):
        # As in its example: eight episodes, twice
        algorithm.run_training(
            OnPolicyTrainerParams(
                training_collector=collector,
                max_epochs=1,
                epoch_num_steps=10**9,
                collection_step_num_env_steps=None,
                collection_step_num_episodes=N_ENVS,
                update_step_num_repetitions=2,
                batch_size=64,
                training_fn=stop,
                verbose=False,
                show_progress=False,
            )
        )


CONTENDERS: dict[str, tuple[str, Callable[..., None]]] = {
    "REINFORCE": ("sb3_reinforce", partial(train_sb3, REINFORCE)),
    "A2C": ("stable_baselines3", partial(train_sb3, A2C)),
    "PPO": ("stable_baselines3", partial(train_sb3, PPO)),
    "SBX's PPO": ("sbx", train_sbx),
    "Tianshou's Reinforce": ("tianshou", train_tianshou),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contenders", nargs="+", default=list(CONTENDERS), choices=list(CONTENDERS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--timesteps", type=int, default=200_000)
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    with arguments.output.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["contender", "seed", "rate", "seconds", "steps"], lineterminator="\n")
        writer.writeheader()
        for seed in arguments.seeds:
            for name in arguments.contenders:
                package, train = CONTENDERS[name]
                if importlib.util.find_spec(package):
                    watch = Watch(arguments.timesteps)
                    train(watch, seed=seed)
                    row = {"contender": name, "seed": seed, **watch.row()}
                    writer.writerow(row)
                    file.flush()
                    print(row, flush=True)


if __name__ == "__main__":
    main()
