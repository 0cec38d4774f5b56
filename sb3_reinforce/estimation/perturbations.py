"""
Directions in which the parameters are perturbed, one function each.

The random ones have unit standard deviation in every component, ``E[δ δᵀ] = I``, so that ``delta_std`` is the standard
deviation of what is added to a parameter, as in ARS, whichever of them is used.
"""

import math
from collections.abc import Callable
from typing import TypeAlias

import torch as th

from sb3_reinforce.estimation.estimators import check_tensor

# (k, n, generator) -> deltas of shape (k, n), float64
Perturbation: TypeAlias = Callable[[int, int, th.Generator], th.Tensor]

# Beyond this, more updates with rougher gradients cost less
MAX_DEFAULT_N_DELTA = 64
# The utility of a policy near zero does not tell smaller perturbations from none
MIN_DEFAULT_DELTA_STD = 0.05


def gaussian(k: int, n: int, generator: th.Generator) -> th.Tensor:
    """
    ``δ ~ N(0, I)``, the perturbation of ARS and of evolution strategies.

    :param k: Number of perturbations
    :param n: Number of parameters
    :param generator: Source of randomness
    :return: Shape ``(k, n)``
    """
    return th.randn(k, n, dtype=th.float64, generator=generator)


def rademacher(k: int, n: int, generator: th.Generator) -> th.Tensor:
    """
    ``δ_i = ± 1`` with equal probability, the perturbation of SPSA (Spall, 1992).

    :param k: Number of perturbations
    :param n: Number of parameters
    :param generator: Source of randomness
    :return: Shape ``(k, n)``, every row of norm √n
    """
    return 2 * th.randint(2, (k, n), generator=generator).double() - 1


def sphere(k: int, n: int, generator: th.Generator) -> th.Tensor:
    """
    Uniform on the sphere of radius √n: ``δ = √n z / ‖z‖`` with ``z ~ N(0, I)``.

    :param k: Number of perturbations
    :param n: Number of parameters
    :param generator: Source of randomness
    :return: Shape ``(k, n)``, every row of norm √n
    """
    deltas = gaussian(k, n, generator)
    norms: th.Tensor = th.linalg.vector_norm(deltas, dim=1, keepdim=True)
    return math.sqrt(n) * deltas / norms


def coordinate(k: int, n: int, generator: th.Generator) -> th.Tensor:
    """
    One parameter at a time: ``δ = ± e_j``.

    Each pass over the parameters is in a new random order. The signs of the first pass are random, and each further
    pass has the opposite ones, so that ``2 n`` rows are the central differences of all parameters. With equal signs the
    intercept of the regression would take the mean of the measured components.

    :param k: Number of perturbations
    :param n: Number of parameters
    :param generator: Source of randomness
    :return: Shape ``(k, n)``, every row a unit vector
    """
    signs = rademacher(1, n, generator)
    deltas = []
    for first in range(0, k, n):
        rows = th.nn.functional.one_hot(th.randperm(n, generator=generator)[: k - first], n)
        deltas.append(signs * rows)
        signs = -signs
    return th.cat(deltas)


PERTURBATIONS: dict[str, Perturbation] = {
    "coordinate": coordinate,
    "gaussian": gaussian,
    "rademacher": rademacher,
    "sphere": sphere,
}


def new_generator() -> th.Generator:
    """A separate generator, seeded by PyTorch's global one."""
    return th.Generator().manual_seed(int(th.randint(2**31, ())))


def sample_deltas(perturbation: Perturbation, k: int, n: int, delta_std: float, generator: th.Generator) -> th.Tensor:
    """``Δ = delta_std · δ``, shape ``(k, n)``; the directions δ, which a user's function may draw, are checked."""
    deltas = check_tensor("perturbation", perturbation(k, n, generator), (k, n))
    # With few signs in all, the rows are often equal, and the regression has no direction. Drawing again keeps the mean
    # and covariance of each δ, but the rows of one draw are then no longer independent
    while k > 1 and perturbation in PERTURBATIONS.values() and (deltas == deltas[0]).all():
        deltas = perturbation(k, n, generator)
    return delta_std * deltas


def default_n_delta(n_parameters: int, estimator: object, perturbation: object) -> int:
    """
    ``min(2n, 64)`` perturbations up to n = 42 and ``min(n / 2, 64)`` beyond; differences along coordinates have
    ``min(n, 64)``.

    As many random directions as parameters are nearly dependent. Noise of variance 1 in the differences gives Gaussian
    directions a ‖ĝ‖² of ``min(k, n) / (|n − k| − 1)`` on average, the mean of an inverse Wishart matrix.
    """
    if perturbation in ("coordinate", coordinate) and estimator != "regression":
        return min(n_parameters, MAX_DEFAULT_N_DELTA)
    if 1.5 * n_parameters <= MAX_DEFAULT_N_DELTA:
        return min(2 * n_parameters, MAX_DEFAULT_N_DELTA)
    return min(n_parameters // 2, MAX_DEFAULT_N_DELTA)


def default_delta_std(theta: th.Tensor) -> float:
    """``max(‖θ‖ / 100, 0.05)``."""
    return max(0.01 * float(theta.norm()), MIN_DEFAULT_DELTA_STD)
