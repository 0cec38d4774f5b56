"""VecNormalize during a comparison: one scale for all candidates, and nothing lost of what they saw."""

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


class Observed:
    """
    Statistics of observations before normalization.

    :param vec_normalize: The wrapper that sees them
    """

    def __init__(self, vec_normalize: VecNormalize):
        self.vec_normalize = vec_normalize
        totals = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
        self.totals = totals if isinstance(totals, dict) else {"": totals}
        # No observation counts here yet, not even the pseudo-observations with which a VecNormalize starts
        self.seen = {key: RunningMeanStd(0.0, total.mean.shape) for key, total in self.totals.items()}

    def update(self) -> None:
        """Take in the observations of the last step."""
        obs = self.vec_normalize.get_original_obs() if self.seen else {}
        for key, seen in self.seen.items():
            seen.update(obs[key] if isinstance(obs, dict) else obs)

    def hand_over(self) -> None:
        """Let the wrapper's own statistics take in all of them."""
        for key, seen in self.seen.items():
            if seen.count:
                self.totals[key].combine(seen)


@contextmanager
def frozen(vec_normalize: VecNormalize | None) -> Iterator[Observed | None]:
    """
    Freeze the statistics within the block; after it, if nothing was raised, they take in what was seen.

    :param vec_normalize: The wrapper, None for none
    :return: What to update with each step; None where the statistics are not learning
    """
    if vec_normalize is None or not vec_normalize.training:
        yield None
        return
    observed = Observed(vec_normalize)
    vec_normalize.training = False
    try:
        yield observed
    finally:
        vec_normalize.training = True
    observed.hand_over()
