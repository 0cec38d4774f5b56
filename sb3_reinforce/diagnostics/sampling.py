"""Collect episodes for a measurement with the model's own code, without changing the model."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.arguments import check_flag, check_integer, check_kind
from sb3_reinforce.estimation.baselines import Baseline
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.weights import training_batch
from sb3_reinforce.policies.evaluation import evaluation_mode
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.sampling.measurement import sampling_copy, undisturbed


def sample(
    model: REINFORCE, n_episodes: int, baseline: str | Baseline | None = None, progress_bar: bool = False
) -> Rollout:
    """
    Whole episodes of the model's policy in its environments, with the model's own returns.

    The model keeps its parameters, counters and log, and a VecNormalize keeps its statistics. The environments are left
    at the start of an episode, and the policy in evaluation mode. PyTorch's global generator draws the actions, and is
    not restored.

    With gSDE the episodes share noise, unless ``sde_sample_freq=1``, and are not independent samples.

    :param model: The model
    :param n_episodes: Number of episodes, at least 2
    :param baseline: The baseline to collect with, a name or a function; None for ``"value"`` if the model has a critic,
        else ``"none"``. With another one than ``"value"`` λ is 1
    :param progress_bar: Display a bar of tqdm that counts the episodes
    :return: The rollout; it has ``values`` only if the baseline is ``"value"``
    :raises TypeError: If the model is not a REINFORCE, or the baseline neither a name nor a function
    :raises ValueError: If there are too few episodes, the baseline is unknown, or the model has no environment or is
        collecting a rollout
    """
    check_model(model)
    collector = sampling_copy(model, check_integer("n_episodes", n_episodes, 2), baseline)
    with episode_bar(progress_bar, n_episodes) as bar, undisturbed(model):
        return collect_episodes(collector, bar)


def episode_bar(progress_bar: bool, n_episodes: int | None = None) -> AbstractContextManager[Any]:
    """A progress bar that counts episodes, or None; only the bar needs tqdm."""
    if not check_flag("progress_bar", progress_bar):
        return nullcontext()
    from tqdm import tqdm

    return cast(AbstractContextManager[Any], tqdm(total=n_episodes, unit=" episodes"))


def collect_episodes(collector: REINFORCE, bar: Any = None) -> Rollout:
    """Let a sampling copy collect its episodes, counted by a bar of tqdm or None, with log π in its rollout buffer."""

    def count(local: dict[str, Any], _: dict[str, Any]) -> bool:
        if bar is not None:
            # An environment that has played its quota goes on, and its further episodes do not count
            bar.update(int(np.count_nonzero(np.logical_and(local["dones"], local["extent"].remaining > 0))))
        return True

    callback = ConvertCallback(count)
    callback.init_callback(collector)
    collector.collect_rollouts(cast(VecEnv, collector.env), callback, collector.rollout_buffer, None)
    return cast(Rollout, collector.rollout)


@contextmanager
def seeded(policy: BasePolicy, seed: int) -> Iterator[None]:
    """Seed PyTorch's generators of the CPU and of the policy's GPU in the block, in evaluation mode; restore both."""
    # th.manual_seed would seed the generators of all GPUs
    gpus = [policy.device] if policy.device.type == "cuda" else []
    with th.random.fork_rng(gpus), evaluation_mode(policy):
        th.default_generator.manual_seed(seed)
        for gpu in gpus:
            with th.cuda.device(gpu):
                th.cuda.manual_seed(seed)
        yield


def check_model(model: Any, kinds: tuple[type, ...] = (REINFORCE,), independent: bool = False) -> None:
    """Check a model's kind, its environments, and with ``independent`` that its episodes are independent samples."""
    allowed = f"a {' or '.join(kind.__name__ for kind in kinds)}"
    if isinstance(model, OnPolicyAlgorithm):
        allowed += " (whose set_parameters(..., exact_match=False) takes the policy of an A2C or PPO)"
    check_kind("model", model, kinds, allowed)
    if independent and model.use_sde and model.sde_sample_freq != 1:
        raise ValueError(
            f"model has use_sde=True and sde_sample_freq={model.sde_sample_freq}: its episodes share noise, so they "
            "are not independent samples. Measure a model with sde_sample_freq=1, or without use_sde"
        )
    env_of(model)


def env_of(model: BaseAlgorithm) -> VecEnv:
    """The environments of a model, or a ``ValueError`` if it has none."""
    if model.env is None:
        raise ValueError("model must have an environment to sample episodes from: call set_env first")
    return model.env


def training_weights(model: REINFORCE) -> th.Tensor:
    """γ^t (G_t − b_t) of ``train()``, normalized if the model does so, shape ``(n_steps, n_envs)``, float64."""
    rollout = cast(Rollout, model.rollout)
    batch = training_batch(rollout, model.rollout_buffer, model.normalize_advantage)
    weights = th.zeros_like(rollout.returns)
    weights[rollout.used] = batch.weights.cpu().to(weights)
    return weights


def evenly_spread(rollout: Rollout, n_episodes: int) -> Rollout:
    """A rollout of which only ``n_episodes`` episodes are used, spread evenly over the environments."""
    numbers = rollout.used_episodes
    if len(numbers) <= n_episodes:
        return rollout
    kept = numbers[th.linspace(0, len(numbers) - 1, n_episodes).round().long()]
    return replace(rollout, used=rollout.used & th.isin(rollout.episodes, kept))
