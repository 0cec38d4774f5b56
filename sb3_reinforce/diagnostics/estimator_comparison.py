"""The families of gradient estimators at one θ: which one detects the gradient of a task in the fewest steps."""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch as th

from sb3_reinforce.common.arguments import (
    check_choice,
    check_function,
    check_integer,
    check_kind,
    check_number,
    check_unless_none,
)
from sb3_reinforce.diagnostics.landscapes import CandidateUtility
from sb3_reinforce.diagnostics.sampling import check_model, collect_episodes, env_of, episode_bar, seeded
from sb3_reinforce.diagnostics.statistics import compute_moments, cosine, gram, signal_to_noise
from sb3_reinforce.diagnostics.tables import Estimate, Table, interval, resample_counts
from sb3_reinforce.envs.starts import reseed
from sb3_reinforce.estimation import baselines
from sb3_reinforce.estimation.estimators import ESTIMATORS
from sb3_reinforce.estimation.perturbations import (
    PERTURBATIONS,
    Perturbation,
    default_delta_std,
    default_n_delta,
    sample_deltas,
)
from sb3_reinforce.estimation.scores import gradients_by_episode, parameters_of
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.policies.parameters import searched_parameters
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.sampling.measurement import sampling_copy, undisturbed
from sb3_reinforce.sampling.normalization import unscaled

LIKELIHOOD_RATIO = "likelihood_ratio"


