"""
The gradient lab: how good the estimate of the gradient is, whether it is right, and what to change.

The package hands on the public names of its rooms.
"""

from sb3_reinforce.diagnostics.bootstrap import Estimate
from sb3_reinforce.diagnostics.comparisons import BaselineRow, compare_baselines
from sb3_reinforce.diagnostics.estimator_comparison import EstimatorRow, compare_estimators
from sb3_reinforce.diagnostics.gradient_check import CheckRow, CheckTable, check_gradient
from sb3_reinforce.diagnostics.gradient_statistics import GradientStatistics, gradient_statistics
from sb3_reinforce.diagnostics.landscapes import Landscape, landscape
from sb3_reinforce.diagnostics.pitfall_callback import PitfallCallback
from sb3_reinforce.diagnostics.quality_callback import GradientQualityCallback
from sb3_reinforce.diagnostics.sampling import sample
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.scores import gradients_by_episode

__all__ = [
    "BaselineRow",
    "CheckRow",
    "CheckTable",
    "Estimate",
    "EstimatorRow",
    "GradientQualityCallback",
    "GradientStatistics",
    "Landscape",
    "PitfallCallback",
    "Table",
    "check_gradient",
    "compare_baselines",
    "compare_estimators",
    "gradient_statistics",
    "gradients_by_episode",
    "landscape",
    "sample",
]
