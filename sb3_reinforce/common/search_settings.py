"""What the arguments of FiniteDifference must satisfy, alone and together, and what those left open become."""

from typing import Any

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.common.arguments import as_integers, check_flag, check_function, check_number
from sb3_reinforce.common.common_settings import check_basics_of
from sb3_reinforce.estimation.estimators import ESTIMATORS
from sb3_reinforce.estimation.perturbations import PERTURBATIONS

# Beyond this many perturbations the rule of thumb costs more than a rough gradient and more updates do
MAX_DEFAULT_N_DELTA = 64
# The least default delta_std: the utility of a policy near zero does not tell smaller perturbations from none
MIN_DEFAULT_DELTA_STD = 0.05


def check_finite_difference(model: Any) -> None:
    """
    Check a model's arguments. Called at construction and again by ``load``, which may bring other arguments.

    :param model: A ``FiniteDifference`` with its arguments as attributes
    :raises TypeError: If an argument is of the wrong kind
    :raises ValueError: If an argument is out of its range, or does not go with another
    """
    check_basics_of(model)
    for name in ("common_random_numbers", "standardize_utilities", "deterministic"):
        check_flag(name, getattr(model, name))
    check_function("estimator", model.estimator, ESTIMATORS)
    check_function("perturbation", model.perturbation, PERTURBATIONS)
    if not (isinstance(model.policy_class, type) and issubclass(model.policy_class, ActorCriticPolicy)):
        raise TypeError(f"policy must be a name or a subclass of ActorCriticPolicy, got {model.policy_class!r}")
    least = {"n_eval_episodes": 1, "max_episode_steps": 1}
    if model.n_delta is not None:
        least["n_delta"] = 2 if model.estimator == "regression" else 1
    if model.n_top is not None:
        least["n_top"] = 1
    as_integers(model, least)
    if model.n_top is not None:
        if model.estimator != "central":
            raise ValueError(f"n_top={model.n_top!r} needs estimator='central', got estimator={model.estimator!r}")
        if model.n_delta is None or model.n_top > model.n_delta:
            raise ValueError(f"n_top={model.n_top!r} needs an n_delta of at least that, got n_delta={model.n_delta!r}")
    if model.max_grad_norm is not None:
        check_number("max_grad_norm", model.max_grad_norm, 0, above=True)


def default_n_delta(estimator: Any, n_parameters: int) -> int:
    """
    The rule of thumb: 2n perturbations for the regression, n for the others, which is what determines ĝ.

    :param estimator: The argument ``estimator``
    :param n_parameters: n
    :return: The number of perturbations, at most 64
    """
    return min(2 * n_parameters if estimator == "regression" else n_parameters, MAX_DEFAULT_N_DELTA)


def default_delta_std(theta: th.Tensor) -> float:
    """
    1 % of ‖θ‖, and at least 0.05.

    :param theta: θ, shape ``(n,)``
    """
    return max(0.01 * float(theta.norm()), MIN_DEFAULT_DELTA_STD)


def check_deltas(deltas: Any, n_delta: int, n_parameters: int) -> th.Tensor:
    """
    Check what a perturbation returned.

    :param deltas: What it returned
    :param n_delta: k
    :param n_parameters: n
    :return: Shape ``(k, n)``, float64
    :raises ValueError: If it is not a finite tensor of shape ``(k, n)``
    """
    return _check_tensor("perturbation", deltas, (n_delta, n_parameters))


def check_gradient(gradient: Any, n_parameters: int) -> th.Tensor:
    """
    Check what an estimator returned.

    :param gradient: What it returned
    :param n_parameters: n
    :return: Shape ``(n,)``, float64
    :raises ValueError: If it is not a finite tensor of shape ``(n,)``
    """
    return _check_tensor("estimator", gradient, (n_parameters,))


def check_candidates(candidates: Any, n_parameters: int) -> th.Tensor:
    """
    Check what an estimator asks the utility of.

    :param candidates: What it asks it of
    :param n_parameters: n
    :return: Shape ``(k, n)`` or ``(m, k, n)``
    :raises ValueError: If it is not a finite tensor of one of these shapes
    """
    if not isinstance(candidates, th.Tensor) or candidates.dim() not in (2, 3) or candidates.shape[-1] != n_parameters:
        got = tuple(candidates.shape) if isinstance(candidates, th.Tensor) else candidates
        raise ValueError(
            f"candidates must be a tensor of shape (k, {n_parameters}) or (m, k, {n_parameters}), but the estimator "
            f"called the utility with {got}"
        )
    return _check_tensor("estimator", candidates, tuple(candidates.shape))


def _check_tensor(name: str, value: Any, shape: tuple[int, ...]) -> th.Tensor:
    if not isinstance(value, th.Tensor) or value.shape != shape:
        got = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, th.Tensor) else repr(value)
        raise ValueError(f"{name} must return a tensor of shape {shape}, got {got}")
    if not value.isfinite().all():
        raise ValueError(f"{name} must return finite numbers, got {value}")
    return value.detach().to("cpu", th.float64)
