"""
How good an estimate of the gradient is: statistics of m sampled gradients, each with an interval.

A sample is the gradient of one episode, or of one batch; the estimate is the mean of the samples. For the formulas see
``moments``.

The samples are taken to be independent. Those of a baseline that looks at the other episodes of the batch are so up to
terms of order 1/m.
"""

from dataclasses import dataclass

import torch as th

from sb3_reinforce.common.arguments import check_integer, check_number
from sb3_reinforce.diagnostics.bootstrap import Estimate, interval, resamples
from sb3_reinforce.diagnostics.moments import Moments, cosine, gram, moments, noise_scale, signal_to_noise, variance


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
    :raises TypeError: If the gradients or the reference are not a tensor
    :raises ValueError: If there are fewer than two, if they are not finite, or do not go with the reference
    """
    gradients = check_gradients(gradients)
    check_number("confidence", confidence, 0, 1)
    counts = resamples(len(gradients), check_integer("n_resamples", n_resamples, 1), check_integer("seed", seed, 0))
    found = moments(gram(gradients), counts)
    to_reference = None
    if reference is not None:
        if not isinstance(reference, th.Tensor):
            raise TypeError(f"reference must be a tensor, got {reference!r} of type {type(reference).__name__}")
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
