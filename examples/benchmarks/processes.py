"""
When do several processes pay: steps a second and seconds to a return, against their number and the time of a step?

CartPole-v1 whose step sleeps for 0, 0.1, 1 or 10 ms, eight environments in all: in 1, 2, 4 and 8 processes, and in the
eight workers of a SubprocVecEnv. A run ends when the last 50 episodes have a mean return of 100, with 10 ms after three
rollouts: the seconds to the return are then computed from the steps that the others took. In each round all run once,
one after the other. Since a process that sleeps needs no core, two cores are enough.

A small model, whose parameters are measured in one process and by messages, is printed beside the measured rates, and
computes what this machine cannot show: 64 processes of one environment, on 8 machines.

    python examples/benchmarks/processes.py --output examples/benchmarks/results/processes
"""

import argparse
import json
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_reinforce import REINFORCE, is_leader
from sb3_reinforce.common.processes import Processes

N_ENVS = 8
N_STEPS = 64
TARGET = 100.0
MILLISECONDS = (0.0, 0.1, 1.0, 10.0)
PROCESSES = (1, 2, 4, 8)
# Assumed of a network: what a message takes longer between machines
NETWORK_SECONDS = 0.5e-3
BYTES_PER_STEP = 45


class Slow(gym.Wrapper):
    """An environment whose step takes longer."""

    def __init__(self, env: gym.Env[Any, Any], seconds: float):
        super().__init__(env)
        self.seconds = seconds

    def step(self, action: Any) -> Any:
        if self.seconds:
            time.sleep(self.seconds)
        return self.env.step(action)


class Watch(BaseCallback):
    """Stops at the target, or after some rollouts, and measures how long the steps take, and all else."""

    def __init__(self, target: float = np.inf, n_rollouts: float = np.inf):
        super().__init__()
        self.target, self.n_rollouts = target, n_rollouts
        self.stepping = 0.0
        self.start = 0.0
        self.rollout_start = 0.0
        self.last_step = 0.0

    def _on_training_start(self) -> None:
        self.start = time.perf_counter()

    def _on_step(self) -> bool:
        self.last_step = time.perf_counter()
        return self.n_rollouts > 0

    def _on_rollout_start(self) -> None:
        self.rollout_start = time.perf_counter()

    def _on_rollout_end(self) -> None:
        self.stepping += self.last_step - self.rollout_start
        self.n_rollouts -= 1
        returns = [episode["r"] for episode in self.model.ep_info_buffer]
        if len(returns) == 50 and np.mean(returns) >= self.target:
            self.n_rollouts = 0


def learn(
    n_envs: int, milliseconds: float, seed: int, vec_env: type = DummyVecEnv, **limits: float
) -> dict[str, float]:
    """Train, and return steps, seconds, seconds of the steps alone and the share of the time that processes waited."""
    wrapper = {"wrapper_class": Slow, "wrapper_kwargs": {"seconds": milliseconds / 1000}}
    env = make_vec_env("CartPole-v1", n_envs, seed=None, vec_env_cls=vec_env, **wrapper)
    model = REINFORCE("MlpPolicy", env, n_steps=N_STEPS, gae_lambda=0.95, stats_window_size=50, seed=seed, device="cpu")
    watch = Watch(**limits)
    model.learn(10**9, watch, log_interval=None)
    env.close()
    seconds = watch.last_step - watch.start
    waited = model.logger.name_to_value.get("time/wait_fraction", 0.0)
    return {"steps": model.num_timesteps, "seconds": seconds, "stepping": watch.stepping, "wait_fraction": waited}


def messages() -> list[float]:
    """The seconds that a message takes there and back: of 1 kB, and of 1 MB."""
    medians = []
    with Processes() as processes:
        for size in (10**3, 10**6):
            seconds = []
            for _ in range(50):
                start = time.perf_counter()
                processes.exchange(bytes(size))
                seconds.append(time.perf_counter() - start)
            medians.append(float(np.median(seconds)))
    return medians


def run(number: int, *task: Any) -> Any:
    """What a task returns in process 0 of so many."""
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={number}"] if number > 1 else []
    command = [sys.executable, *launcher, __file__, "--task", json.dumps(task)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def perform(name: str, *arguments: Any) -> Any:
    """A task, by its name."""
    if name == "messages":
        return messages()
    if name == "sleep":
        start = time.perf_counter()
        for _ in range(100):
            time.sleep(arguments[0] / 1000)
        return (time.perf_counter() - start) / 100
    vec_env, n_envs, seed, runs = arguments
    vec_env_class = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}[vec_env]
    return [learn(n_envs, milliseconds, seed, vec_env_class, **limits) for milliseconds, limits in runs]


