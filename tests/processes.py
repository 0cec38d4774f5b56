"""Several processes that are one group of PyTorch's, as torchrun makes them, but forked: torchrun takes seconds."""

import multiprocessing
import os
import pickle
import sys
import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import torch.distributed as dist
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

TORCHRUN = (sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
# Longer than a busy machine takes
WAIT_SECONDS = 120


def in_processes(size: int, function: Callable[[int], Any], folder: Path) -> list[Any]:
    """``function(rank)`` in each process: what it returns, or the error that it raises, or None if it dies."""
    context = multiprocessing.get_context("fork")
    pipes = [context.Pipe(duplex=False) for _ in range(size)]
    place = f"file://{folder / 'group'}"

    def run(rank: int) -> None:
        os.environ["MASTER_ADDR"] = "localhost"
        dist.init_process_group("gloo", init_method=place, rank=rank, world_size=size)
        try:
            answer = function(rank)
        except BaseException as error:
            answer = type(error)(*error.args)
        # Plainly, since PyTorch would send tensors by way of files
        pipes[rank][1].send_bytes(pickle.dumps(answer))

    processes = [context.Process(target=run, args=(rank,), daemon=True) for rank in range(size)]
    with warnings.catch_warnings():
        # Python warns of forks where there are threads
        warnings.simplefilter("ignore")
        for process in processes:
            process.start()
    answers = []
    try:
        for (reader, writer), process in zip(pipes, processes, strict=True):
            writer.close()
            assert reader.poll(WAIT_SECONDS), "a process waits for ever"
            try:
                answers.append(pickle.loads(reader.recv_bytes()))
            except EOFError:
                answers.append(None)
            process.join(WAIT_SECONDS)
    finally:
        for process in processes:
            process.kill()
    (folder / "group").unlink(missing_ok=True)
    return answers


class Replay(VecEnv):
    """Rollouts that were recorded, whatever the actions."""

    def __init__(self, model: Any, rollouts: Sequence[Any], starts_over: bool):
        n_envs = rollouts[0].columns.dones.shape[1]
        super().__init__(n_envs, model.observation_space, model.action_space)
        self.rollouts = rollouts
        self.starts_over = starts_over
        self.number = 0
        self.row = 0

    def reset(self) -> Any:
        return self.rollouts[self.number % len(self.rollouts)].observations[self.row]

    def step_async(self, actions: np.ndarray) -> None:
        """Nothing to do."""

    def step_wait(self) -> Any:
        rollout = self.rollouts[self.number % len(self.rollouts)]
        row = self.row
        infos = [
            {"TimeLimit.truncated": True, "terminal_observation": rollout.columns.terminal_obs[row, env]}
            if (row, env) in rollout.columns.terminal_obs
            else {}
            for env in range(self.num_envs)
        ]
        self.row += 1
        last = self.row == len(rollout.observations)
        obs = rollout.columns.last_obs if last else rollout.observations[self.row]
        if last:
            self.number += 1
            self.row = 0
            if self.starts_over:
                obs = self.reset()
        return obs, rollout.rewards[row], rollout.columns.dones[row], infos

    def close(self) -> None:
        """Nothing to do."""

    def get_attr(self, attr_name: str, indices: Any = None) -> Any:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Nothing to do."""

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


@dataclass
class Recorded:
    """What was collected in a rollout, and the states of the generators when it was complete."""

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    values: np.ndarray
    columns: Any
    generators: tuple[Any, ...]
    log: dict[str, Any]


class RecordRollouts(BaseCallback):
    """Keeps the rollouts of REINFORCE, and what was logged with the one before."""

    def __init__(self) -> None:
        super().__init__()
        self.rollouts: list[Recorded] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        buffer = self.locals["rollout_buffer"]
        arrays = deepcopy((buffer.observations, buffer.actions, buffer.rewards, buffer.values, self.locals["columns"]))
        self.rollouts.append(
            Recorded(*arrays, deepcopy((th.get_rng_state(), np.random.get_state())), logged(self.model))
        )


class ActAsRecorded(RecordRollouts):
    """Gives a model the actions of recorded rollouts, and the generators of their updates; then stops."""

    def __init__(self, given: Sequence[Recorded]):
        super().__init__()
        self.given = given

    def _on_step(self) -> bool:
        if len(self.rollouts) == len(self.given):
            return False
        row = self.locals["n_steps"]
        given = self.given[len(self.rollouts)]
        self.locals["rollout_buffer"].actions[row] = given.actions[row]
        # The last bit of V depends on the number of environments that it is computed for at once
        self.locals["rollout_buffer"].values[row] = given.values[row]
        return True

    def _on_rollout_end(self) -> None:
        of_torch, of_numpy = self.given[len(self.rollouts)].generators
        th.set_rng_state(of_torch)
        np.random.set_state(of_numpy)
        super()._on_rollout_end()


def logged(model: Any) -> dict[str, Any]:
    """The values of the log that depend neither on time nor on Monitor."""
    values = model.logger.name_to_value
    return {key: value for key, value in values.items() if not key.startswith(("time/", "rollout/ep_"))}
