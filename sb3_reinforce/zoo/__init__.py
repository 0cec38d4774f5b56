"""
REINFORCE and FiniteDifference in the RL Zoo: importing this package registers both.

A script around ``rl_zoo3`` then finds them as ``reinforce`` and ``finite_difference``; from a shell,
``python -m sb3_reinforce.zoo train --algo reinforce --env CartPole-v1``.
"""

from pathlib import Path

try:
    import rl_zoo3
except ImportError as error:
    raise ImportError("sb3_reinforce.zoo needs the RL Zoo: pip install 'sb3-reinforce[zoo]'") from error

from sb3_reinforce import REINFORCE, FiniteDifference

HYPERPARAMS = Path(__file__).parent / "hyperparams"

rl_zoo3.ALGOS.update(reinforce=REINFORCE, finite_difference=FiniteDifference)
