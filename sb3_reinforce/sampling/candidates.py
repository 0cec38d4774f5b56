"""
Many parameter vectors evaluated side by side in one VecEnv.

The queue of (candidate, episode) pairs is fixed before the first step; otherwise short episodes would be sampled more
often. With seeds, the queue is processed in rounds. All pairs of a round start together, each from the seed of its
episode: the resets that a VecEnv makes at the end of episodes have no seed. Without seeds, an environment whose episode
ends takes the next pair.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.tensors import stack, take
from sb3_reinforce.envs.checks import check_finite, check_length
from sb3_reinforce.envs.starts import are_alike, start_episodes
from sb3_reinforce.sampling.candidate_actors import CandidateActor
from sb3_reinforce.sampling.normalization import unscaled

Pair: TypeAlias = tuple[int, int]  # (candidate, episode)


@dataclass(frozen=True)
class CandidateStep:
    """One step of all environments; ``finished`` is True where an episode of a candidate ended."""

    new_obs: Any
    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]
    finished: np.ndarray


class EpisodeTracker:
    """The pair that each environment runs and its return so far."""

    def __init__(self, queue: list[Pair], n_envs: int, max_episode_steps: int):
        self.pairs = queue[:n_envs]
        self.waiting = queue[n_envs:]
        self.active = np.arange(n_envs) < len(self.pairs)
        self.totals = np.zeros(n_envs)
        self.clock = 0
        self.started_at = np.zeros(n_envs, dtype=int)
        self.max_episode_steps = max_episode_steps
        # The first step of the longest episode that runs
        self.first_step = 0

    def add(self, rewards: np.ndarray, obs: Any) -> None:
        """Add a step, after checking that its numbers are finite and that no episode is longer than allowed."""
        check_length(self.clock - self.first_step, self.max_episode_steps)
        check_finite("The reward", rewards, (None,))
        check_finite("The observation", obs, (None,))
        self.totals += rewards
        self.clock += 1

    def finish(self, finished: np.ndarray, returns: np.ndarray) -> list[int]:
        """Write the finished episodes to ``returns[candidate, episode]``, and list the environments with new pairs."""
        restarted = []
        for env in np.flatnonzero(finished).tolist():
            returns[self.pairs[env]] = self.totals[env]
            self.totals[env] = 0
            self.started_at[env] = self.clock
            if self.waiting:
                self.pairs[env] = self.waiting.pop(0)
                restarted.append(env)
            else:
                # Its last candidate keeps acting: these steps are only counted
                self.active[env] = False
        self.first_step = int(self.started_at.min())
        return restarted


def columns_of(shape: Sequence[int]) -> np.ndarray:
    """The column of each candidate of a shape ``(m, k, n)``; candidates ``(k, n)`` are one column."""
    n_columns = shape[1] if len(shape) == 3 else 1
    columns: np.ndarray = np.arange(math.prod(shape[:-1])) % n_columns
    return columns


def seeds_of(shape: Sequence[int], n_episodes: int, first_seed: int) -> np.ndarray:
    """
    Seeds of the episodes of candidates of a shape ``(k, n)`` or ``(m, k, n)``, a row of ``n_episodes`` for each.

    Candidates ``(k, n)`` all share seeds; of ``(m, k, n)`` the m of a column do, such as θ + δ and θ − δ.
    """
    return (first_seed + columns_of(shape)[:, None] * n_episodes + np.arange(n_episodes)) % 2**31


def evaluate_candidates(
    actor: CandidateActor,
    env: VecEnv,
    thetas: th.Tensor,
    seeds: np.ndarray | None,
    n_episodes: int,
    max_episode_steps: int,
    on_step: Callable[[CandidateStep], None],
) -> np.ndarray:
    """Unscaled returns Σ_t r_t of candidates ``(m, n)``, shape ``(m, n_episodes)``; ``seeds`` has this shape too."""
    returns = np.zeros((len(thetas), n_episodes))
    if seeds is not None:
        # Pending seeds, as make_vec_env(..., seed=...) leaves them, would replace the seeds of the first round
        env.reset()
    # The first observation of each seed
    met: dict[int, Any] = {}
    queue = [(candidate, episode) for episode in range(n_episodes) for candidate in range(len(thetas))]
    size = max(1, len(queue)) if seeds is None else env.num_envs
    for first in range(0, len(queue), size):
        tracker = EpisodeTracker(queue[first : first + size], env.num_envs, max_episode_steps)
        starts = None if seeds is None else np.array([seeds[pair] for pair in tracker.pairs])
        obs = start_episodes(env, starts)
        check_finite("The observation", obs, (None,))
        if starts is not None:
            compare_with_earlier(met, starts, obs)
        started = list(range(len(tracker.pairs)))
        while tracker.active.any():
            if started:
                actor.assign(started, thetas[[tracker.pairs[i][0] for i in started]])
                started = []
            actions = actor.act(obs)
            check_finite("The policy's action", actions, (None,))
            with unscaled(env):
                obs, rewards, dones, infos = env.step(actions)
            tracker.add(rewards, obs)
            # Some VecEnvs give numbers
            dones = np.asarray(dones, dtype=bool)
            finished = dones & tracker.active
            on_step(CandidateStep(obs, rewards, dones, infos, finished))
            if finished.any():
                started = tracker.finish(finished, returns)
    return returns


def compare_with_earlier(met: dict[int, Any], seeds: np.ndarray, obs: Any) -> None:
    """Warn where an episode starts with another observation than the first one of its seed, which ``met`` keeps."""
    for env, seed in enumerate(seeds.tolist()):
        # By a list, which copies: some VecEnvs reuse the array
        one = take(obs, [env])
        if not are_alike(stack([met.setdefault(seed, one), one]), size=2):
            warnings.warn(
                "Common random numbers do not reduce the noise here: environments reset with the same seed, and then "
                "once more without a seed, return different observations. Let the environment draw all random numbers "
                "from self.np_random, or train FiniteDifference with common_random_numbers=False",
                stacklevel=3,
            )
            return
