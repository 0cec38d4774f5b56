"""
How do REINFORCE and FiniteDifference compare with A2C, PPO, TRPO and ARS: by steps, by seconds, and at the end?

    python examples/benchmarks/compare.py --tasks CartPole-v1 LunarLander-v3 --seeds 0 1 2 3 4 --output results.csv

All get the same tasks, seeds and step budgets, and one torch thread each; ours may train on shorter episodes
(``train_env_kwargs`` of their settings). The peers take the RL Zoo's settings (for another version of the task where it
has none for this one, or else its default), and ours take ``sb3_reinforce.zoo``'s; the two searches are run only on
tasks that they have settings for.

The CSV has a row per evaluation: on 10 deterministic episodes at the start of the first rollout after each twentieth of
the budget, and at the end on ``--final-episodes``. ``steps`` are true ones, ``seconds`` without the evaluations, and
``cpu_seconds`` the same by the clock of the process, which a busy machine stretches less. The rows of a run are
written when it is finished, and a run that is there is not repeated: stop the script when you like and start it again.

Under ``python -m torch.distributed.run --standalone --nproc-per-node W`` our runs collect in W processes, one run after
the other, and process 0 trains the peers. The first error ends them all.
"""

import argparse
import contextlib
import functools
import io
import itertools
import multiprocessing
import re
import signal
import time
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pandas as pd
import rl_zoo3
import torch as th
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import StoreDict
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_reinforce import is_leader
from sb3_reinforce.common.processes import Processes, rank_and_size
from sb3_reinforce.zoo import ALGORITHMS as OURS
from sb3_reinforce.zoo import HYPERPARAMS
from sb3_reinforce.zoo.experiments import make_experiment

ALGORITHMS = ("reinforce", "finite_difference", "a2c", "ppo", "trpo", "ars")
SEARCHES = ("finite_difference", "ars")
BUDGETS = {
    "CartPole-v1": 100_000, "Acrobot-v1": 500_000, "MountainCarContinuous-v0": 100_000, "LunarLander-v3": 200_000,
}  # fmt: skip
OTHER_BUDGET = 1_000_000
N_EVALUATIONS = 20
EVALUATION_EPISODES = 10
COLUMNS = (
    "task", "algorithm", "seed", "budget", "evaluation", "steps", "seconds", "cpu_seconds", "return", "return_std",
    "episodes",
)  # fmt: skip


class Run(NamedTuple):
    """One training, named by the first columns of its rows."""

    task: str
    algorithm: str
    seed: int
    budget: int


def settings_of(algorithm: str, task: str) -> dict[str, Any] | None:
    """The settings published for a task, its latest other version (peers), or any task; None where there are none."""
    folder = HYPERPARAMS if algorithm in OURS else Path(rl_zoo3.__file__).parent / "hyperparams"
    published = yaml.safe_load((folder / f"{algorithm}.yml").read_text(encoding="utf-8"))
    version = re.compile(re.escape(task.split("-v")[0]) + r"-v\d+")
    others = [] if algorithm in OURS else sorted(filter(version.fullmatch, published), reverse=True)
    general = [] if algorithm in SEARCHES else ["atari" if ExperimentManager.is_atari(task) else "default"]
    return next((published[key] for key in (task, *others, *general) if key in published), None)


def make(run: Run, params: dict[str, Any] | None = None) -> tuple[BaseAlgorithm, VecEnv, VecEnv]:
    """A model, its environments and evaluation environments, with a configuration that no other run shares."""
    with contextlib.redirect_stdout(io.StringIO()):
        manager = make_experiment(
            argparse.Namespace(), run.algorithm, run.task, "", n_timesteps=run.budget, seed=run.seed, verbose=0,
            hyperparams=params,
        )  # fmt: skip
        # Ours are read as by the command train, which leaves out what does not go with the task
        settings = manager.read_hyperparameters()[0] if run.algorithm in OURS else settings_of(run.algorithm, run.task)
        kwargs, manager.env_wrapper, _, manager.vec_env_wrapper = manager._preprocess_hyperparams(settings)
        # ARS plays the episodes of a candidate alone
        env = manager.create_envs(1 if run.algorithm == "ars" else manager.n_envs, no_log=True)
        kwargs = manager._preprocess_action_noise(kwargs, {}, env)
        # The same for all algorithms, other than in training
        manager.seed = 10_000 + run.seed
        eval_env = manager.create_envs(EVALUATION_EPISODES, eval_env=True)
    return rl_zoo3.ALGOS[run.algorithm](env=env, seed=run.seed, device="cpu", **kwargs), env, eval_env


def clocks() -> np.ndarray:
    """The wall-clock time and the CPU time of this process, in seconds."""
    return np.array([time.perf_counter(), time.process_time()])


