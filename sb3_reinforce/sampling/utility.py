"""The utility of candidates by episodes, as an estimator of FiniteDifference asks for it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_reinforce.estimation.estimators import check_candidates
from sb3_reinforce.sampling.candidate_actors import LoopActor, make_candidate_actor
from sb3_reinforce.sampling.candidates import CandidateStep, columns_of, evaluate_candidates, seeds_of
from sb3_reinforce.sampling.collection import goes_on, is_attached
from sb3_reinforce.sampling.normalization import ObservationStatistics


class Stopped(Exception):
    """A callback returned False; it ends an update from inside the estimator."""


@dataclass
class EpisodicUtility:
    """
    U(θ) = E[Σ_t r_t] by the episodes of one update of a FiniteDifference, whose seeds begin with ``first_seed``.

    It keeps all candidates with their columns and values; ``observed`` has the statistics of each frozen VecNormalize.
    """

    model: Any
    searched: Sequence[th.nn.Parameter]
    callback: BaseCallback
    observed: list[ObservationStatistics]
    first_seed: int
    candidates: list[th.Tensor] = field(default_factory=list)
    columns: list[th.Tensor] = field(default_factory=list)
    values: list[th.Tensor] = field(default_factory=list)

    def __post_init__(self) -> None:
        model = self.model
        self.actor = make_candidate_actor(model.policy, self.searched, model.n_envs, model.deterministic)
        self.is_attached = is_attached(self.callback)
        self.n_parameters = sum(parameter.numel() for parameter in self.searched)
        if model.verbose >= 1 and model._n_updates == 0 and isinstance(self.actor, LoopActor):
            print(f"{type(model.policy).__name__} is not a plain MLP: candidates act one by one, which is slower")

    def __call__(self, candidates: th.Tensor) -> th.Tensor:
        """The mean returns of candidates ``(k, n)``, or ``(m, k, n)`` if only those in one column share seeds."""
        model = self.model
        n_episodes = model.n_eval_episodes
        checked = check_candidates("estimator must call the utility with", candidates, self.n_parameters)
        thetas = checked.reshape(-1, self.n_parameters)
        seeds = seeds_of(candidates.shape, n_episodes, self.first_seed)
        processes = model._processes
        # Each process evaluates a part of the candidates
        own = slice(None) if processes is None else np.array_split(range(len(thetas)), processes.size)[processes.rank]
        returns = evaluate_candidates(
            self.actor,
            model.env,
            thetas[own],
            seeds[own] if model.common_random_numbers else None,
            n_episodes,
            model.max_episode_steps,
            self._on_step,
        )
        if processes is not None:
            returns = np.concatenate(processes.exchange(returns))
        values = th.as_tensor(returns).mean(1)
        self.candidates.append(thetas)
        self.columns.append(th.as_tensor(columns_of(candidates.shape)))
        self.values.append(values)
        return values.reshape(candidates.shape[:-1])

    def _on_step(self, step: CandidateStep) -> None:
        """Count a step of the environments and call the callback; raise ``Stopped`` if it returns False."""
        self.model.num_timesteps += len(step.dones)
        if step.finished.any():
            finished = np.flatnonzero(step.finished)
            self.model._update_info_buffer([step.infos[i] for i in finished], step.dones[finished])
        for each in self.observed:
            each.update()
        if not self.is_attached:
            return
        self.callback.update_locals({"self": self.model, **vars(step)})
        # A callback may save a wrapper, and must find it as the user has set it
        for each in self.observed:
            each.thaw()
        try:
            go_on = goes_on(self.callback)
        finally:
            for each in self.observed:
                each.freeze()
        if not go_on:
            raise Stopped
