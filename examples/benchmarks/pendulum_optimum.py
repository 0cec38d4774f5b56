"""
How far are the returns on Pendulum-v1 from the best ones?

    python examples/benchmarks/pendulum_optimum.py --output pendulum_optimum.csv

Value iteration on a grid gives an almost optimal policy for the 200 steps of an episode. ``compare.py``'s final
evaluation is repeated with it: the same environments, after as many evaluations during training, so the same starts.
The last row, ``all``, is the mean of the values over the starts that the task draws.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from compare import EVALUATION_EPISODES, N_EVALUATIONS, Run, make
from scipy.integrate import trapezoid
from scipy.ndimage import map_coordinates
from stable_baselines3.common.evaluation import evaluate_policy

HORIZON = 200


def step(angle: np.ndarray, velocity: np.ndarray, torque: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The next angle and velocity, and the reward, as in Gymnasium's ``PendulumEnv.step``."""
    reward = -(angle**2 + 0.1 * velocity**2 + 0.001 * torque**2)
    velocity = np.clip(velocity + (15 * np.sin(angle) + 3 * torque) * 0.05, -8, 8)
    angle = (angle + velocity * 0.05 + np.pi) % (2 * np.pi) - np.pi
    return angle, velocity, reward


class OptimalPolicy:
    """
    Greedy with respect to the values of the steps that remain, in environments whose episodes end together.

    :param n_angles: Points of the grid from -π to π
    :param n_velocities: Points of the grid from -8 to 8
    :param n_torques: Torques to choose from, ten times as many when it acts
    """

    def __init__(self, n_angles: int, n_velocities: int, n_torques: int):
        self.angles = np.linspace(-np.pi, np.pi, n_angles)
        self.velocities = np.linspace(-8.0, 8.0, n_velocities)
        self.torques = np.linspace(-2.0, 2.0, 10 * n_torques)
        self.n_steps = 0
        grid = np.meshgrid(self.angles, self.velocities, indexing="ij")
        torques = np.linspace(-2.0, 2.0, n_torques)
        self.values = [np.zeros(grid[0].shape)]
        for _ in range(HORIZON):
            # V_k(s) = max_a Q_k(s, a), the value with k steps left (Bellman, 1957)
            self.values.append(self.action_values(self.values[-1], *grid, torques).max(-1))

    def action_values(
        self, values: np.ndarray, angle: np.ndarray, velocity: np.ndarray, torques: np.ndarray
    ) -> np.ndarray:
        """Q(s, a) = r(s, a) + V(s'), with V interpolated between the points of the grid."""
        angle, velocity, reward = step(angle[..., None], velocity[..., None], torques)
        rows = (angle - self.angles[0]) / (self.angles[1] - self.angles[0])
        columns = (velocity - self.velocities[0]) / (self.velocities[1] - self.velocities[0])
        return reward + map_coordinates(values, (rows, columns), order=1, mode="nearest")

    def predict(
        self, obs: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, None]:
        if episode_start.all():
            self.n_steps = 0
        self.n_steps += 1
        angle = np.arctan2(obs[:, 1], obs[:, 0])
        q_values = self.action_values(self.values[HORIZON - self.n_steps], angle, obs[:, 2], self.torques)
        return self.torques[q_values.argmax(-1), None].astype(np.float32), None

    def mean_value(self) -> float:
        """The mean of V over the starts: angles from -π to π and velocities from -1 to 1, both uniform."""
        is_start = np.abs(self.velocities) < 1 + 1e-9
        by_velocity = self.values[HORIZON][:-1, is_start].mean(0)
        return float(trapezoid(by_velocity, self.velocities[is_start]) / 2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, default=list(range(10)))
    parser.add_argument("--grid", nargs=3, type=int, default=[361, 241, 41], help="angles, velocities and torques")
    parser.add_argument("--output", type=Path, required=True)
    arguments = parser.parse_args()
    policy = OptimalPolicy(*arguments.grid)
    rows: list[dict[str, Any]] = []
    for seed in arguments.seeds:
        _, env, eval_env = make(Run("Pendulum-v1", "reinforce", seed, 1_000_000))
        for _ in range(N_EVALUATIONS):
            evaluate_policy(policy, eval_env, EVALUATION_EPISODES)
        mean, _ = evaluate_policy(policy, eval_env, 100)
        rows.append({"seed": seed, "return": round(float(mean), 2)})
        env.close()
        eval_env.close()
    rows.append({"seed": "all", "return": round(policy.mean_value(), 2)})
    frame = pd.DataFrame(rows)
    frame.to_csv(arguments.output, index=False)
    print(frame.to_string(index=False))


if __name__ == "__main__":
    main()
