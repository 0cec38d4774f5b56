"""VecNormalize during a comparison: one scale for all candidates, which learns from all steps afterwards."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_reinforce.common.moments import normalizers, observation_moments


class ObservationStatistics:
    """The statistics of the observations of steps, from which a frozen VecNormalize would have learned."""

    def __init__(self, vec_normalize: VecNormalize):
        self.vec_normalize = vec_normalize
        self.totals = observation_moments(vec_normalize)
        # No observation counts here yet, not even the pseudo-observations with which a VecNormalize starts
        self.seen = {key: RunningMeanStd(0.0, total.mean.shape) for key, total in self.totals.items()}
        self.is_training = True

    def freeze(self) -> None:
        """Stop the wrapper's learning."""
        self.is_training = self.vec_normalize.training
        self.vec_normalize.training = False

    def thaw(self) -> None:
        """Let the wrapper learn again, unless a callback has turned its learning off."""
        self.vec_normalize.training = self.is_training

    def update(self) -> None:
        """Add the observations of the last step."""
        if self.is_training and self.seen:
            obs = self.vec_normalize.get_original_obs()
            for key, seen in self.seen.items():
                seen.update(obs[key] if isinstance(obs, dict) else obs)


@contextmanager
def unscaled(env: VecEnv | None) -> Iterator[None]:
    """Let no VecNormalize scale or clip rewards in the block."""
    scaling = [each for each in normalizers(env) if each.norm_reward]
    try:
        for each in scaling:
            each.norm_reward = False
        yield
    finally:
        for each in scaling:
            each.norm_reward = True


@contextmanager
def frozen(env: VecEnv | None) -> Iterator[list[ObservationStatistics]]:
    """Freeze each VecNormalize that is learning; unless an error ends the block, they then learn what was observed."""
    observed = [ObservationStatistics(each) for each in normalizers(env) if each.training]
    with ExitStack() as undo:
        for each in observed:
            undo.callback(each.thaw)
            each.freeze()
        yield observed
    for each in observed:
        for key, seen in each.seen.items():
            if seen.count:
                each.totals[key].combine(seen)
