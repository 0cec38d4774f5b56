"""
``E‖g‖²`` and ``‖E g‖²`` of sampled gradients, and the statistics that are functions of these two.

The Gram matrix ``K_ij = ⟨g_i, g_j⟩`` has unbiased estimates of both. So a bootstrap costs m² a resample, whatever the
number of parameters.
"""

from dataclasses import dataclass

import torch as th

from sb3_reinforce.diagnostics.bootstrap import Estimate, interval


@dataclass(frozen=True)
class Moments:
    """
    Of a gradient g, or of its resamples.

    :param second: ``E‖g‖²``
    :param signal: ``‖E g‖²``; an unbiased estimate of it can be negative
    """

    second: th.Tensor
    signal: th.Tensor


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
