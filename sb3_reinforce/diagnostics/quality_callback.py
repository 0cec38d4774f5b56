"""The quality of the gradient, logged while a model trains."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, cast

import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_reinforce.common.arguments import check_integer
from sb3_reinforce.common.tensors import to_vector
from sb3_reinforce.diagnostics.baseline_comparison import functions_of, gradient_blocks
from sb3_reinforce.diagnostics.sampling import check_model, training_weights
from sb3_reinforce.diagnostics.statistics import compute_moments, gram, noise_scale, signal_to_noise, variance
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import scored_parameters
from sb3_reinforce.estimation.weights import check_baseline
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.reinforce import REINFORCE


class GradientQualityCallback(BaseCallback):
    """
    Logs how noisy the gradient is, computed from the rollouts of the training itself.

    Every ``every`` rollouts:

    - ``gradient/snr``: ``N ‖E g‖² / tr Σ``, the signal-to-noise ratio of this rollout's gradient, with the weights of
      training;
    - ``gradient/noise_scale``: ``tr Σ / ‖E g‖²``, the number of episodes with a signal-to-noise ratio of 1;
    - ``gradient/variance/<baseline>``: tr Σ of one episode for each of ``baselines``, computed from these episodes;
    - ``gradient/cosine``: the cosine between the last two updates of the policy's parameters.

    A FiniteDifference has only the cosine, as its episodes have no gradients of their own. It logs the quality of its
    estimate itself: ``train/r_squared``, ``train/residual_std``, ``train/standard_error``.

    A sample g is the gradient of one episode, or of the part of it in a fixed rollout. The estimates come from a single
    rollout and are noisy if it has few episodes; with fewer than two, or while the actor is frozen, nothing is logged.
    A measurement costs about one forward and 1 + (number of baselines) backward passes over at most ``max_episodes``
    episodes, two more with ``"optimal"``, and as much again for each 256 MiB of their gradients. Nothing is sampled for
    it, and training is the same with and without it.

    :param every: Rollouts between two measurements
    :param baselines: Names or functions; ``"none"`` is always among them, and ``"value"`` needs a critic
    :param max_episodes: Largest number of episodes of a rollout that are used
    :param verbose: Verbosity level
    :raises TypeError: If an argument is of the wrong kind, or the model is neither a REINFORCE nor a FiniteDifference
    :raises ValueError: If an argument is out of its range, if a baseline is unknown or needs a critic that the model
        lacks, or if the model's episodes are not independent because they share the noise of gSDE
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
        self.baselines = baselines
        self.last_model: Any = None

    def _init_callback(self) -> None:
        if self.model is not self.last_model:
            self.last_model = self.model
            self.n_rollouts = 0
            self.thetas: list[th.Tensor] = []
        if isinstance(self.model, FiniteDifference):
            return
        check_model(self.model, independent=True)
        self.functions = functions_of(cast(REINFORCE, self.model), self.baselines)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model = self.model
        self.n_rollouts += 1
        n_left = -self.n_rollouts % self.every
        if n_left > 2:
            # A cosine needs the parameters before the last three updates
            return
        figures: dict[str, float] = {}
        if isinstance(model, FiniteDifference):
            theta = model.theta
        else:
            rollout = cast(Rollout, cast(REINFORCE, model).rollout)
            try:
                theta = to_vector(scored_parameters(rollout))
            except ValueError:
                # The actor is frozen
                return
            figures = {} if n_left else self.measure(rollout)
        if self.thetas and self.thetas[-1].shape != theta.shape:
            self.thetas = []
        self.thetas = [*self.thetas[-2:], theta]
        if n_left == 0:
            for key, figure in (figures | self.cosine()).items():
                self.logger.record(f"gradient/{key}", figure)

    def cosine(self) -> dict[str, float]:
        """The cosine between the last two updates, if there have been two."""
        if len(self.thetas) < 3:
            return {}
        before = self.thetas[1] - self.thetas[0]
        after = self.thetas[2] - self.thetas[1]
        return {"cosine": float(th.cosine_similarity(before, after, dim=0))}

    def measure(self, rollout: Rollout) -> dict[str, float]:
        """The figures of one rollout, before training on it."""
        n_episodes = len(th.unique(rollout.episodes[rollout.used]))
        if n_episodes < 2:
            return {}
        weights = {"": training_weights(cast(REINFORCE, self.model))}
        rollout = evenly_spread(rollout, self.max_episodes)
        for name, function in self.functions.items():
            baseline = th.as_tensor(check_baseline(function(rollout), rollout))
            weights[name] = rollout.discounts * (rollout.returns - baseline)
        m = min(n_episodes, self.max_episodes)
        grams = th.zeros(len(weights), m, m, dtype=th.float64)
        for block in gradient_blocks(rollout, *weights.values()):
            grams += th.stack([gram(gradients) for gradients in block])
        own, *others = (compute_moments(matrix, th.ones(1, m, dtype=th.float64)) for matrix in grams)
        figures = {"snr": n_episodes * float(signal_to_noise(own)), "noise_scale": float(noise_scale(own))}
        for name, moments in zip(self.functions, others, strict=True):
            figures[f"variance/{name}"] = float(variance(moments))
        return figures


def evenly_spread(rollout: Rollout, n_episodes: int) -> Rollout:
    """A rollout of which only ``n_episodes`` episodes are used, spread evenly over the environments."""
    numbers = th.unique(rollout.episodes[rollout.used])
    if len(numbers) <= n_episodes:
        return rollout
    kept = numbers[th.linspace(0, len(numbers) - 1, n_episodes).round().long()]
    return replace(rollout, used=rollout.used & th.isin(rollout.episodes, kept))
