"""Callbacks that watch the gradient while a model trains: how noisy it is, and which pitfalls it has fallen into."""

import math
import warnings
from collections import deque
from collections.abc import Iterable

import torch as th

from sb3_reinforce.common.arguments import check_integer
from sb3_reinforce.common.tensors import to_vector
from sb3_reinforce.diagnostics.baseline_comparison import check_critic, functions_of, weights_by
from sb3_reinforce.diagnostics.diagnosis import Diagnosis
from sb3_reinforce.diagnostics.pitfalls import CAUSES, PITFALLS, History, Update
from sb3_reinforce.diagnostics.randomness import randomness
from sb3_reinforce.diagnostics.sampling import check_model, evenly_spread, training_weights
from sb3_reinforce.diagnostics.statistics import compute_moments, gram, noise_scale, signal_to_noise, variance
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import first_step, gradient_blocks
from sb3_reinforce.estimation.weights import training_batch
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.policies.evaluation import (
    actor_parameters,
    evaluation_mode,
    leave_no_graph,
    log_prob_of,
    temperature_of,
)


class GradientQualityCallback(Diagnosis):
    """
    Logs how noisy the gradient is, computed from the rollouts of the training itself.

    Every ``every`` rollouts:

    - ``gradient/snr``: ``N ‖E g‖² / tr Σ``, the signal-to-noise ratio of this rollout's gradient, with the weights of
      training;
    - ``gradient/noise_scale``: ``tr Σ / ‖E g‖²``, the number of episodes whose mean gradient has a
      signal-to-noise ratio of 1;
    - ``gradient/variance/<baseline>``: tr Σ of one episode for each of ``baselines``, computed from these episodes;
    - ``gradient/cosine``: the cosine between the last two updates of the policy's parameters.

    With ``episodes_per_start`` only the cosine is logged, since the episodes of a start are not independent. A
    FiniteDifference has only the cosine too, as its episodes have no gradients. It logs the quality of its estimate:
    ``train/r_squared``, ``train/residual_std``, ``train/standard_error``.

    A sample g is the gradient of one episode, or of the part of it in a fixed rollout. The estimates come from a single
    rollout and are noisy if it has few episodes. With fewer than two only the cosine is logged, and while REINFORCE's
    actor is frozen nothing. A measurement costs about one forward and one backward pass over at most ``max_episodes``
    episodes for an ``MlpPolicy``, two more with ``"optimal"``, and the same again for every 256 MiB that the gradients
    take. For other policies it costs a backward pass for each episode and each baseline. Nothing is sampled for it, and
    training is the same with and without it.

    :param every: Rollouts between two measurements
    :param baselines: Names or functions; ``"none"`` is always among them, and ``"value"`` needs a critic. A function
        with a memory learns from each measurement too: pass another instance than the model's
    :param max_episodes: Largest number of episodes of a rollout that are used
    :param verbose: Verbosity level
    :raises TypeError: If an argument is of the wrong kind, or the model is neither a REINFORCE nor a FiniteDifference
    :raises ValueError: If an argument is out of its range, if a baseline is unknown or needs a critic that the model
        lacks, if the model's episodes share gSDE's noise, or if it is passed to an ``EventCallback`` such as
        ``EveryNTimesteps`` instead of ``learn``
    """

    def __init__(
        self,
        every: int = 10,
        baselines: Iterable[str | Baseline] = ("none", "time_mean"),
        max_episodes: int = 64,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.every = check_integer("every", every, 1)
        self.max_episodes = check_integer("max_episodes", max_episodes, 2)
        self.functions = functions_of(baselines)

    def _init_callback(self) -> None:
        super()._init_callback()
        if not isinstance(self.model, FiniteDifference):
            check_model(self.model, independent=True)
            check_critic(self.model, self.functions)

    def _forget(self) -> None:
        self.n_rollouts = 0
        self.thetas: deque[th.Tensor] = deque(maxlen=3)

    def _on_rollout_end(self) -> None:
        self.n_rollouts += 1
        n_left = -self.n_rollouts % self.every
        if n_left > 2:
            # A cosine needs the parameters at the ends of three rollouts in a row
            return
        is_search = isinstance(self.model, FiniteDifference)
        if is_search:
            theta = self.model.theta
        else:
            rollout = self.model.rollout
            actor = actor_parameters(rollout.policy, *first_step(rollout))
            leave_no_graph(rollout.policy, *first_step(rollout))
            if not actor:
                # It is frozen
                self.thetas.clear()
                return
            theta = to_vector(actor)
        if self.thetas and self.thetas[-1].shape != theta.shape:
            self.thetas.clear()
        self.thetas.append(theta)
        if n_left > 0:
            return
        figures = {} if is_search else self.measure(self.model.rollout)
        if len(self.thetas) == 3:
            before, after = th.stack(list(self.thetas)).diff(dim=0)
            figures["cosine"] = float(th.cosine_similarity(before, after, dim=0))
        for key, figure in figures.items():
            self.logger.record(f"gradient/{key}", figure)

    def measure(self, rollout: Rollout) -> dict[str, float]:
        """
        Compute what is logged of a rollout, apart from the cosine.

        :param rollout: ``model.rollout``, before the model trains on it
        :return: The figures by their keys without ``gradient/``; empty with fewer than two episodes or with
            ``episodes_per_start`` above 1
        """
        n_episodes = len(rollout.used_episodes)
        # Episodes that share their start are not independent
        if n_episodes < 2 or rollout.episodes_per_start > 1:
            return {}
        own_weights = training_weights(self.model)
        rollout = evenly_spread(rollout, self.max_episodes)
        weights = [own_weights, *(weights_by(function, rollout) for function in self.functions.values())]
        grams = [th.stack([gram(g) for g in block]) for block in gradient_blocks(rollout, *weights)]
        own, *others = map(compute_moments, th.stack(grams).sum(0))
        figures = {"snr": n_episodes * float(signal_to_noise(own)), "noise_scale": float(noise_scale(own))}
        for name, moments in zip(self.functions, others, strict=True):
            figures[f"variance/{name}"] = float(variance(moments))
        return figures


class PitfallCallback(Diagnosis):
    """
    Warns once about each known pitfall of the policy gradient, and names the argument to change.

    Where several pitfalls have one cause, only the cause is reported. ``found`` has the warnings so far, by the name of
    the pitfall.

    The pitfalls: a learning rate that is too large; one that is too small for the number of updates; returns that are
    not scaled; too few episodes; the total return; gradients that spike without clipping; a critic that explains hardly
    anything; a policy that is deterministic too early; episodes that are cut. They are detected from the log and the
    rollouts of the training: nothing is sampled for it, and training is not changed. The cost is two forward passes and
    a backward pass of the actor over each rollout.

    A FiniteDifference is refused: it has no returns that weight scores.

    :param verbose: Verbosity level
    :raises TypeError: If the model is not a REINFORCE
    :raises ValueError: If it is passed to an ``EventCallback`` such as ``EveryNTimesteps`` instead of ``learn``
    """

    # Components of a gradient that are kept
    N_COMPONENTS = 10_000

    def _init_callback(self) -> None:
        check_model(self.model)
        super()._init_callback()

    def _forget(self) -> None:
        self.found: dict[str, str] = {}
        self.updates: deque[Update] = deque(maxlen=50)
        self.n_updates = 0
        self.rollout: Rollout | None = None

    def _on_rollout_end(self) -> None:
        rollout: Rollout = self.model.rollout
        self.rollout = rollout
        policy = rollout.policy
        batch = training_batch(rollout, self.model.rollout_buffer, self.model.normalize_advantage)
        self.obs = batch.observations
        self.temperature = temperature_of(policy)
        # A copy: the buffer is reset before the update is examined
        self.targets = batch.returns.clone()
        log_prob = log_prob_of(policy, batch.observations, batch.actions)
        self.gradient = th.zeros(0)
        if log_prob.requires_grad and (parameters := actor_parameters(policy, *first_step(rollout))):
            objective = (log_prob * batch.weights).sum() / rollout.denominator
            gradient = to_vector(th.autograd.grad(objective, parameters, allow_unused=True))
            self.gradient = gradient[:: 1 + len(gradient) // self.N_COMPONENTS].clone()
        leave_no_graph(policy, *first_step(rollout))

    def _on_training_start(self) -> None:
        # An error or Ctrl-C may have come before its update
        self.rollout = None
        self.path = 0.0
        self.n_moves = 0

    def _on_rollout_start(self) -> None:
        self._examine()
        if self.n_moves == 0:
            self.first_timestep = self.num_timesteps

    def _on_training_end(self) -> None:
        self._examine()

    def _examine(self) -> None:
        """Add the update after the last rollout to the history, and warn of new pitfalls."""
        if self.rollout is None or not self.logger.name_to_value:
            return
        update = self._describe_update(self.rollout)
        self.updates.append(update)
        self.n_updates += 1
        self.path += math.sqrt(2 * max(update.kl, 0.0))
        if update.kl != 0:
            self.n_moves += 1
        self.rollout = None
        total_timesteps = self.locals["total_timesteps"]
        progress_remaining = 1.0 - min(1.0, self.num_timesteps / total_timesteps)
        share = min(1.0, (self.num_timesteps - self.first_timestep) / max(1, total_timesteps - self.first_timestep))
        updates = list(self.updates)
        history = History(self.model, updates, self.n_updates, progress_remaining, self.path, self.n_moves, share)
        for name, pitfall in PITFALLS.items():
            is_explained = not CAUSES.get(name, set()).isdisjoint(self.found)
            sentence = None if name in self.found or is_explained else pitfall(history)
            if sentence is not None:
                self.found[name] = sentence
                warnings.warn(sentence, stacklevel=2)

    @th.no_grad()
    def _describe_update(self, rollout: Rollout) -> Update:
        """What is known of the last update, which was computed from this rollout."""
        logged = self.logger.name_to_value
        returns = rollout.returns[rollout.used]
        with evaluation_mode(rollout.policy):
            noise = randomness(rollout.policy, self.obs, -logged.get("train/entropy_loss", math.nan))
        return Update(
            kl=logged.get("train/kl", math.nan),
            randomness=noise,
            grad_norm=logged.get("train/grad_norm", math.nan),
            explained_variance=logged.get("train/explained_variance", math.nan),
            gradient=self.gradient,
            return_scale=float(returns.square().mean().sqrt()),
            target_scale=float(self.targets.square().mean().sqrt()),
            target_std=float(self.targets.std(correction=0)),
            n_episodes=len(rollout.used_episodes),
            n_steps=len(returns),
            used_fraction=len(returns) / rollout.used.numel(),
            temperature=self.temperature,
        )