def measure(rounds: int) -> list[dict[str, Any]]:
    """A row per run."""
    contenders = [("processes", number, "dummy", N_ENVS // number) for number in PROCESSES]
    contenders.append(("SubprocVecEnv", N_ENVS, "subproc", N_ENVS))
    runs = [(ms, {"n_rollouts": 3} if ms == MILLISECONDS[-1] else {"target": TARGET}) for ms in MILLISECONDS]
    rows = []
    for seed in range(rounds):
        for name, number, vec_env, n_envs in contenders:
            size = number if vec_env == "dummy" else 1
            for (milliseconds, limits), result in zip(
                runs, run(size, "learn", vec_env, n_envs, seed, runs), strict=True
            ):
                rate = result["steps"] / result["seconds"]
                row = {"kind": name, "number": number, "milliseconds": milliseconds, "seed": seed}
                row |= {"rate": round(rate, 1), "wait_fraction": round(result["wait_fraction"], 3)}
                if "target" in limits:
                    row |= {"steps": result["steps"], "seconds": round(result["seconds"], 2)}
                rows.append(row)
                print(row, flush=True)
    return rows


class Model:
    """
    The time of a rollout of N steps in W processes of n environments, from costs that are measured apart:

        ``T = N (a(n) max(1, W / cores) + n s) + L(W n) + (W − 1) (m_0 + m_1 N n)``

    a is what acting and CartPole take, s the sleep, L all that follows the last step, and m a process's message.
    """

    def __init__(self) -> None:
        sizes = (1, 2, 4, 8, 32, 64)
        costs = [run(1, "learn", "dummy", n, 0, [(0.0, {"n_rollouts": max(8, 100 // n)})])[0] for n in sizes]
        rollouts = [cost["steps"] / (N_STEPS * n) for n, cost in zip(sizes, costs, strict=True)]
        acting = [cost["stepping"] / N_STEPS / k for cost, k in zip(costs, rollouts, strict=True)]
        learning = [(cost["seconds"] - cost["stepping"]) / k for cost, k in zip(costs, rollouts, strict=True)]
        self.acting = np.polyfit(sizes, acting, 1)
        self.learning = np.polyfit(sizes, learning, 1)
        small, large = run(2, "messages")
        # The large message of process 1 comes back twice as long
        self.per_byte = (large - small) / 3e6
        self.per_message = small
        self.sleeps = {ms: run(1, "sleep", ms) if ms else 0.0 for ms in MILLISECONDS}

    def rate(self, number: int, n_envs: int, milliseconds: float, cores: int = 2, network: float = 0.0) -> float:
        """Steps a second."""
        acting = np.polyval(self.acting, n_envs) * max(1, number / cores)
        message = self.per_message + network + self.per_byte * BYTES_PER_STEP * N_STEPS * n_envs
        learning = np.polyval(self.learning, number * n_envs)
        seconds = N_STEPS * (acting + n_envs * self.sleeps[milliseconds]) + learning + (number - 1) * message
        return float(N_STEPS * n_envs * number / seconds)

    def rows(self) -> list[dict[str, Any]]:
        """The model beside the measured points, and beyond."""
        rows = []
        for milliseconds in MILLISECONDS:
            for number in PROCESSES:
                rate = self.rate(number, N_ENVS // number, milliseconds)
                rows.append({"kind": "model", "number": number, "milliseconds": milliseconds, "rate": round(rate, 1)})
            for number in (1, 64):
                rate = self.rate(number, 64 // number, milliseconds, cores=64, network=NETWORK_SECONDS)
                row = {"kind": "computed, 64 environments", "number": number, "milliseconds": milliseconds}
                rows.append({**row, "rate": round(rate, 1)})
        return rows


def draw(rows: pd.DataFrame, n_rounds: int, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    from sb3_reinforce.diagnostics.plots import COLORS

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    for milliseconds, color in zip(MILLISECONDS, COLORS, strict=False):
        of_step = rows[rows.milliseconds == milliseconds]
        for axis, column in zip(axes, ("rate", "seconds"), strict=True):
            medians = of_step.groupby(["kind", "number"])[column].median()
            axis.plot(medians["processes"], "-o", color=color, markersize=4, label=f"{milliseconds:g} ms a step")
            axis.plot(medians["SubprocVecEnv"], "*", color=color, markersize=10)
        axes[0].plot(of_step[of_step.kind == "model"].set_index("number").rate, ":", color=color)
    axes[0].plot([], [], "k*", markersize=10, label="SubprocVecEnv")
    axes[0].plot([], [], "k:", label="model")
    axes[0].set(ylabel="steps a second", title=f"8 environments in all, two cores\nmedians of {n_rounds} rounds")
    axes[1].set(ylabel="seconds", title=f"until the mean return is {TARGET:g}")
    for axis in axes:
        axis.set(xlabel="processes", xscale="log", yscale="log")
        axis.set_xticks(PROCESSES, PROCESSES)
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize="small")
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--output", type=Path, help="path without suffix")
    parser.add_argument("--task", type=json.loads, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    if arguments.task:
        result = perform(*arguments.task)
        if is_leader():
            print(json.dumps(result))
        return
    if arguments.output is None:
        parser.error("--output is missing")
    rows = pd.DataFrame(measure(arguments.rounds) + Model().rows())
    unknown = rows.seconds.isna() & rows.wait_fraction.notna()
    rows.loc[unknown, "seconds"] = (rows.steps.median() / rows.rate[unknown]).round(2)
    rows.to_csv(arguments.output.with_suffix(".csv"), index=False)
    print(rows.pivot_table(["rate", "seconds"], ["kind", "number"], "milliseconds", "median").to_string())
    draw(rows, arguments.rounds, arguments.output.with_suffix(".png"))


if __name__ == "__main__":
    main()
