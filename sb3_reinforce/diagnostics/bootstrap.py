"""The bootstrap: what an estimate might have been, from resamples of the sample that it was made from."""

from dataclasses import dataclass

import torch as th


@dataclass(frozen=True)
class Estimate:
    """
    A number that was estimated.

    :param value: The estimate
    :param low: Lower end of its interval
    :param high: Upper end of its interval
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


UNKNOWN = Estimate(float("nan"), float("nan"), float("nan"))


def resamples(m: int, n_resamples: int, seed: int) -> th.Tensor:
    """
    How often each of m samples is drawn, in the sample itself (the first row) and in bootstrap resamples of it.

    A resample that holds one sample m times has no pairs and is drawn anew, as if by m samples of which two differ.

    :param m: Number of samples, at least 2
    :param n_resamples: Number of resamples
    :param seed: Of the draws: with the same seed, the resamples of two estimators are paired
    :return: Shape ``(1 + n_resamples, m)``, float64
    """
    drawn = th.randint(m, (n_resamples, m), generator=th.Generator().manual_seed(seed))
    drawn[:, 1] = th.where((drawn == drawn[:, :1]).all(1), (drawn[:, 0] + 1) % m, drawn[:, 1])
    counts = th.zeros(n_resamples, m, dtype=th.float64).scatter_add_(1, drawn, th.ones(drawn.shape, dtype=th.float64))
    return th.cat([th.ones(1, m, dtype=th.float64), counts])


def interval(values: th.Tensor, confidence: float) -> Estimate:
    """
    The percentile interval of the bootstrap (Efron and Tibshirani, 1993, chapter 13).

    :param values: The statistic of the sample, then of its resamples, shape ``(1 + r,)``
    :param confidence: Probability that the interval is to cover the truth
    """
    tail = (1 - confidence) / 2
    # An end is a value that occurred: infinite noise scales cannot be interpolated
    low = values[1:].quantile(tail, interpolation="lower")
    high = values[1:].quantile(1 - tail, interpolation="higher")
    return Estimate(float(values[0]), float(low), float(high))
