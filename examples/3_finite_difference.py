"""
Can a policy learn without a single derivative?

The environment and the policy class are those of example 1, without hidden layers: 10 parameters. Perturb them, look at
the returns, fit a plane: its slope is the gradient.

    python examples/3_finite_difference.py
"""

import argparse

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import FiniteDifference


class Print(BaseCallback):
    """One line per update: what the perturbed policies were worth, and how much of it the plane explains."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        logged = self.logger.name_to_value
        if self.model._n_updates:
            print(
                f"update {self.model._n_updates:2d}, {self.num_timesteps:6d} steps: "
                f"utility {logged['rollout/utility_mean']:5.1f}, R² {logged['train/r_squared']:.2f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--timesteps", type=int, default=50_000)
    timesteps = parser.parse_args().timesteps

    env = make_vec_env("CartPole-v1", seed=0)
    kwargs = {"net_arch": []}
    model = FiniteDifference("MlpPolicy", env, estimator="regression", policy_kwargs=kwargs, seed=0, device="cpu")
    print(f"{model.n_parameters} parameters, {model.n_delta} perturbations per update")
    model.learn(timesteps, callback=Print(), log_interval=None)

    mean, std = evaluate_policy(model, env, n_eval_episodes=20)
    print(f"mean return of 20 episodes after {model.num_timesteps} steps: {mean:.1f} ± {std:.1f}")


if __name__ == "__main__":
    main()