class Evaluations(BaseCallback):
    """Evaluates between rollouts, where each algorithm holds the policy it has found, and stops the clock meanwhile."""

    def __init__(self, run: Run, env: VecEnv, eval_env: VecEnv):
        super().__init__()
        self.run, self.env, self.eval_env = run, env, eval_env
        self.rows: list[dict[str, Any]] = []
        self.twentieth = 0
        self.spent = np.zeros(2)
        self.since = clocks()

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        twentieth = self.model.num_timesteps * N_EVALUATIONS // self.run.budget
        if twentieth >= self.twentieth:
            self.evaluate("training", EVALUATION_EPISODES)
            self.twentieth = twentieth + 1

    def evaluate(self, evaluation: str, episodes: int) -> None:
        self.spent += clocks() - self.since
        sync_envs_normalization(self.env, self.eval_env)
        mean, std = evaluate_policy(self.model, self.eval_env, episodes)
        figures = (*self.spent.round(2), round(mean, 3), round(std, 3), episodes)
        row = (*self.run, evaluation, self.model.num_timesteps, *figures)
        self.rows.append(dict(zip(COLUMNS, row, strict=True)))
        self.since = clocks()


def train(final_episodes: int, params: dict[str, Any] | None, run: Run) -> tuple[Run, list[dict[str, Any]] | Exception]:
    """
    Train one model.

    :param final_episodes: Episodes of the last evaluation
    :param params: What replaces the settings of our algorithms
    :param run: Which model
    :return: The run, and one row per evaluation or the error that ended it
    """
    th.set_num_threads(1)
    warnings.filterwarnings("ignore")
    try:
        model, env, eval_env = make(run, params)
        evaluations = Evaluations(run, env, eval_env)
        model.learn(run.budget, evaluations, log_interval=None)
        if is_leader():
            evaluations.evaluate("final", final_episodes)
    except Exception as error:
        return run, error
    return run, evaluations.rows


def ignore_interrupts() -> None:
    """Ctrl-C is the main process's to answer."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def finished(path: Path) -> set[tuple[Any, ...]]:
    """The runs that a CSV has the last row of."""
    if not path.exists():
        return set()
    rows = pd.read_csv(path)
    return set(rows.loc[rows["evaluation"] == "final", list(Run._fields)].itertuples(index=False, name=None))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", required=True)
    parser.add_argument("--algorithms", nargs="+", default=ALGORITHMS, choices=list(rl_zoo3.ALGOS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--timesteps", type=int, help="steps per run; the default depends on the task")
    parser.add_argument("-params", nargs="+", action=StoreDict, help="settings of ours to replace, as for train")
    parser.add_argument("--final-episodes", type=int, default=100)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--output", type=Path, required=True, help="the CSV; rows are added to it")
    arguments = parser.parse_args()
    if unknown := set(arguments.tasks) - gym.registry.keys():
        parser.error(f"--tasks: {', '.join(unknown)} not registered in Gymnasium")
    # As Ctrl-C, which ends the pool's processes too
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    arguments.output.parent.mkdir(parents=True, exist_ok=True)
    if is_leader() and not arguments.output.exists():
        arguments.output.write_text(",".join(COLUMNS) + "\n", encoding="utf-8")
    wanted = [
        Run(task, algorithm, seed, arguments.timesteps or BUDGETS.get(task, OTHER_BUDGET))
        for seed, task, algorithm in itertools.product(arguments.seeds, arguments.tasks, arguments.algorithms)
        if settings_of(algorithm, task)
    ]
    runs = sorted(set(wanted) - finished(arguments.output), key=wanted.index) if is_leader() else []
    is_alone = rank_and_size() == (0, 1)
    if not is_alone:
        with Processes() as processes:
            runs = processes.exchange(runs)[0]
    if not runs:
        if is_leader():
            there = f"{arguments.output} has all {len(wanted)} runs that there are settings for"
            print(f"Nothing to do: {there}. Other -params need another --output")
        return
    failed = []
    start = time.perf_counter()
    with contextlib.ExitStack() as stack:
        map_runs: Any = map
        if is_alone:
            context = multiprocessing.get_context("spawn")
            pool = stack.enter_context(context.Pool(arguments.processes, ignore_interrupts))
            map_runs = pool.imap_unordered
        elif not is_leader():
            runs = [run for run in runs if run.algorithm in OURS]
        results = map_runs(functools.partial(train, arguments.final_episodes, arguments.params), runs)
        for number, (run, outcome) in enumerate(results, 1):
            minutes = (time.perf_counter() - start) / 60
            left = f"[{number}/{len(runs)}, {minutes:.0f} min, {minutes / number * (len(runs) - number):.0f} left]"
            if isinstance(outcome, Exception):
                if not is_alone:
                    # The other processes may be in another run
                    raise outcome
                result = repr(outcome)
                failed.append(f"{run}: {result}")
            elif not is_leader():
                continue
            else:
                pd.DataFrame(outcome).to_csv(arguments.output, mode="a", header=False, index=False)
                result = "{return:.1f}, {steps} steps, {seconds:.0f} s".format(**outcome[-1])
            print(left, f"{run.task} {run.algorithm} seed {run.seed}: {result}", flush=True)
    if failed:
        raise SystemExit("Failed:\n" + "\n".join(failed))


if __name__ == "__main__":
    main()
