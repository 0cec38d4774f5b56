"""
How fast does CnnPolicy learn from images, on a GPU or not?

Random images of Atari's size (84 x 84 x 4), REINFORCE beside A2C with rollouts of equal length; the environments cost
next to nothing, so the networks and the way of the observations to them are what is measured.

    python examples/benchmarks/images.py --device cuda --n-envs 16 64
"""

import argparse
import statistics
import time
import warnings

import torch as th
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv

from sb3_reinforce import REINFORCE

IMAGE = {"screen_height": 84, "screen_width": 84, "n_channels": 4}


def learning(algorithm: type, n_envs: int, timesteps: int, device: str, **kwargs: object) -> float:
    """Steps a second of ``learn()`` with rollouts of 32 steps, after a first rollout that is not counted."""
    env = make_vec_env(FakeImageEnv, n_envs, env_kwargs=IMAGE)
    model = algorithm("CnnPolicy", env, n_steps=32, device=device, seed=0, **kwargs).learn(1)
    before, start = model.num_timesteps, time.perf_counter()
    model.learn(timesteps, reset_num_timesteps=False)
    return (model.num_timesteps - before) / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-envs", type=int, nargs="+", default=[16])
    parser.add_argument("--timesteps", type=int, default=2048)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    for n_envs in arguments.n_envs:
        ratios = []
        for _ in range(arguments.rounds):
            common = (n_envs, arguments.timesteps, arguments.device)
            ours = learning(REINFORCE, *common, n_critic_updates=1, batch_size=32 * n_envs)
            ratios.append(ours / learning(A2C, *common))
        print(
            f"{n_envs} environments on {arguments.device}: REINFORCE / A2C {statistics.median(ratios):.2f}", flush=True
        )


if __name__ == "__main__":
    main()
