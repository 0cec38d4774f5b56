"""
The gradient lab: how good the estimate of the gradient is, whether it is right, and what to change.

This module hands on the public names of its rooms.
"""

from sb3_reinforce.bootstrap import Estimate
from sb3_reinforce.comparisons import BaselineRow, compare_baselines
from sb3_reinforce.estimator_comparison import EstimatorRow, compare_estimators
from sb3_reinforce.gradient_check import CheckRow, CheckTable, check_gradient
from sb3_reinforce.gradient_statistics import GradientStatistics, gradient_statistics
from sb3_reinforce.landscapes import Landscape, landscape
from sb3_reinforce.pitfall_callback import PitfallCallback
from sb3_reinforce.quality_callback import GradientQualityCallback
from sb3_reinforce.sampling import sample
from sb3_reinforce.scores import gradients_by_episode
from sb3_reinforce.tables import Table

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
