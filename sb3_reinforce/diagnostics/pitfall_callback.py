"""The pitfalls of the policy gradient, reported while a model trains."""

import math
import warnings
from collections import deque
from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import TensorOrDict, select, take, to_vector
from sb3_reinforce.diagnostics.pitfalls import CAUSES, PITFALLS, History, Update
from sb3_reinforce.diagnostics.sampling import check_model, training_weights
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.policies.evaluation import log_prob_and_entropy, set_temperature
from sb3_reinforce.policies.plain_mlp import temperature_hooks
from sb3_reinforce.reinforce import REINFORCE


class PitfallCallback(BaseCallback):
    """
    Warns once about each of eight known pitfalls of the policy gradient, and names the argument to change.

    Of several pitfalls with one cause only the cause is reported.

    The pitfalls are those of ``pitfalls.PITFALLS``: a learning rate that is too large, returns that are not scaled, too
    few episodes, the total return, gradients that spike without clipping, a critic that explains nothing, a policy that
    is deterministic too early, and episodes that are cut. They are detected from what training computes anyway; the
    cost is three forward passes and a backward pass over at most 256 steps of a rollout. Training is not changed.

    A FiniteDifference is refused: it has no returns that weight scores.

    :param verbose: Verbosity level
    :raises TypeError: If the model is not a REINFORCE
    """

    # Steps behind a KL divergence, and components of a gradient that are kept
    N_STEPS = 256
    N_COMPONENTS = 10_000

    def __init__(self, verbose: int = 0):
        super().__init__(verbose)
        self.found: dict[str, str] = {}
        self.last_model: Any = None

    def _init_callback(self) -> None:
        check_model(self.model)
        # What is known of a model is kept from one learn() to the next, but not for another model
        if self.model is not self.last_model:
            self.last_model = self.model
            self.found = {}
            self.updates: deque[Update] = deque(maxlen=50)
            self.n_updates = 0
            self.rollout: Rollout | None = None

    def _on_training_start(self) -> None:
        self.total_timesteps: int = self.locals["total_timesteps"]

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model = cast(REINFORCE, self.model)
        rollout = self.rollout = cast(Rollout, model.rollout)
        self.temperature = temperature_of(model.policy)
        log_prob = self.log_prob(rollout)
        self.log_prob_before = log_prob.detach()
        self.gradient = th.zeros(0)
        if log_prob.requires_grad:
            parameters = [parameter for parameter in model.policy.parameters() if parameter.requires_grad]
            weights = self.first(training_weights(model), rollout).to(log_prob)
            gradient = to_vector(th.autograd.grad((log_prob * weights).sum(), parameters, allow_unused=True))
            self.gradient = gradient[:: 1 + len(gradient) // self.N_COMPONENTS].clone()

    def _on_rollout_start(self) -> None:
        self.examine()

    def _on_training_end(self) -> None:
        self.examine()

    def log_prob(self, rollout: Rollout) -> th.Tensor:
        """log π of the first used steps of a rollout with the present parameters, shape ``(n,)``."""
        actions = as_policy_actions(self.first(rollout.actions, rollout), self.model.action_space)
        return log_prob_and_entropy(rollout.policy, self.first(rollout.observations, rollout), actions)[0]

    @th.no_grad()
    def std(self, rollout: Rollout) -> float:
        """
        The mean standard deviation of the actions at the first used steps with the present parameters; NaN if the
        policy is not Gaussian.

        With gSDE it depends on the observation, and ``train/std`` describes the noise weights instead.
        """
        if not isinstance(self.model.action_space, spaces.Box):
            return math.nan
        distribution = rollout.policy.get_distribution(self.first(rollout.observations, rollout)).distribution
        return float(distribution.stddev.mean()) if isinstance(distribution, th.distributions.Normal) else math.nan

    def first(self, tensors: TensorOrDict, rollout: Rollout) -> TensorOrDict:
        """The first used steps, at most ``N_STEPS``, of a tensor (n_steps, n_envs, ...) of the rollout, or a dict."""
        return take(select(tensors, rollout.used), th.arange(min(self.N_STEPS, int(rollout.used.sum()))))

    def examine(self) -> None:
        """Add the update after the last rollout to the history, and warn of new pitfalls."""
        if self.rollout is None or not self.logger.name_to_value:
            return
        self.updates.append(self.update(self.rollout))
        self.n_updates += 1
        self.rollout = None
        progress_remaining = 1.0 - min(1.0, self.num_timesteps / self.total_timesteps)
        history = History(cast(REINFORCE, self.model), list(self.updates), self.n_updates, progress_remaining)
        for name, pitfall in PITFALLS.items():
            is_explained = not CAUSES.get(name, set()).isdisjoint(self.found)
            sentence = None if name in self.found or is_explained else pitfall(history)
            if sentence is not None:
                self.found[name] = sentence
                warnings.warn(sentence, stacklevel=2)

    @th.no_grad()
    def update(self, rollout: Rollout) -> Update:
        """What is known of the last update, which was computed from this rollout."""
        logged = self.logger.name_to_value
        used = rollout.used
        present = temperature_of(rollout.policy)
        # A falling temperature changes log π too, whatever the step
        set_temperature(rollout.policy, self.temperature)
        change = self.log_prob_before - self.log_prob(rollout).detach()
        set_temperature(rollout.policy, present)
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
            temperature=self.temperature,
        )


def temperature_of(policy: ActorCriticPolicy) -> float:
    """The temperature at which a policy acts."""
    layer = getattr(policy, "action_net", None)
    hooks = temperature_hooks(layer) if layer is not None else []
    return float(hooks[0].temperature) if hooks else 1.0
