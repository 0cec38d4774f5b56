"""The pitfalls of the policy gradient, reported while a model trains."""

import math
import warnings
from collections import deque
from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import TensorOrDict, select, take, to_vector
from sb3_reinforce.diagnostics.pitfalls import PITFALLS
from sb3_reinforce.diagnostics.sampling import check_model, training_weights
from sb3_reinforce.diagnostics.updates import Seen, Update
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import scored_parameters
from sb3_reinforce.policies.evaluation import Parameters, log_prob_and_entropy
from sb3_reinforce.reinforce import REINFORCE


class PitfallCallback(BaseCallback):
    """
    Says once, in a warning, which of the known pitfalls training has fallen into, and which argument to change.

    The pitfalls are those of ``pitfalls.PITFALLS``. They are read from what training has logged and computed anyway;
    the cost is three forward passes and a backward pass over at most 256 steps of a rollout. Nothing of the training
    is changed.

    They are those of the likelihood ratio: a FiniteDifference has no returns to weigh, and is refused.

    :param verbose: Verbosity level
    :raises TypeError: If the model is not a REINFORCE
    """

    # Steps behind a KL divergence, and components of a gradient that are kept
    N_STEPS, N_COMPONENTS = 256, 10_000

    def __init__(self, verbose: int = 0):
        super().__init__(verbose)
        self.found: dict[str, str] = {}
        self.seen_model: Any = None

    def _init_callback(self) -> None:
        check_model(self.model)
        # What is known of a model lasts for all its training, and is not told of another
        if self.model is not self.seen_model:
            self.seen_model, self.found = self.model, {}
            self.updates: deque[Update] = deque(maxlen=50)
            self.n_updates = 0
            self.rollout: Rollout | None = None
            self.parameters: Parameters = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model = cast(REINFORCE, self.model)
        rollout = self.rollout = cast(Rollout, model.rollout)
        self.parameters = self.parameters or scored_parameters(rollout)
        log_prob = self.log_prob(rollout)
        weights = training_weights(model) * rollout.discounts
        weighed = (log_prob * weights[rollout.used][: len(log_prob)].to(log_prob)).sum()
        gradient = to_vector(th.autograd.grad(weighed, self.parameters))
        self.before, self.gradient = log_prob.detach(), gradient[:: 1 + len(gradient) // self.N_COMPONENTS].clone()

    def _on_rollout_start(self) -> None:
        self.look()

    def _on_training_end(self) -> None:
        self.look()

    def log_prob(self, rollout: Rollout) -> th.Tensor:
        """
        log π of the first used steps of a rollout, now.

        :param rollout: The rollout
        """
        actions = as_policy_actions(self.first(rollout.actions, rollout), self.model.action_space)
        return log_prob_and_entropy(rollout.policy, self.first(rollout.observations, rollout), actions)[0]

    @th.no_grad()
    def std(self, rollout: Rollout) -> float:
        """
        The mean standard deviation of the actions at the first used steps of a rollout, now; NaN if not Gaussian.

        With gSDE it depends on the observation, and ``train/std`` is that of the noise's weights.

        :param rollout: The rollout
        """
        if not isinstance(self.model.action_space, spaces.Box):
            return math.nan
        distribution = rollout.policy.get_distribution(self.first(rollout.observations, rollout)).distribution
        return float(distribution.stddev.mean()) if isinstance(distribution, th.distributions.Normal) else math.nan

    def first(self, tensors: TensorOrDict, rollout: Rollout) -> TensorOrDict:
        """
        The first used steps of a rollout, at most ``N_STEPS``.

        :param tensors: Observations or actions of the rollout
        :param rollout: The rollout
        """
        return take(select(tensors, rollout.used), th.arange(min(self.N_STEPS, int(rollout.used.sum()))))

    def look(self) -> None:
        """Take in the update that has followed the last rollout, and report what is new."""
        if self.rollout is None or not self.logger.name_to_value:
            return
        self.updates.append(self.update(self.rollout))
        self.n_updates, self.rollout = self.n_updates + 1, None
        seen = Seen(cast(REINFORCE, self.model), list(self.updates), self.n_updates)
        for name, pitfall in PITFALLS.items():
            sentence = pitfall(seen) if name not in self.found else None
            if sentence is not None:
                self.found[name] = sentence
                warnings.warn(sentence, stacklevel=2)

    def update(self, rollout: Rollout) -> Update:
        """
        What training knows of its last update.

        :param rollout: The rollout that it was made from
        """
        logged, used = self.logger.name_to_value, rollout.used
        change = self.before - self.log_prob(rollout).detach()
        return Update(
            kl=float(change.mean()),
            entropy=-logged.get("train/entropy_loss", math.nan),
            std=self.std(rollout),
            grad_norm=logged.get("train/grad_norm", math.nan),
            explained_variance=logged.get("train/explained_variance", math.nan),
            gradient=self.gradient,
            return_scale=float(rollout.returns[used].square().mean().sqrt()),
            return_std=float(rollout.returns[used].std(correction=0)),
            n_episodes=len(th.unique(rollout.episodes[used])),
            n_steps=int(used.sum()),
            used_fraction=float(used.double().mean()),
        )
