"""The mathematics: returns, baselines, weights, scores, perturbations and finite differences, as pure functions."""

from sb3_reinforce.estimation.baselines import BASELINES, Baseline, leave_one_out, mean, none, optimal, time_mean, value
from sb3_reinforce.estimation.estimators import (
    ESTIMATORS,
    Estimator,
    Fit,
    GradientEstimate,
    Utility,
    central_difference,
    fit_quality,
    forward_difference,
    regression_gradient,
)
from sb3_reinforce.estimation.perturbations import PERTURBATIONS, Perturbation, coordinate, gaussian, rademacher, sphere
from sb3_reinforce.estimation.returns import discounted_sum, lambda_return, reward_to_go, total_return
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import gradients_by_episode

__all__ = [
    "BASELINES",
    "ESTIMATORS",
    "PERTURBATIONS",
    "Baseline",
    "Estimator",
    "Fit",
    "GradientEstimate",
    "Perturbation",
    "Rollout",
    "Utility",
    "central_difference",
    "coordinate",
    "discounted_sum",
    "fit_quality",
    "forward_difference",
    "gaussian",
    "gradients_by_episode",
    "lambda_return",
    "leave_one_out",
    "mean",
    "none",
    "optimal",
    "rademacher",
    "regression_gradient",
    "reward_to_go",
    "sphere",
    "time_mean",
    "total_return",
    "value",
]
