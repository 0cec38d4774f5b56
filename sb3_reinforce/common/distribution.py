"""Learning in several processes: process 0 learns as one process does, and all collect for it."""

import time
from collections import deque
from collections.abc import Callable
from functools import wraps
from itertools import zip_longest
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.utils import set_random_seed

from sb3_reinforce.common.moments import normalizers, observation_moments, seen_since
from sb3_reinforce.common.processes import Finished, Processes, is_leader, rank_and_size
from sb3_reinforce.common.settings import ATTRIBUTES

Learn = TypeVar("Learn", bound=Callable[..., Any])

# The arguments that processes need not have in common
MAY_DIFFER = {"verbose", "device", "tensorboard_log"}
# Before each rollout all take over process 0's attributes of these types. If its ``_last_obs`` is None, all reset
SHARED = (bool, int, float, np.number, str, type(None), th.Generator)


def together(learn: Learn) -> Learn:
    """``learn`` in all processes at once."""

    @wraps(learn)
    def run(model: Any, /, *args: Any, **kwargs: Any) -> Any:
        if rank_and_size() == (0, 1):
            return learn(model, *args, **kwargs)
        with Processes() as processes:
            model._processes = processes
            try:
                model.check_same()
                if is_leader():
                    learn(model, *args, **kwargs)
                    processes.finish(model.shared_state())
                else:
                    model.follow()
            finally:
                model._processes = None
        return model

    return cast(Learn, run)


class Distributed(BaseAlgorithm):
    """What an algorithm does in several processes; without them, nothing."""

    _arguments: ClassVar[Any]
    _processes: Processes | None = None

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the generators and environments: ``seed`` plus the environment's index among all W·n."""
        rank, _ = rank_and_size()
        if rank > 0:
            # Without a seed too: if the script seeds PyTorch, all processes would draw the same actions. NumPy refuses
            # seeds above 2³² − 1
            seed = ((th.initial_seed() % 2**31 if seed is None else seed) + rank * self.n_envs) % 2**32
        super().set_random_seed(seed)

    def check_same(self) -> None:
        """Refuse processes that were started with different arguments."""
        own = {"algorithm": type(self).__name__, "n_envs": str(self.n_envs)}
        for name in sorted(self._arguments.keys() - MAY_DIFFER):
            value = getattr(self, ATTRIBUTES.get(name, name))
            # Without the address of a function
            own[name] = getattr(value, "__qualname__", repr(value) if isinstance(value, SHARED) else str(type(value)))
        own["policy"] += f" {self.policy}"
        own["spaces"] = f"{self.observation_space} and {self.action_space}"
        own["moments of VecNormalize"] = str([moments.mean.shape for moments in self._moments()])
        first, *others = cast(Processes, self._processes).exchange(own)
        for rank, other in enumerate(others, 1):
            for name in first:
                if first[name] != other.get(name):
                    raise ValueError(
                        "All processes must be started with the same arguments: process 0 has "
                        f"{name}={first[name]}, and process {rank} has {name}={other.get(name)}"
                    )

    def shared_state(self) -> dict[str, Any]:
        """What the other processes need to collect as process 0 does."""
        shared = {name for name, value in vars(self).items() if isinstance(value, SHARED)} - MAY_DIFFER
        attributes = {name: getattr(self, name) for name in shared}
        policy = {name: values.cpu() for name, values in self.policy.state_dict().items()}
        # A search draws candidates of the trainable parameters
        trainable = [parameter.requires_grad for parameter in self.policy.parameters()]
        return {"policy": policy, "trainable": trainable, "attributes": attributes, "moments": self._moments()}

    def adopt(self, state: dict[str, Any]) -> None:
        """Become what process 0 is."""
        self.policy.load_state_dict(state["policy"])
        for parameter, is_trainable in zip(self.policy.parameters(), state["trainable"], strict=True):
            parameter.requires_grad_(is_trainable)
        vars(self).update(state["attributes"])
        for own, total in zip(self._moments(), state["moments"], strict=True):
            vars(own).update(vars(total))
        # Without a limit, since all episodes of a rollout are sent
        self.ep_info_buffer = deque()
        self.ep_success_buffer = deque()
        cast(Processes, self._processes).state = state

    def _moments(self) -> list[RunningMeanStd]:
        """The statistics of each VecNormalize, in a fixed order."""
        stack = normalizers(self.env)
        return [moments for each in stack for moments in (*observation_moments(each).values(), each.ret_rms)]

    def share_of(self, n_episodes: int) -> int:
        """How many episodes this process plays: the quotas of all W·n environments differ by at most 1."""
        processes = self._processes
        if processes is None:
            return n_episodes
        # Episode e is of environment e modulo W·n
        return sum(e // self.n_envs % processes.size == processes.rank for e in range(n_episodes))

    def start_round(self) -> None:
        """Process 0 lets the others collect too."""
        if self._processes is not None and self._processes.rank == 0:
            self._processes.send(self.shared_state())
            self._processes.in_round = True

    def end_round(self, part: Any) -> list[Any]:
        """In process 0 the parts of all, whose steps, episodes and observations it adds to its own; elsewhere none."""
        processes = cast(Processes, self._processes)
        if processes.rank > 0:
            state = processes.state
            steps = self.num_timesteps - state["attributes"]["num_timesteps"]
            seen = [*map(seen_since, state["moments"], self._moments())]
            processes.send((part, steps, (self.ep_info_buffer, self.ep_success_buffer), seen, processes.waited))
            return []
        parts = [part]
        reports = processes.receive()
        processes.in_round = False
        elapsed = time.perf_counter() - processes.started
        all_waited = processes.waited
        buffers: list[Any] = [(self.ep_info_buffer, self.ep_success_buffer)]
        for other_part, steps, episodes, seen, waited in reports:
            parts.append(other_part)
            self.num_timesteps += steps
            buffers.append(episodes)
            for total, each in zip(self._moments(), seen, strict=True):
                total.combine(each)
            all_waited += waited
        for own, *others in zip(*buffers, strict=True):
            # The newest episodes of each process in turn: otherwise the last process would fill the window
            turns = zip_longest(*map(reversed, [own, *others]))
            newest_first = [each for turn in turns for each in turn if each is not None]
            own.clear()
            own.extend(reversed(newest_first))
        self.logger.record("time/wait_fraction", all_waited / (elapsed * processes.size))
        return parts

    def follow(self) -> None:
        """Collect for process 0 until it has finished learning."""
        processes = cast(Processes, self._processes)
        self.set_logger(Logger(folder=None, output_formats=[]))
        # Where the script has seeded or restored the generators, all would draw the same actions
        seed = int(th.randint(2**31, ())) + processes.rank
        set_random_seed(seed)
        self.action_space.seed(seed)
        # With None log π would not be computed, and the callbacks of process 0 may read it
        callback = self._init_callback([])
        try:
            self.adopt(*processes.receive())
            if self.num_timesteps == 0:
                # The reset is within the round, where a search has frozen VecNormalize: its candidates need one scale
                self._last_obs = None
            while True:
                self.collect_part(callback)
                self.adopt(*processes.receive())
        except Finished as end:
            self.adopt(*end.args)
        except BaseException:
            # Process 0 has dropped the rollout
            self._last_obs = None
            raise

    def collect_part(self, callback: BaseCallback) -> None:
        """Collect this process's part of a rollout."""
        raise NotImplementedError
