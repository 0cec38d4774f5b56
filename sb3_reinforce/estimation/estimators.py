"""
Gradients of a utility from its values alone.

An estimator is one function ``(U, θ, Δ) -> ĝ``: the utility, the center of shape ``(n,)`` and the perturbations of
shape ``(k, n)``. Those named here are one least-squares problem, ``design · ĝ ≈ differences``, with different designs.
Everything is float64, since differences of nearly equal numbers are taken.

A utility maps candidates of shape ``(k, n)`` to ``(k,)``; it compares all of them with each other, so with common
random numbers they all meet the same episodes. Candidates of shape ``(m, k, n)`` are compared within columns only, so
that each of the k columns can have separate episodes; the result is of shape ``(m, k)``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch as th

from sb3_reinforce.common.arguments import check_integer
from sb3_reinforce.common.tensors import ROUNDING

Utility: TypeAlias = Callable[[th.Tensor], th.Tensor]
Estimator: TypeAlias = Callable[[Utility, th.Tensor, th.Tensor], th.Tensor]


def forward_difference(utility: Utility, theta: th.Tensor, deltas: th.Tensor) -> th.Tensor:
    """
    ``Δ ĝ ≈ U(θ + Δ) − U(θ)``: k + 1 evaluations, error of order 1 in ‖Δ‖; exact on linear utilities if
    the perturbations span all dimensions (Peters and Schaal, 2008, section 3.1).

    :param utility: U
    :param theta: θ, shape ``(n,)``
    :param deltas: Δ, shape ``(k, n)``
    :return: ĝ, shape ``(n,)``
    :raises TypeError: If Δ is not a tensor, or θ not a tensor of floats
    :raises ValueError: If Δ does not fit θ, all perturbations are zero, or the utility does not return a finite number
        for each candidate
    """
    deltas = check_deltas(theta, deltas)
    check_design(deltas, deltas)
    utilities = evaluate_utility(utility, th.cat([theta[None], theta + deltas]))
    return solve(deltas, utilities[1:] - utilities[0])


def central_difference(utility: Utility, theta: th.Tensor, deltas: th.Tensor, n_top: int | None = None) -> th.Tensor:
    """
    ``2Δ ĝ ≈ U(θ + Δ) − U(θ − Δ)``: 2k evaluations, error of order 2 in ‖Δ‖; exact on quadratic utilities
    if the perturbations span all dimensions (Peters and Schaal, 2008, section 3.1).

    :param utility: U, which gets all candidates at once, shape ``(2, k, n)``, and returns ``(2, k)``
    :param theta: θ, shape ``(n,)``
    :param deltas: Δ, shape ``(k, n)``
    :param n_top: Use only the perturbations with the n_top largest max(U(θ + δ), U(θ − δ)) (Mania et al., 2018,
        section 3.3), which biases ĝ towards them; None for all
    :return: ĝ, shape ``(n,)``
    :raises TypeError: If Δ is not a tensor, θ not a tensor of floats, or ``n_top`` not an integer
    :raises ValueError: If Δ does not fit θ, all perturbations are zero, ``n_top`` is not from 1 to k, or the utility
        does not return a finite number for each candidate
    """
    deltas = check_deltas(theta, deltas)
    check_design(deltas, deltas)
    if n_top is not None:
        check_integer("n_top", n_top, 1, len(deltas))
    utilities = evaluate_utility(utility, th.stack([theta + deltas, theta - deltas]))
    top = utilities.amax(0).argsort(descending=True, stable=True)[:n_top]
    plus, minus = utilities[:, top]
    return solve(2 * deltas[top], plus - minus)


def regression_gradient(utility: Utility, theta: th.Tensor, deltas: th.Tensor) -> th.Tensor:
    """
    ``[1 Δ] [u₀ ĝ]ᵀ ≈ U(θ + Δ)``: k evaluations, error of order 1 in ‖Δ‖; exact on linear utilities if Δ − Δ̄
    spans all dimensions.

    The intercept u₀ is fitted by centering: ``(Δ − Δ̄) ĝ ≈ U − Ū`` has the same ĝ (Frisch and Waugh, 1933). Where there
    are fewer perturbations than unknowns, this is the ĝ of least norm, and the level u₀ is not pulled towards zero.

    :param utility: U
    :param theta: θ, shape ``(n,)``
    :param deltas: Δ, shape ``(k, n)``
    :return: ĝ, shape ``(n,)``
    :raises TypeError: If Δ is not a tensor, or θ not a tensor of floats
    :raises ValueError: If Δ does not fit θ, all perturbations are equal, or the utility does not return a finite number
        for each candidate
    """
    deltas = check_deltas(theta, deltas)
    design = deltas - deltas.mean(0)
    check_design(design, deltas)
    utilities = evaluate_utility(utility, theta + deltas)
    return solve(design, utilities - utilities.mean())


ESTIMATORS: dict[str, Estimator] = {
    "regression": regression_gradient,
    "central": central_difference,
    "forward": forward_difference,
}


def evaluate_utility(utility: Utility, candidates: th.Tensor) -> th.Tensor:
    """The utilities of candidates, one for each row."""
    return check_tensor("utility", utility(candidates), candidates.shape[:-1]).to(candidates)


def check_deltas(theta: th.Tensor, deltas: Any) -> th.Tensor:
    """Return finite perturbations, rows like θ, in its precision."""
    if not isinstance(theta, th.Tensor) or not theta.is_floating_point():
        raise TypeError(f"theta must be a tensor of floats, got {theta!r}")
    if not isinstance(deltas, th.Tensor):
        raise TypeError(f"deltas must be a tensor, got {deltas!r} of type {type(deltas).__name__}")
    if len(deltas.shape) != 2 or len(deltas) == 0 or deltas.shape[1:] != theta.shape or not deltas.isfinite().all():
        raise ValueError(
            f"deltas must be finite numbers of shape (k, n), with k > 0 and (n,) = {tuple(theta.shape)} the shape of "
            f"theta, got shape {tuple(deltas.shape)}: {deltas}"
        )
    return deltas.to(theta)


def check_design(design: th.Tensor, deltas: th.Tensor) -> None:
    """Raise an error before an environment is stepped if a design of shape ``(k, n)`` is zero but for rounding."""
    if design.abs().max() <= ROUNDING * deltas.abs().max():
        raise ValueError(
            f"The {len(deltas)} perturbations have no usable direction: forward and central differences need one that "
            "is not zero, the regression needs two that are not equal. Raise n_delta, or change the perturbation"
        )


def solve(design: th.Tensor, differences: th.Tensor) -> th.Tensor:
    """``ĝ = argmin ‖design · ĝ − differences‖²`` of least norm, for a design ``(k, n)`` and differences ``(k,)``."""
    # By the singular value decomposition: the normal equations would square the condition of the design
    gradient: th.Tensor = th.linalg.lstsq(design, differences[:, None], driver="gelsd").solution[:, 0]
    return gradient


@dataclass(frozen=True)
class GradientEstimate:
    """
    A gradient of the utility, and the evaluations that it was estimated from.

    :param gradient: ĝ ≈ ∇U(θ), shape ``(n,)``, float64
    :param candidates: All parameter vectors that were evaluated, shape ``(m, n)``, float64
    :param utilities: Their mean returns, shape ``(m,)``, float64
    :param delta_std: The scale of the perturbations
    :param parameters: The parameters of the policy that θ consists of, with n elements in all
    :param columns: The column of each candidate, shape ``(m,)``: candidates of one column had the same seeds. None
        without common random numbers
    """

    gradient: th.Tensor
    candidates: th.Tensor
    utilities: th.Tensor
    delta_std: float
    parameters: list[th.nn.Parameter]
    columns: th.Tensor | None = None


@dataclass(frozen=True)
class Fit:
    """
    How well a gradient explains the utilities that it was estimated from.

    :param r_squared: Share of their variance within columns that ``u₀ + δ · ĝ`` explains; NaN where there is none
    :param residual_std: Standard deviation of what is left, in units of the utility; NaN without degrees of freedom
    :param standard_error: Standard error of each component of ĝ as a least-squares fit, shape ``(n,)``; None unless the
        evaluations determine every component and leave a degree of freedom. It is too small for forward
        differences, which share the noise of U(θ), and meaningless with ``n_top``, where ĝ is another fit
    """

    r_squared: float
    residual_std: float
    standard_error: th.Tensor | None


def fit_quality(
    candidates: th.Tensor, utilities: th.Tensor, gradient: th.Tensor, columns: th.Tensor | None = None
) -> Fit:
    """
    ``R² = 1 − Σ r² / Σ (U − Ū)²``, ``s² = Σ r² / (m − c − rank)`` and ``s √diag((XᵀX)⁻¹)``, with X the centered θ + δ.

    Each of the c columns has its mean and its intercept u₀: candidates that met other episodes are not compared.

    :param candidates: Every θ + δ that was evaluated, shape ``(m, n)``, float64
    :param utilities: Their utilities, shape ``(m,)``, float64
    :param gradient: ĝ, shape ``(n,)``
    :param columns: The column of each candidate, counted from 0, shape ``(m,)``; None for one column
    :return: R², s and the standard errors
    """
    if columns is None:
        columns = th.zeros(len(utilities), dtype=th.long)
    x = centered(candidates, columns)
    y = centered(utilities[:, None], columns)[:, 0]
    residuals = y - x @ gradient
    # Both products have the rank of x; the smaller one is cheaper
    product = x @ x.T if len(x) < len(gradient) else x.T @ x
    rank = int(th.linalg.matrix_rank(product, hermitian=True))
    n_columns = len(th.unique(columns))
    degrees_of_freedom = len(y) - n_columns - rank
    squares = float(residuals @ residuals)
    total = float(y @ y)
    residual_std = (squares / degrees_of_freedom) ** 0.5 if degrees_of_freedom > 0 else float("nan")
    is_determined = degrees_of_freedom > 0 and rank == len(gradient)
    # (XᵀX)⁻¹ = X⁺ (X⁺)ᵀ at full rank: the roots of its diagonal are the norms of the rows of X⁺
    return Fit(
        r_squared=1 - squares / total if total > 0 else float("nan"),
        residual_std=residual_std,
        standard_error=residual_std * th.linalg.pinv(x).norm(dim=1) if is_determined else None,
    )


def centered(x: th.Tensor, columns: th.Tensor) -> th.Tensor:
    """Rows ``(m, n)`` less the mean of their column."""
    counts = columns.bincount()
    sums = x.new_zeros(len(counts), x.shape[1]).index_add_(0, columns, x)
    return x - (sums / counts[:, None])[columns]


def check_candidates(must: str, candidates: Any, n_parameters: int) -> th.Tensor:
    """Return candidates of a utility, ``(k, n)`` or ``(m, k, n)``, in float64; ``must`` begins the error's sentence."""
    shape = tuple(candidates.shape) if isinstance(candidates, th.Tensor) else ()
    is_shaped = len(shape) in (2, 3) and 0 not in shape and shape[-1] == n_parameters
    if not is_shaped or not candidates.isfinite().all():
        got = f"shape {shape}: {candidates}" if isinstance(candidates, th.Tensor) else f"{candidates!r}"
        raise ValueError(f"{must} a finite tensor of shape (k, {n_parameters}) or (m, k, {n_parameters}), got {got}")
    result: th.Tensor = candidates.detach().cpu().double()
    return result


def check_tensor(name: str, value: Any, shape: tuple[int, ...]) -> th.Tensor:
    """Return a finite tensor of one shape in float64 on the CPU."""
    if not isinstance(value, th.Tensor) or value.shape != shape:
        got = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, th.Tensor) else repr(value)
        raise ValueError(f"{name} must return a tensor of shape {tuple(shape)}, got {got}")
    if not value.isfinite().all():
        raise ValueError(f"{name} must return finite numbers, got {value}")
    return value.detach().cpu().double()
