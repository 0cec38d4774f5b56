"""VecNormalize during a comparison: one scale for all candidates, and no observation lost."""

from collections.abc import Iterator
from contextlib import contextmanager

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize


class ObservationStatistics:
    """Statistics of the observations below a VecNormalize since it was frozen."""

    def __init__(self, vec_normalize: VecNormalize):
        self.vec_normalize = vec_normalize
        totals = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
        self.totals = totals if isinstance(totals, dict) else {"": totals}
        # No observation counts here yet, not even the pseudo-observations with which a VecNormalize starts
        self.seen = {key: RunningMeanStd(0.0, total.mean.shape) for key, total in self.totals.items()}

    def update(self) -> None:
        """Add the observations of the last step."""
        if self.seen:
            obs = self.vec_normalize.get_original_obs()
            for key, seen in self.seen.items():
                seen.update(obs[key] if isinstance(obs, dict) else obs)


@contextmanager
def frozen(vec_normalize: VecNormalize | None) -> Iterator[ObservationStatistics | None]:
    """Freeze a VecNormalize that is learning; after the block it learns what was observed, unless an error ended it."""
    if vec_normalize is None or not vec_normalize.training:
        yield None
        return
    observed = ObservationStatistics(vec_normalize)
    vec_normalize.training = False
    try:
        yield observed
    finally:
        vec_normalize.training = True
    for key, seen in observed.seen.items():
        if seen.count:
            observed.totals[key].combine(seen)
