"""
How good an estimate of the gradient is: statistics of m sampled gradients, each with an interval.

A sample is the gradient of one episode, or of one batch; the estimate is the mean of the samples. All of them
are functions of ``E‖g‖²`` and ``‖E g‖²``, of which the Gram matrix ``K_ij = ⟨g_i, g_j⟩`` has unbiased estimates. So a
bootstrap costs m² a resample, whatever the number of parameters.

The samples are taken to be independent. Those of a baseline that looks at the other episodes of the batch are so up to
terms of order 1/m.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import torch as th

from sb3_reinforce.arguments import check_integer, check_number
from sb3_reinforce.diagnostics.bootstrap import Estimate, interval, resamples


@dataclass(frozen=True)
class Moments:
    """
    Of a gradient g, or of its resamples.

    :param second: ``E‖g‖²``
    :param signal: ``‖E g‖²``; an unbiased estimate of it can be negative
    """

    second: th.Tensor
    signal: th.Tensor


Statistic: TypeAlias = Callable[[Moments], th.Tensor]


@dataclass(frozen=True)
class GradientStatistics:
    """
    What ``gradient_statistics`` returns.

    :param mean: The estimate of the gradient, ``(1/m) Σ_i g_i``, shape ``(n,)``
    :param variance: ``tr Σ``, the trace of the covariance of one sample; the mean of N samples has ``tr Σ / N``
    :param snr: ``‖E g‖² / tr Σ``, the signal-to-noise ratio of one sample; the mean of N samples has N times that
    :param noise_scale: ``tr Σ / ‖E g‖²``, the number of samples whose mean is as much signal as noise
    :param cosine: Cosine of the true gradient to the reference gradient; None without one
    """

    mean: th.Tensor
    variance: Estimate
    snr: Estimate
    noise_scale: Estimate
    cosine: Estimate | None


def gram(gradients: th.Tensor) -> th.Tensor:
    """
    ``K = g gᵀ``.

    :param gradients: Shape ``(m, n)``
    :return: Shape ``(m, m)``, float64, on the CPU
    """
    gradients = gradients.double()
    product: th.Tensor = (gradients @ gradients.T).cpu()
    return product


def moments(gram: th.Tensor, counts: th.Tensor) -> Moments:
    """
    ``E‖g‖² ≈ Σ_{i≠j} c_i c_j K_ii / Σ_{i≠j} c_i c_j`` and ``‖E g‖² ≈ Σ_{i≠j} c_i c_j K_ij / Σ_{i≠j} c_i c_j``.

    Both are unbiased for counts of 1. They leave out the pairs of a sample with itself, and of a resample with its own
    copies, which would count noise as signal (a U-statistic: Hoeffding, 1948). Over the same pairs, their difference is
    half the mean of ``‖g_i − g_j‖²`` in every resample, and so never negative.

    :param gram: ``K_ij = ⟨g_i, g_j⟩``, shape ``(m, m)``
    :param counts: How often each sample is in each resample, shape ``(r, m)``
    :return: Moments of shape ``(r,)``
    """
    diagonal, total = gram.diagonal(), counts.sum(1)
    n_pairs = total.square() - counts.square().sum(1)
    second = (counts * (total[:, None] - counts)) @ diagonal
    signal = ((counts @ gram) * counts).sum(1) - counts.square() @ diagonal
    return Moments(second / n_pairs, signal / n_pairs)


def variance(of: Moments) -> th.Tensor:
    """
    ``tr Σ = E‖g‖² − ‖E g‖²``. Unbiased: it is the trace of the sample covariance with denominator m − 1.

    :param of: Moments
    """
    # Of samples that are all alike, rounding can leave a difference below 0
    return (of.second - of.signal).clamp(min=0)


def signal_to_noise(of: Moments) -> th.Tensor:
    """
    ``SNR = ‖E g‖² / tr Σ`` (Roberts and Tedrake, 2009, "Signal-to-noise ratio analysis of policy gradient
    algorithms", there with the part of the noise that is orthogonal to E g).

    Consistent; a ratio of two unbiased numbers is not unbiased itself. Negative where there is more noise than signal
    to be seen.

    :param of: Moments
    """
    return of.signal / variance(of)


def noise_scale(of: Moments) -> th.Tensor:
    """
    ``B = tr Σ / ‖E g‖²`` (McCandlish et al., 2018, equation 2.9), infinite where no signal is seen.

    From the unbiased estimates of numerator and denominator, as in their appendix A.1.

    :param of: Moments
    """
    return th.where(of.signal > 0, variance(of) / of.signal, th.inf)


def check_gradients(gradients: th.Tensor) -> th.Tensor:
    """
    Check sampled gradients.

    :param gradients: Meant to be of shape ``(m, n)`` with m ≥ 2, and finite
    :return: The gradients, float64, on the CPU
    :raises TypeError: If they are not a tensor
    :raises ValueError: If they are not as meant
    """
    if not isinstance(gradients, th.Tensor):
        raise TypeError(f"gradients must be a tensor, got {gradients!r} of type {type(gradients).__name__}")
    if gradients.dim() != 2 or len(gradients) < 2 or gradients.shape[1] < 1:
        raise ValueError(
            f"gradients must be of shape (m, n) with m >= 2, since a variance needs two samples, got "
            f"{tuple(gradients.shape)}"
        )
    if not gradients.isfinite().all():
        raise ValueError(
            f"gradients must be finite, and sample {int((~gradients.isfinite()).any(1).nonzero()[0])} is not"
        )
    return gradients.detach().cpu().double()


def cosine(of: Moments, reference: Moments, products: th.Tensor, confidence: float) -> Estimate:
    """
    ``cos = ⟨E g, E r⟩ / (‖E g‖ ‖E r‖)``, NaN where no signal is seen.

    Consistent for the true gradients: with the norm of the mean of the samples in the denominator, their noise would
    make it too small, by about ``√(1 + B / m)`` at the noise scale B. Where ``‖E g‖²`` or ``‖E r‖²`` may as well be 0,
    by its own interval, nothing is known of the direction, and the interval is [−1, 1].

    :param of: Moments of g, of the sample and of its resamples, shape ``(1 + r,)``
    :param reference: Moments of r, of the same shape
    :param products: ``⟨E g, E r⟩``, of the same shape
    :param confidence: Probability that the interval is to cover the truth
    """
    squares = of.signal.clamp(min=0) * reference.signal.clamp(min=0)
    found = interval((products / squares.sqrt()).clamp(-1, 1), confidence)
    value = found.value if squares[0] > 0 else float("nan")
    if min(interval(side.signal, confidence).low for side in (of, reference)) > 0:
        return Estimate(value, found.low, found.high)
    return Estimate(value, -1.0, 1.0)


def gradient_statistics(
    gradients: th.Tensor,
    reference: th.Tensor | None = None,
    n_resamples: int = 1000,
    confidence: float = 0.95,
    seed: int = 0,
) -> GradientStatistics:
    """
    Mean, variance, signal-to-noise ratio and noise scale of sampled gradients, with bootstrap intervals.

    The intervals are percentiles, and too narrow for few samples: that of the variance covers it in 86 % of the cases
    with 5 Gaussian samples and in 90 % with 10, instead of 95 %; from about 20 on it holds. Where there is next to no
    signal (SNR of the mean below about 1), those of SNR and noise scale are wider than they need be.

    :param gradients: m independent samples of the gradient, shape ``(m, n)``
    :param reference: A gradient to compare the mean with, shape ``(n,)``
    :param n_resamples: Bootstrap resamples
    :param confidence: Probability that an interval is to cover the truth
    :param seed: Seed of the resamples
    :raises TypeError: If the gradients are not a tensor
    :raises ValueError: If there are fewer than two, if they are not finite, or do not go with the reference
    """
    gradients = check_gradients(gradients)
    check_number("confidence", confidence, 0, 1)
    counts = resamples(len(gradients), check_integer("n_resamples", n_resamples, 1), check_integer("seed", seed, 0))
    found = moments(gram(gradients), counts)
    to_reference = None
    if reference is not None:
        if reference.shape != gradients.shape[1:] or not reference.norm() > 0:
            raise ValueError(
                f"reference must be a nonzero gradient of shape (n,) = {tuple(gradients.shape[1:])}, got shape "
                f"{tuple(reference.shape)} and norm {float(reference.norm())}"
            )
        known = reference.detach().cpu().double()
        square = (known @ known).expand(len(counts))
        products = counts @ (gradients @ known) / counts.sum(1)
        to_reference = cosine(found, Moments(square, square), products, confidence)
    return GradientStatistics(
        mean=gradients.mean(0),
        variance=interval(variance(found), confidence),
        snr=interval(signal_to_noise(found), confidence),
        noise_scale=interval(noise_scale(found), confidence),
        cosine=to_reference,
    )
