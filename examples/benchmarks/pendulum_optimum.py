"""
What are the best returns on Pendulum-v1, from the starts of ``compare.py``'s final evaluations?

    python examples/benchmarks/pendulum_optimum.py --output pendulum_optimum.csv

Value iteration on a grid gives an almost optimal policy for the 200 steps of an episode, which takes the place of the
trained one: in the same environments, after as many evaluations. With a discount below 1 it is best for the discounted
rewards; the returns are never discounted.
"""

import argparse
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from compare import EVALUATION_EPISODES, N_EVALUATIONS, Run, make
from scipy.ndimage import map_coordinates
from stable_baselines3.common.evaluation import evaluate_policy

HORIZON = 200


def step(angle: np.ndarray, velocity: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The next angle and velocity, and the reward, as in Gymnasium's ``PendulumEnv``; angles are in [-π, π]."""
    reward = -(angle**2 + 0.1 * velocity**2 + 0.001 * torque**2)
    # θ̈ = 3g/(2l) · sin θ + 3u/(ml²), with g = 10, m = l = 1 and steps of 0.05 s
    velocity = np.clip(velocity + (15 * np.sin(angle) + 3 * torque) * 0.05, -8, 8)
    angle = (angle + velocity * 0.05 + np.pi) % (2 * np.pi) - np.pi
    return angle, velocity, reward


class OptimalPolicy:
    """
    Greedy with respect to the values of the steps that remain, in environments whose episodes end together.

    :param gamma: Discount factor of the values
    :param n_angles: Points of the grid from -π to π
    :param n_velocities: Points of the grid from -8 to 8
    """

    def __init__(self, gamma: float, n_angles: int, n_velocities: int):
        self.gamma = gamma
        self.angles = np.linspace(-np.pi, np.pi, n_angles)
        self.velocities = np.linspace(-8.0, 8.0, n_velocities)
        self.torques = np.linspace(-2.0, 2.0, 401)
        self.n_steps = 0
        grid = np.meshgrid(self.angles, self.velocities, indexing="ij")
        self.values = [np.zeros(grid[0].shape)]
        for _ in range(HORIZON):
            # V_k(s) = max_a Q_k(s, a), the value with k steps left (Bellman, 1957)
            q_values = self.action_values(self.values[-1], *grid, self.torques[::40])
            self.values.append(q_values.max(-1))

    def action_values(
        self, values: np.ndarray, angle: np.ndarray, velocity: np.ndarray, torques: np.ndarray
    ) -> np.ndarray:
        """Q(s, a) = r(s, a) + γ V(s'), with V interpolated between the points of the grid."""
        angle, velocity, reward = step(angle[..., None], velocity[..., None], torques)
        rows = (angle - self.angles[0]) / (self.angles[1] - self.angles[0])
        columns = (velocity - self.velocities[0]) / (self.velocities[1] - self.velocities[0])
        return reward + self.gamma * map_coordinates(values, (rows, columns), order=1, mode="nearest")

    def predict(
        self, observation: Any, state: Any, episode_start: np.ndarray, deterministic: bool
    ) -> tuple[np.ndarray, None]:
        """The best of 401 torques, counting the steps since the episodes began."""
        if episode_start.all():
            self.n_steps = 0
        self.n_steps += 1
        angle = np.arctan2(observation[:, 1], observation[:, 0])
        values = self.values[HORIZON - self.n_steps]
        best = self.action_values(values, angle, observation[:, 2], self.torques).argmax(-1)
        return self.torques[best, None].astype(np.float32), None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--gamma", nargs="+", type=float, default=[1.0, 0.97, 0.95, 0.9])
    parser.add_argument("--grid", nargs=2, type=int, default=[541, 353], help="number of angles and of velocities")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    policies = [OptimalPolicy(gamma, *arguments.grid) for gamma in arguments.gamma]
    rows = []
    for policy, seed in itertools.product(policies, arguments.seeds):
        _, env, eval_env = make(Run("Pendulum-v1", "reinforce", seed, 1_000_000))
        for _ in range(N_EVALUATIONS):
            evaluate_policy(policy, eval_env, EVALUATION_EPISODES)
        mean, _ = evaluate_policy(policy, eval_env, 100)
        rows.append({"gamma": policy.gamma, "seed": seed, "return": round(float(mean), 2)})
        env.close()
        eval_env.close()
    frame = pd.DataFrame(rows)
    frame.to_csv(arguments.output, index=False)
    print(frame.groupby("gamma")["return"].describe())


if __name__ == "__main__":
    main()
