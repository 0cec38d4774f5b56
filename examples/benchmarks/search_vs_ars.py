"""
Does FiniteDifference end as high as SB3-Contrib's ARS with the RL Zoo's settings, at the same number of real steps?

    python examples/benchmarks/search_vs_ars.py --env Pendulum-v1 --seeds 20 21 22 23 24

Steps are counted in the environments themselves, since ARS counts some more than once. Each run ends with the mean
return of 100 episodes of the final policy, and adds a line to results/search_vs_ars.csv.
"""

import argparse
import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from sb3_contrib import ARS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_reinforce import FiniteDifference

RESULTS = Path(__file__).parent / "results" / "search_vs_ars.csv"
# rl_zoo3 2.9.2, hyperparams/ars.yml; Swimmer-v5 and HalfCheetah-v5 have the entries of version 4
ZOO_MLP = dict(
    policy="MlpPolicy", learning_rate=0.018, n_delta=4, n_top=1, delta_std=0.1, zero_policy=False,
    policy_kwargs=dict(net_arch=[16]),
)  # fmt: skip
ZOO: dict[str, dict[str, Any]] = {
    "CartPole-v1": dict(policy="LinearPolicy", n_delta=2),
    "Pendulum-v1": ZOO_MLP,
    "MountainCarContinuous-v0": {**ZOO_MLP, "delta_std": 0.2},
    "Swimmer-v5": dict(policy="LinearPolicy", learning_rate=0.02, delta_std=0.01, n_delta=1, n_top=1),
    "HalfCheetah-v5": dict(policy="LinearPolicy", learning_rate=0.02, delta_std=0.03, n_delta=32, n_top=4),
}
MLP = dict(
    policy="MlpPolicy", learning_rate=0.02, estimator="central", n_delta=4, delta_std=0.1,
    policy_kwargs=dict(net_arch=dict(pi=[16], vf=[]), activation_fn=th.nn.ReLU, ortho_init=False),
)  # fmt: skip
OURS: dict[str, dict[str, Any]] = {
    "CartPole-v1": dict(policy="LinearPolicy"),
    "Pendulum-v1": MLP,
    "MountainCarContinuous-v0": {
        **MLP, "n_top": 1, "delta_std": 0.2, "policy_kwargs": dict(net_arch=dict(pi=[16], vf=[])),
    },
    "Swimmer-v5": dict(policy="LinearPolicy", learning_rate=0.02, estimator="central", n_delta=2, delta_std=0.05),
    "HalfCheetah-v5": dict(policy="LinearPolicy", learning_rate=0.02, estimator="central", n_delta=8, delta_std=0.03),
}  # fmt: skip
# As many as there are candidates, so that none idles, but for CartPole, whose episodes differ most in length
N_ENVS = {"CartPole-v1": 1, "Pendulum-v1": 8, "MountainCarContinuous-v0": 8, "Swimmer-v5": 4, "HalfCheetah-v5": 16}
NORMALIZE = {"Pendulum-v1", "MountainCarContinuous-v0", "HalfCheetah-v5"}
# The Zoo's, but for Swimmer and HalfCheetah, which take 2 and 12.5 million steps there
TIMESTEPS = {
    "CartPole-v1": 50_000, "Pendulum-v1": 2_000_000, "MountainCarContinuous-v0": 500_000, "Swimmer-v5": 300_000,
    "HalfCheetah-v5": 2_000_000,
}  # fmt: skip


class Counted(gym.Wrapper):
    """Counts the steps of all environments of the process."""

    steps = 0

    def step(self, action: Any) -> Any:
        Counted.steps += 1
        return super().step(action)


class LastWithin(BaseCallback):
    """Remembers the last policy that was found within the budget; an update may begin within it and end beyond."""

    def __init__(self, timesteps: int):
        super().__init__()
        self.timesteps = timesteps

    def _on_rollout_start(self) -> None:
        if Counted.steps <= self.timesteps:
            self.policy = {name: value.clone() for name, value in self.model.policy.state_dict().items()}
            self.steps = Counted.steps

    def _on_step(self) -> bool:
        return True


def make(env_id: str, n_envs: int, seed: int) -> VecEnv:
    env = make_vec_env(env_id, n_envs, seed=seed, wrapper_class=Counted)
    return VecNormalize(env, norm_reward=False) if env_id in NORMALIZE else env


def mean_return(model: BaseAlgorithm, env_id: str) -> float:
    env = make(env_id, 1, seed=1000)
    if isinstance(env, VecNormalize):
        env.obs_rms, env.training = model.get_vec_normalize_env().obs_rms, False
    return float(evaluate_policy(model, env, 100)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pendulum-v1", choices=list(ZOO))
    parser.add_argument("--algo", nargs="+", default=["FiniteDifference", "ARS"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[20, 21, 22, 23, 24])
    parser.add_argument("--timesteps", type=int)
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    timesteps = arguments.timesteps or TIMESTEPS[arguments.env]
    for seed in arguments.seeds:
        for name in arguments.algo:
            algorithm, settings, n_envs = (
                (ARS, ZOO, 1) if name == "ARS" else (FiniteDifference, OURS, N_ENVS[arguments.env])
            )
            env = make(arguments.env, n_envs, seed)
            model = algorithm(env=env, seed=seed, device="cpu", **settings[arguments.env])
            Counted.steps, callback = 0, LastWithin(timesteps)
            model.learn(timesteps, callback, log_interval=None)
            after = mean_return(model, arguments.env)
            model.policy.load_state_dict(callback.policy)
            row = [arguments.env, name, seed, timesteps, callback.steps, round(mean_return(model, arguments.env), 1)]
            print(*row, "| after learn():", model.num_timesteps, round(after, 1), flush=True)
            is_new = not arguments.results.exists()
            with arguments.results.open("a", newline="") as file:
                writer = csv.writer(file)
                if is_new:
                    writer.writerow(["env", "algorithm", "seed", "budget", "steps", "mean_return"])
                writer.writerow(row)


if __name__ == "__main__":
    main()