@dataclass(frozen=True)
class EstimatorRow:
    """
    One estimator of the gradient of ``U(θ) = E[Σ_t r_t]``.

    :param estimator: Its name
    :param cosine: Cosine of its expectation to the likelihood-ratio gradient; the interval includes the noise of both
    :param snr_per_step: ``‖E ĝ‖² / tr Σ`` of one estimate, divided by its environment steps
    :param steps: Environment steps of one estimate, of all environments together, including those that wait for the
        longest episode of a round: fewer environments take fewer steps
    :param seconds: Seconds for one estimate
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
    progress_bar: bool = False,
) -> Table[EstimatorRow]:
    """
    Estimate the gradient at the model's θ with each family, with the same sampling policy and γ = 1.

    θ is the actor's parameters without ``log_std``. One estimate is one episode with reward-to-go and the leave-one-out
    baseline for the likelihood ratio, and ``n_delta`` perturbations with one episode per utility for the others. The
    signal-to-noise ratio of a mean of estimates is proportional to their number, so the ratio per step does not depend
    on the size of an estimate. With fewer perturbations than parameters an estimate lies in the span of the
    perturbations. The cosine belongs to its expectation, which for small perturbations of a built-in kind is a multiple
    of the gradient.

    :param model: The model; it is not changed. Its environments get new seeds, and are left at the start of an episode
    :param n_episodes: Episodes of the likelihood ratio, and as many again for the reference gradient, at least 3
    :param n_estimates: Estimates with each of the others, at least 3; below about 20 the intervals are too narrow
    :param estimators: ``"likelihood_ratio"``, ``"forward"``, ``"central"``, ``"regression"``
    :param perturbation: As for FiniteDifference. A difference solved for as many Gaussian perturbations as parameters
        is mostly noise, because these are nearly linearly dependent; coordinates are not
    :param n_delta: As for FiniteDifference, but at least 2; None for the rule of thumb
    :param delta_std: A number as for FiniteDifference; None for its rule of thumb. A utility from a single episode is
        too noisy for steps as small as in training, so the default is larger
    :param n_resamples: Number of bootstrap resamples
    :param confidence: Probability with which an interval should cover the true value
    :param seed: Seed of perturbations, episodes (also of the environments) and resamples
    :param progress_bar: Display a bar of tqdm that counts the episodes of the differences
    :return: A table with one ``EstimatorRow`` per estimator
    :raises TypeError: If the model is neither a REINFORCE nor a FiniteDifference
    :raises ValueError: If an argument is out of its range, a name is unknown, the model has no environment or is
        collecting a rollout, the policy has a memory or no gradient of log π, the environments cannot be seeded one by
        one, or the episodes are not independent because they share the noise of gSDE
    """
    check_model(model, (REINFORCE, FiniteDifference), independent=True)
    check_kind("estimators", estimators, (Iterable,), "names")
    names = (estimators,) if isinstance(estimators, str) else tuple(estimators)
    for name in names:
        check_choice("estimators", name, (LIKELIHOOD_RATIO, *ESTIMATORS))
    if not names or len(set(names)) < len(names):
        raise ValueError(f"estimators must have at least one name, and each of them once, got {names}")
    check_integer("n_episodes", n_episodes, 3)
    check_integer("n_estimates", n_estimates, 3)
    check_integer("n_resamples", n_resamples, 1)
    seed = check_integer("seed", seed, 0)
    check_number("confidence", confidence, 0, 1)
    check_unless_none("n_delta", n_delta, partial(check_integer, low=2))
    check_unless_none("delta_std", delta_std, partial(check_number, low=0, above=True))
    draw = check_function("perturbation", perturbation, PERTURBATIONS)
    utility = CandidateUtility(model, 1, seed)
    n_parameters = len(utility.theta)
    scale = default_delta_std(utility.theta) if delta_std is None else delta_std
    generator = th.Generator().manual_seed(seed)
    rows = []
    with seeded(model.policy, seed), episode_bar(progress_bar) as bar:
        utility.bar = bar
        reference = likelihood_ratio(model, n_episodes)[0]
        for name in names:
            begin = time.perf_counter()
            n_steps_before = utility.n_steps
            if name == LIKELIHOOD_RATIO:
                gradients, n_steps = likelihood_ratio(model, n_episodes)
            else:
                k = default_n_delta(n_parameters, name, draw) if n_delta is None else n_delta
                deltas = (sample_deltas(draw, k, n_parameters, scale, generator) for _ in range(n_estimates))
                gradients = th.stack([ESTIMATORS[name](utility, utility.theta, each) for each in deltas])
                n_steps = utility.n_steps - n_steps_before
            seconds = (time.perf_counter() - begin) / len(gradients)
            steps = n_steps / len(gradients)
            to_reference, snr = compare_to_reference(gradients, reference, n_resamples, confidence, seed)
            snr_per_step = Estimate(snr.value / steps, snr.low / steps, snr.high / steps)
            rows.append(EstimatorRow(name, to_reference, snr_per_step, steps, seconds))
    legend = {
        "cosine": "of the expected estimate to the likelihood-ratio gradient of other episodes",
        "snr_per_step": "signal-to-noise ratio of an estimate / its steps; negative: not distinguishable from 0",
        "steps": "environment steps of one estimate",
        "seconds": "time for one estimate",
        "[a, b]": f"{confidence:.0%} bootstrap interval; -: not known",
    }
    return Table(f"Gradient of U(θ) for {n_parameters} parameters by estimator", rows, legend)


def compare_to_reference(
    gradients: th.Tensor, reference: th.Tensor, n_resamples: int, confidence: float, seed: int
) -> tuple[Estimate, Estimate]:
    """Cosine of estimates ``(m, n)`` to other gradients ``(m', n)``, and the signal-to-noise ratio of one estimate."""
    counts = resample_counts(len(gradients), n_resamples, seed)
    # Another seed; the largest has none after it
    others = resample_counts(len(reference), n_resamples, seed ^ 1)
    moments = compute_moments(gram(gradients), counts)
    # ⟨E g, E r⟩ of each pair of resamples
    products = (counts @ gram(gradients, reference) * others).sum(1) / (counts.sum(1) * others.sum(1))
    to_reference = cosine(moments, compute_moments(gram(reference), others), products, confidence)
    return to_reference, interval(signal_to_noise(moments), confidence)


def likelihood_ratio(model: REINFORCE | FiniteDifference, n_episodes: int) -> tuple[th.Tensor, int]:
    """
    Gradients of whole episodes at γ = 1 with the leave-one-out baseline, for the actor without ``log_std``, shape
    ``(n_episodes, n)``, float64; and the environment steps of all environments.
    """
    collector = sampling_copy(as_reinforce(model), n_episodes, "none")
    collector.gamma = 1.0
    collector.reward_to_go = True
    collector.discount_scores = False
    collector.max_episode_steps = model.max_episode_steps
    # As the rewards of the utility
    with undisturbed(model), unscaled(model.env):
        reseed(env_of(model), int(th.randint(2**31, ())))
        rollout = collect_episodes(collector)
        # Training would go on from the same starts after each comparison
        reseed(env_of(model), np.random.randint(2**31))
    weights = rollout.returns - baselines.leave_one_out(rollout)
    gradients = gradients_by_episode(rollout, weights)[0].double().cpu()
    wanted = {*searched_parameters(rollout.policy)}
    differentiated = parameters_of(rollout)
    if not wanted <= {*differentiated}:
        raise ValueError(
            "compare_estimators needs the gradient of log π for all parameters of the actor, and log π of "
            f"{type(rollout.policy).__name__} has none for some of them"
        )
    mask = th.cat([th.full((parameter.numel(),), parameter in wanted) for parameter in differentiated])
    return gradients[:, mask], rollout.dones.numel()


def as_reinforce(model: REINFORCE | FiniteDifference) -> REINFORCE:
    """A REINFORCE with a model's policy and environments."""
    if isinstance(model, REINFORCE):
        return model
    reinforce = REINFORCE(type(model.policy), env_of(model), policy_kwargs=model.policy_kwargs, device=model.device)
    reinforce.policy = model.policy
    return reinforce
