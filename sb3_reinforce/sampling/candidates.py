"""
Many parameter vectors evaluated side by side in one VecEnv: who acts where, from which start, and for how long.

The queue of (candidate, episode) pairs is fixed before the first step, so that candidates whose episodes are short are
not sampled more often than others. It is worked off in one of two ways:

- With seeds, in rounds: as many pairs as there are environments start together, each from the seed of its episode, and
  the next round starts when the last of them is done. A VecEnv resets an environment by itself as soon as it is done,
  with no seed, so only a reset of all environments gives a seeded start. Until the slowest is done, the others idle.
- Without seeds, in one go: an environment that is done takes the next pair of the queue.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_reinforce.envs.checks import all_finite, format_number, is_finite
from sb3_reinforce.sampling.candidate_actors import MatrixActor

Pair: TypeAlias = tuple[int, int]  # (candidate, episode)


@dataclass(frozen=True)
class Step:
    """
    One step of all environments.

    :param new_obs: The observations after it
    :param rewards: The rewards, as the environments returned them
    :param dones: Whether an episode ended
    :param infos: The environments' infos
    :param finished: Whether an episode of a candidate ended
    """

    new_obs: Any
    rewards: np.ndarray
    dones: np.ndarray
    infos: list[dict[str, Any]]
    finished: np.ndarray


class Slots:
    """
    The pair that each environment is busy with, and what it has seen of it.

    Kept so that a step in which no episode ends costs next to nothing.

    :param queue: The pairs to work off
    :param n_envs: Number of environments
    :param max_episode_steps: The length beyond which an episode counts as one that never ends
    """

    def __init__(self, queue: list[Pair], n_envs: int, max_episode_steps: int):
        self.waiting = queue[n_envs:]
        self.pairs = queue[:n_envs]
        self.active = np.arange(n_envs) < len(self.pairs)
        self.n_active = len(self.pairs)
        self.totals = np.zeros(n_envs)
        self.clock, self.begun = 0, np.zeros(n_envs, dtype=int)
        self.max_episode_steps = self.deadline = max_episode_steps

    def add(self, rewards: np.ndarray, obs: Any) -> None:
        """
        Take in a step.

        :param rewards: Shape ``(n_envs,)``
        :param obs: The observations after it
        :raises ValueError: Naming the first candidate, episode and step where a number is not finite, or the ones of an
            episode that does not end
        """
        self.totals += rewards
        self.check("The reward", rewards)
        self.check_observations(obs)
        self.clock += 1
        if self.clock > self.deadline:
            late = int(np.argmax(self.active & (self.begun + self.max_episode_steps == self.deadline)))
            raise ValueError(
                f"An episode has not ended after max_episode_steps={self.max_episode_steps} steps "
                f"({self.describe(late)}): give the environment a time limit, or raise max_episode_steps. {UNCHANGED}"
            )

    def check_observations(self, obs: Any) -> None:
        """
        Check observations.

        :param obs: Those of the environments
        :raises ValueError: As ``add``
        """
        for key, part in obs.items() if isinstance(obs, dict) else (("", obs),):
            self.check(f"The observation {key!r}" if key else "The observation", part)

    def check(self, name: str, values: np.ndarray) -> None:
        """
        Check numbers that came from the environments.

        :param name: What they are, for the message
        :param values: Shape ``(n_envs, ...)``
        :raises ValueError: As ``add``
        """
        if all_finite(values):
            return
        bad = ~is_finite(values).reshape(len(values), -1).all(1) & self.active
        for i in np.flatnonzero(bad).tolist():
            raise ValueError(f"{name} of {self.describe(i)} is not finite: {format_number(values[i])}. {UNCHANGED}")

    def finish(self, finished: np.ndarray, returns: np.ndarray) -> list[int]:
        """
        Write the returns of finished episodes, and take the next pairs from the queue.

        :param finished: Which environments finished theirs, shape ``(n_envs,)``
        :param returns: Written to, shape ``(n_candidates, n_episodes)``
        :return: The environments that have a new pair
        """
        begun = []
        for i in np.flatnonzero(finished).tolist():
            returns[self.pairs[i]] = self.totals[i]
            self.totals[i], self.begun[i] = 0, self.clock
            if self.waiting:
                self.pairs[i] = self.waiting.pop(0)
                begun.append(i)
            else:
                # The environment acts on as it last did; its steps are counted and not used
                self.active[i] = False
                self.n_active -= 1
        self.deadline = self.max_episode_steps + int(self.begun[self.active].min(initial=self.clock))
        return begun

    def describe(self, env: int) -> str:
        """Where an environment is, for a message."""
        candidate, episode = self.pairs[env]
        return f"candidate {candidate}, episode {episode}, step {self.clock - self.begun[env]} (environment {env})"


UNCHANGED = "The policy is the one before this update."


def evaluate(
    actor: MatrixActor,
    env: VecEnv,
    thetas: th.Tensor,
    seeds: np.ndarray | None,
    n_episodes: int,
    max_episode_steps: int,
    on_step: Callable[[Step], None],
    vec_normalize: VecNormalize | None = None,
) -> np.ndarray:
    """
    The return Σ_t r_t of every episode of every candidate.

    :param actor: Acts with the candidates
    :param env: The environments; they are left in the middle of episodes
    :param thetas: The candidates, shape ``(m, n)``
    :param seeds: The seed of each episode, shape ``(m, n_episodes)``; None to start anywhere
    :param n_episodes: Episodes per candidate
    :param max_episode_steps: The length beyond which an episode counts as one that never ends
    :param on_step: Called after each step of the environments; it may raise to stop
    :param vec_normalize: Where it scales rewards, returns are sums of the rewards before that: its scale drifts
    :return: Shape ``(m, n_episodes)``, float64
    :raises ValueError: If a reward or observation is not finite, an episode does not end, or seeds cannot be set
    :raises ConnectionError: If a worker of a ``SubprocVecEnv`` died
    """
    original = vec_normalize.get_original_reward if vec_normalize is not None and vec_normalize.norm_reward else None
    returns = np.zeros((len(thetas), n_episodes))
    for queue in queues(len(thetas), n_episodes, env.num_envs, in_rounds=seeds is not None):
        slots = Slots(queue, env.num_envs, max_episode_steps)
        obs = start(env, slots.pairs, seeds)
        slots.check_observations(obs)
        begun = list(range(len(slots.pairs)))
        while slots.n_active:
            if begun:
                actor.assign(begun, thetas[[slots.pairs[i][0] for i in begun]])
                begun = []
            new_obs, rewards, dones, infos = env.step(actor.act(obs))
            obs = new_obs
            slots.add(rewards if original is None else original(), new_obs)
            finished = dones & slots.active
            on_step(Step(new_obs, rewards, dones, infos, finished))
            # any() costs several times as much on a few numbers
            if np.count_nonzero(finished):
                begun = slots.finish(finished, returns)
    return returns


def queues(n_candidates: int, n_episodes: int, n_envs: int, in_rounds: bool) -> list[list[Pair]]:
    """
    Every candidate's every episode, the first episodes first.

    :param n_candidates: Number of candidates
    :param n_episodes: Episodes per candidate
    :param n_envs: Number of environments
    :param in_rounds: Whether to cut the queue into rounds of at most ``n_envs`` pairs
    """
    queue = [(candidate, episode) for episode in range(n_episodes) for candidate in range(n_candidates)]
    size = n_envs if in_rounds else len(queue)
    return [queue[first : first + size] for first in range(0, len(queue), size)]


def start(env: VecEnv, pairs: list[Pair], seeds: np.ndarray | None) -> Any:
    """
    Start an episode in every environment.

    ``VecEnv.seed(s)`` can only give environment i the seed s + i. So each environment is seeded by a reset of its own,
    and the reset of all that follows, which goes through every wrapper, draws on from there.

    :param env: The environments
    :param pairs: The (candidate, episode) of the first environments
    :param seeds: The seed of each episode, shape ``(n_candidates, n_episodes)``; None to start anywhere
    :return: The first observations
    :raises ValueError: If the environments cannot be seeded one by one
    """
    if seeds is not None:
        envs_with: dict[int, list[int]] = {}
        for i, pair in enumerate(pairs):
            envs_with.setdefault(int(seeds[pair]), []).append(i)
        for seed, envs in envs_with.items():
            try:
                env.env_method("reset", seed=seed, indices=envs)
            except NotImplementedError as error:
                raise ValueError(
                    "common_random_numbers=True needs env_method('reset', seed=...), which "
                    f"{type(env.unwrapped).__name__} does not have: set common_random_numbers=False"
                ) from error
    return env.reset()
