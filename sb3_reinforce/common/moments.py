"""The statistics of VecNormalize."""

from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize


def normalizers(env: VecEnv | None) -> list[VecNormalize]:
    """All VecNormalize of a stack of wrappers, the outermost first."""
    found = []
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecNormalize):
            found.append(env)
        env = env.venv
    return found


def observation_moments(vec_normalize: VecNormalize) -> dict[str, RunningMeanStd]:
    """The statistics of the observations by key, under "" for an array; none where they are not normalized."""
    moments = vec_normalize.obs_rms if vec_normalize.norm_obs else {}
    return moments if isinstance(moments, dict) else {"": moments}


def seen_since(before: RunningMeanStd, after: RunningMeanStd) -> RunningMeanStd:
    """The moments of what was observed in between: n E[x − m] and n E[(x − m)²] add up, where m is the mean before."""
    seen = RunningMeanStd(0.0, after.mean.shape)
    seen.count = after.count - before.count
    if seen.count > 0:
        shift = after.mean - before.mean
        first = after.count * shift / seen.count
        second = (after.count * (after.var + shift**2) - before.count * before.var) / seen.count
        seen.mean = before.mean + first
        seen.var = second - first**2
    return seen
