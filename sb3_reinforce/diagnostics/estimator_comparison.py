"""The families of gradient estimators at one θ: which of them sees the gradient of a task from the fewest steps."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch as th

from sb3_reinforce.common.arguments import check_choice, check_function, check_integer, check_number
from sb3_reinforce.diagnostics.bootstrap import Estimate, interval, resamples
from sb3_reinforce.diagnostics.landscapes import CandidateUtility
from sb3_reinforce.diagnostics.likelihood_ratio import likelihood_ratio
from sb3_reinforce.diagnostics.moments import cosine, gram, moments, signal_to_noise
from sb3_reinforce.diagnostics.sampling import check_independent, seeded
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.estimators import ESTIMATORS
from sb3_reinforce.estimation.perturbations import PERTURBATIONS, Perturbation, default_delta_std, default_n_delta
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.reinforce import REINFORCE

LIKELIHOOD_RATIO = "likelihood_ratio"


@dataclass(frozen=True)
class EstimatorRow:
    """
    One estimator of the gradient of ``U(θ) = E[Σ_t r_t]``.

    :param estimator: Its name
    :param cosine: Cosine of what it estimates to the likelihood-ratio gradient, whose noise is in the interval too
    :param snr_per_step: ``‖E ĝ‖² / tr Σ`` of one estimate, by the environment steps behind it
    :param steps: Environment steps behind one estimate, of all environments
    :param seconds: Time behind one estimate
    """

    estimator: str
    cosine: Estimate
    snr_per_step: Estimate
    steps: float
    seconds: float


def compare_estimators(
    model: REINFORCE | FiniteDifference,
    n_episodes: int = 100,
    n_estimates: int = 50,
    estimators: Iterable[str] = (LIKELIHOOD_RATIO, "forward", "central", "regression"),
    perturbation: str | Perturbation = "coordinate",
    n_delta: int | None = None,
    delta_std: float | None = 1.0,
    n_resamples: int = 500,
    confidence: float = 0.95,
    seed: int = 0,
) -> Table[EstimatorRow]:
    """
    Estimate the gradient at the model's θ by each family, with the same sampling policy and γ = 1.

    θ is the actor's parameters without ``log_std``. An estimate is, for the likelihood ratio, one episode with
    reward-to-go and the leave-one-out baseline; for the others, ``n_delta`` perturbations with one episode each behind
    a utility. The signal-to-noise ratio of a mean of estimates is proportional to their number, so its ratio to the
    steps does not depend on how large an estimate is. With fewer perturbations than parameters a difference sees only
    their span: its expectation is a multiple of the gradient, and the cosine is that of the expectation.

    :param model: The model; it is not changed, and its environments are left at the start of an episode
    :param n_episodes: Episodes of the likelihood ratio, and as many again for the gradient to compare with, at least 3
    :param n_estimates: Estimates by each of the others, at least 3; below about 20 the intervals are too narrow
    :param estimators: ``"likelihood_ratio"``, ``"forward"``, ``"central"``, ``"regression"``
    :param perturbation: As for FiniteDifference. As many Gaussian perturbations as parameters are all but dependent,
        and a difference that is solved for them is mostly noise; coordinates are not
    :param n_delta: As for FiniteDifference; None for the rule of thumb
    :param delta_std: As for FiniteDifference, whose rule of thumb None stands for. A single episode behind a utility is
        too noisy for steps as small as those of training, so that the default is larger
    :param n_resamples: Bootstrap resamples behind the intervals
    :param confidence: Probability that an interval is to cover the truth
    :param seed: Seed of perturbations, episodes (of the environments too) and resamples
    :raises TypeError: If the model is neither a REINFORCE nor a FiniteDifference
    :raises ValueError: If an argument is out of its range, a name is unknown, the model has no environment, or its
        episodes are not independent because they share the noise of gSDE
    """
    if not isinstance(model, REINFORCE | FiniteDifference):
        raise TypeError(f"model must be a REINFORCE or FiniteDifference, got {model!r} of type {type(model).__name__}")
    check_independent(model)
    names = (estimators,) if isinstance(estimators, str) else tuple(estimators)
    for name in names or ("",):
        check_choice("estimators", name, (LIKELIHOOD_RATIO, *ESTIMATORS))
    check_integer("n_episodes", n_episodes, 3)
    check_integer("n_estimates", n_estimates, 3)
    check_integer("n_resamples", n_resamples, 1)
    check_number("confidence", confidence, 0, 1)
    if n_delta is not None:
        check_integer("n_delta", n_delta, 2)
    utility = CandidateUtility(model, 1, seed)
    draw = check_function("perturbation", perturbation, PERTURBATIONS)
    scale = (
        default_delta_std(utility.theta) if delta_std is None else check_number("delta_std", delta_std, 0, above=True)
    )
    generator = th.Generator().manual_seed(seed)

    def difference(name: str) -> Callable[[], tuple[th.Tensor, int]]:
        k = default_n_delta(name, len(utility.theta)) if n_delta is None else n_delta

        def estimate() -> tuple[th.Tensor, int]:
            before = utility.n_steps
            deltas = scale * draw(k, len(utility.theta), generator)
            return ESTIMATORS[name](utility, utility.theta, deltas), utility.n_steps - before

        return estimate

    rows = []
    with seeded(model.policy, seed):
        reference = likelihood_ratio(model, n_episodes)[0]
        reference_counts = resamples(n_episodes, n_resamples, seed + 1)
        for name in names:
            begin = time.perf_counter()
            if name == LIKELIHOOD_RATIO:
                gradients, n_steps = likelihood_ratio(model, n_episodes)
            else:
                estimate = difference(name)
                found, made = zip(*(estimate() for _ in range(n_estimates)), strict=True)
                gradients, n_steps = th.stack(found), sum(made)
            seconds, counts = time.perf_counter() - begin, resamples(len(gradients), n_resamples, seed)
            steps = n_steps / len(gradients)
            rows.append(estimator_row(name, gradients, reference, steps, seconds, counts, reference_counts, confidence))
    return Table(f"Gradient of U(θ) for {len(utility.theta)} parameters by estimator", rows)


def estimator_row(
    name: str,
    gradients: th.Tensor,
    reference: th.Tensor,
    steps: float,
    seconds: float,
    counts: th.Tensor,
    reference_counts: th.Tensor,
    confidence: float,
) -> EstimatorRow:
    """
    A row of ``compare_estimators``.

    :param name: The estimator
    :param gradients: Its m estimates, shape ``(m, n)``, float64
    :param reference: Likelihood-ratio gradients of other episodes, shape ``(m', n)``, float64
    :param steps: Environment steps behind one estimate
    :param seconds: Time behind all estimates
    :param counts: Resamples of the estimates, shape ``(r, m)``
    :param reference_counts: Resamples of the reference, shape ``(r, m')``
    :param confidence: Probability that an interval is to cover the truth
    """
    found, of_reference = moments(gram(gradients), counts), moments(gram(reference), reference_counts)
    products = (counts @ (gradients @ reference.T) * reference_counts).sum(1) / (
        counts.sum(1) * reference_counts.sum(1)
    )
    to_reference = cosine(found, of_reference, products, confidence)
    ratio = interval(signal_to_noise(found) / steps, confidence)
    return EstimatorRow(name, to_reference, ratio, steps, seconds / len(gradients))
