"""
The gradient lab: how good the estimate of the gradient is, whether it is right, and what to change.

Re-exports the public names of its modules. Import ``sb3_reinforce.diagnostics.plots`` separately: it needs matplotlib.
"""

from sb3_reinforce.diagnostics.baseline_comparison import BaselineRow, compare_baselines
from sb3_reinforce.diagnostics.callbacks import GradientQualityCallback, PitfallCallback
from sb3_reinforce.diagnostics.estimator_comparison import EstimatorRow, compare_estimators
from sb3_reinforce.diagnostics.gradient_check import CheckRow, CheckTable, check_gradient
from sb3_reinforce.diagnostics.landscapes import CandidateUtility, Landscape, landscape
from sb3_reinforce.diagnostics.sampling import sample
from sb3_reinforce.diagnostics.start_comparison import StartReport, compare_starts
from sb3_reinforce.diagnostics.statistics import GradientStatistics, gradient_statistics
from sb3_reinforce.diagnostics.tables import Estimate, Table
from sb3_reinforce.estimation.scores import gradients_by_episode

__all__ = [
    "BaselineRow",
    "CandidateUtility",
    "CheckRow",
    "CheckTable",
    "Estimate",
    "EstimatorRow",
    "GradientQualityCallback",
    "GradientStatistics",
    "Landscape",
    "PitfallCallback",
    "StartReport",
    "Table",
    "check_gradient",
    "compare_baselines",
    "compare_estimators",
    "compare_starts",
    "gradient_statistics",
    "gradients_by_episode",
    "landscape",
    "sample",
]
