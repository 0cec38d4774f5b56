"""
The algorithms in the RL Zoo: ``reinforce``, ``reinforce_lstm`` and ``finite_difference``.

Importing this package registers them with their Optuna samplers, and ``rl_zoo3.train`` finds their settings. A script
that builds experiments uses ``Experiment`` instead of the Zoo's ``ExperimentManager``. From a shell:
``python -m sb3_reinforce.zoo train --algo reinforce --env CartPole-v1``.
"""

try:
    import rl_zoo3.train
except ImportError as error:
    # Given its name, `python -m sb3_reinforce.zoo` prints the sentence without a traceback
    raise ImportError(
        f"sb3_reinforce.zoo needs the RL Zoo ({error}): pip install 'sb3-reinforce[zoo]', or pip install -e '.[zoo]' "
        "in a clone of the repository",
        name=__name__,
    ) from error

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

from sb3_reinforce.zoo import samplers
from sb3_reinforce.zoo.experiments import HYPERPARAMS, Experiment, make_experiment
from sb3_reinforce.zoo.settings import ALGORITHMS

__all__ = ["ALGORITHMS", "HYPERPARAMS", "Experiment"]

rl_zoo3.ALGOS.update(ALGORITHMS)
HYPERPARAMS_SAMPLER.update(
    reinforce=samplers.sample_reinforce,
    reinforce_lstm=samplers.sample_reinforce_lstm,
    finite_difference=samplers.sample_finite_difference,
)
HYPERPARAMS_CONVERTER.update(
    reinforce=samplers.convert_reinforce,
    reinforce_lstm=samplers.convert_reinforce_lstm,
    finite_difference=samplers.convert_finite_difference,
)
# The command train makes its experiment by this name
rl_zoo3.train.ExperimentManager = make_experiment  # type: ignore[misc,assignment]
