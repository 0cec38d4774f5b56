"""The utility of candidates, as an estimator of FiniteDifference asks for it."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_reinforce.estimation.estimators import check_candidates
from sb3_reinforce.sampling.candidate_actors import MatrixActor
from sb3_reinforce.sampling.candidates import Step, evaluate
from sb3_reinforce.sampling.normalization import Observed


class Stopped(Exception):
    """A callback returned False: ends an update from inside the estimator."""


class Utility:
    """
    U(θ) = E[Σ_t r_t] by episodes in a model's environments: a function that keeps what it was asked and has answered.

    :param model: A ``FiniteDifference``; its ``num_timesteps`` and statistics of episodes are kept up to date
    :param actor: What acts with candidates
    :param callback: Called at each step of the environments
    :param observed: What takes in the observations of each step, None for nothing
    :param first_seed: The seed of the first episode
    """

    def __init__(
        self, model: Any, actor: MatrixActor, callback: BaseCallback, observed: Observed | None, first_seed: int
    ):
        self.model, self.actor, self.callback, self.observed = model, actor, callback, observed
        self.first_seed = first_seed
        self.candidates: list[th.Tensor] = []
        self.values: list[th.Tensor] = []

    def __call__(self, candidates: th.Tensor) -> th.Tensor:
        """
        U of candidates: the mean return of ``n_eval_episodes`` episodes of each.

        :param candidates: Shape ``(k, n)``, or ``(m, k, n)`` where only candidates of one column are compared
        :return: Shape ``(k,)`` or ``(m, k)``, float64
        :raises Stopped: If the callback returns False
        :raises ValueError: If a number is not finite, or an episode does not end
        """
        model, n_episodes = self.model, self.model.n_eval_episodes
        thetas = check_candidates(candidates, model.n_parameters).reshape(-1, model.n_parameters)
        columns = np.arange(len(thetas)) % candidates.shape[1] if candidates.dim() == 3 else np.zeros(len(thetas), int)
        seeds = (self.first_seed + columns[:, None] * n_episodes + np.arange(n_episodes)) % 2**31
        returns = evaluate(
            self.actor,
            model.env,
            thetas,
            seeds if model.common_random_numbers else None,
            n_episodes,
            model.max_episode_steps,
            self._on_step,
            model.get_vec_normalize_env(),
        )
        values = th.as_tensor(returns).mean(1)
        self.candidates.append(thetas)
        self.values.append(values)
        return values.reshape(candidates.shape[:-1])

    def _on_step(self, step: Step) -> None:
        """Count a step of the environments and tell the callback; raise ``Stopped`` if it returns False."""
        self.model.num_timesteps += len(step.dones)
        if np.count_nonzero(step.finished):
            finished = np.flatnonzero(step.finished)
            self.model._update_info_buffer([step.infos[i] for i in finished], step.dones[finished])
        self.callback.update_locals({"self": self.model, **vars(step)})
        if self.observed is None:
            go_on = self.callback.on_step()
        else:
            self.observed.update()
            # A callback may save the wrapper, and must find it as the user has set it
            self.observed.vec_normalize.training = True
            go_on = self.callback.on_step()
            self.observed.vec_normalize.training = False
        if not go_on:
            raise Stopped
