"""VecNormalize during a comparison: one scale for all candidates, which learns from all steps afterwards."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import cast

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)

from sb3_reinforce.common.moments import normalizers, observation_moments

# By the method, since a subclass may have another one
KEEP_REWARDS = {
    wrapper.step_wait
    for wrapper in (VecCheckNan, VecExtractDictObs, VecFrameStack, VecMonitor, VecTransposeImage, VecVideoRecorder)
}


class ObservationStatistics:
    """The statistics of observations that a frozen VecNormalize would have learned if it were not frozen."""

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


def original_reward_of(env: VecEnv) -> tuple[Callable[[], np.ndarray] | None, VecEnv]:
    """The method for rewards that VecNormalize has not scaled, or None; and the first VecEnv that may change them."""
    found = None
    while isinstance(env, VecNormalize) or type(env).step_wait in KEEP_REWARDS:
        if isinstance(env, VecNormalize) and env.norm_reward:
            found = env.get_original_reward
        env = cast(VecEnvWrapper, env).venv
    return found, env


def check_scale(env: VecEnv) -> None:
    """Refuse a VecNormalize whose scale of the rewards is used, but would never be learned."""
    original, changing = original_reward_of(env)
    if original is None and any(each.training and each.norm_reward for each in normalizers(env)):
        raise ValueError(
            f"{type(changing).__name__} lies above VecNormalize and may change rewards. FiniteDifference compares "
            "candidates at a frozen scale, which VecNormalize would never learn: set norm_reward=False, or "
            "training=False once the scale is learned"
        )


@contextmanager
def unclipped(env: VecEnv | None) -> Iterator[None]:
    """Let no VecNormalize clip rewards in the block, so that their sums are multiples of the utility."""
    with ExitStack() as undo:
        for each in normalizers(env):
            undo.callback(setattr, each, "clip_reward", each.clip_reward)
            each.clip_reward = np.inf
        yield


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
