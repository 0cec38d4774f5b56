"""How much of the return is decided by the start of an episode, and whether groups that share a start pay."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch as th
from torch.nn.utils.rnn import pad_sequence

from sb3_reinforce.common.arguments import check_integer, check_number
from sb3_reinforce.common.tensors import map_parts
from sb3_reinforce.diagnostics.sampling import check_model, collect_episodes, env_of, episode_bar, seeded
from sb3_reinforce.diagnostics.statistics import compute_moments, gram, variance
from sb3_reinforce.diagnostics.tables import Estimate, as_text, interval, resample_counts
from sb3_reinforce.envs.starts import check_groups
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import CHUNK, gradient_blocks
from sb3_reinforce.estimation.weights import without_rounding
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.sampling.measurement import sampling_copy, start_from, undisturbed

# Sizes of groups to predict, and episodes per start
SIZES = (2, 4, 8)
N_PER_START = SIZES[-1]


@dataclass(frozen=True)
class StartReport:
    """
    What ``compare_starts`` returns.

    :param share: The share of the variance of the return that lies between starts, from 0 to 1
    :param gains: By m (2, 4 and 8), the variance of the gradient with independent starts divided by the variance with
        ``episodes_per_start=m``, both with ``"leave_one_out"`` and rollouts of ``n_starts`` episodes. Above 1 it pays
    """

    share: Estimate
    gains: Mapping[int, Estimate]

    def __str__(self) -> str:
        lines = [f"Share of the variance of the return between starts: {as_text(self.share)}"]
        lines += [f"episodes_per_start={m}: variance divided by {as_text(gain)}" for m, gain in self.gains.items()]
        return "\n".join(lines)


def compare_starts(
    model: REINFORCE,
    n_starts: int = 32,
    n_resamples: int = 500,
    confidence: float = 0.95,
    seed: int = 0,
    progress_bar: bool = False,
) -> StartReport:
    """
    Measure whether groups of episodes that share their start would reduce the variance of the gradient.

    The model's policy plays eight episodes from each start, with the model's γ. What the environment draws after the
    start is shared too, and counts as part of it. Where all returns are equal, nothing is known, and the share is NaN.
    With few starts the intervals are too narrow. For networks with many parameters, such as a CnnPolicy, the
    measurement takes several passes over the episodes.

    :param model: The model; it is not changed. Its environments get new seeds, and are left at the start of an episode
    :param n_starts: Number of starts, at least 4; rounded up until the environments play equal numbers of episodes
    :param n_resamples: Number of bootstrap resamples of the starts
    :param confidence: Probability with which an interval should cover the true value
    :param seed: Seed of the starts, of the actions and of the resamples
    :param progress_bar: Display a bar of tqdm that counts the episodes
    :return: The share and the predicted gains
    :raises TypeError: If the model is not a REINFORCE
    :raises ValueError: If an argument is out of its range, if the episodes are not independent because they share the
        noise of gSDE, if an environment does not start alike from the same seed or cannot be seeded alone, or if the
        model has no environment or is collecting a rollout
    """
    check_model(model, independent=True)
    env = env_of(model)
    step = env.num_envs // math.gcd(env.num_envs, N_PER_START)
    n_starts = math.ceil(check_integer("n_starts", n_starts, 4) / step) * step
    check_number("confidence", confidence, 0, 1)
    seed = check_integer("seed", seed, 0)
    counts = resample_counts(n_starts, n_resamples, seed)
    with seeded(model.policy, seed):
        rollouts = sample_starts(model, n_starts, progress_bar)
        # G_t and m_t, (n_steps, n_starts, N_PER_START)
        returns = by_start([rollout.returns * rollout.used for rollout in rollouts])
        used = by_start([rollout.used.double() for rollout in rollouts])
        grams = group_grams(rollouts, returns, used)
    single = variance(compute_moments(grams[1], counts))
    # The mean of N/m independent groups: tr Σ_m / (N/m), against tr Σ_1 / N
    gains = {m: interval(single / (m * variance(compute_moments(grams[m], counts))), confidence) for m in SIZES}
    return StartReport(interval(share_between(returns[0], counts), confidence), gains)


def sample_starts(model: REINFORCE, n_starts: int, progress_bar: bool = False) -> list[Rollout]:
    """Rollouts of one episode per environment, which play ``N_PER_START`` episodes of each start in turn."""
    env = env_of(model)
    collector = sampling_copy(model, env.num_envs, "none")
    seeds = th.randint(2**31, (n_starts,)).numpy().repeat(N_PER_START)
    rollouts = []
    firsts = []
    with episode_bar(progress_bar, len(seeds)) as bar, undisturbed(model):
        # Pending seeds would replace the seeds of the first episodes
        env.reset()
        for part in seeds.reshape(-1, env.num_envs):
            # A copy: some VecEnvs reuse the array
            firsts.append(map_parts(np.copy, start_from(collector, part)))
            rollouts.append(collect_episodes(collector, bar))
        check_groups(map_parts(lambda *parts: np.concatenate(parts), *firsts), N_PER_START)
    return rollouts


def by_start(parts: list[th.Tensor]) -> th.Tensor:
    """Rows ``(n_steps, n_envs)`` of all rollouts, with zeros after their end, by start: ``(n_steps, n_starts, k)``."""
    padded = pad_sequence(parts)
    return padded.reshape(len(padded), -1, N_PER_START)


def mean_of_others(returns: th.Tensor, used: th.Tensor, dim: int) -> th.Tensor:
    """``b_t``, the mean of G_t over the others along ``dim`` that reach step t, and 0 where there is none."""
    totals = returns.sum(dim, keepdim=True) - returns
    counts = used.sum(dim, keepdim=True) - used
    return totals / counts.clamp(min=1)


def group_grams(rollouts: list[Rollout], returns: th.Tensor, used: th.Tensor) -> dict[int, th.Tensor]:
    """
    By m, what ``compute_moments`` takes of the mean gradient Γ of m episodes that are each other's baseline.

    ``⟨E_s Γ, E_r Γ⟩`` for starts s ≠ r, and ``E_s ‖Γ‖²`` on the diagonal, both ``(n_starts, n_starts)``.
    """
    # An episode alone has its baseline from the other starts
    baselines = {1: mean_of_others(returns, used, dim=1)}
    for m in SIZES:
        groups = (*returns.shape[:2], -1, m)
        baselines[m] = mean_of_others(returns.reshape(groups), used.reshape(groups), dim=3).reshape(returns.shape)
    residuals = (returns - th.stack(list(baselines.values()))) * used
    weights = without_rounding(residuals, returns.abs().max()).flatten(2)
    blocks = []
    for rollout, own in zip(rollouts, weights.chunk(len(rollouts), dim=2), strict=True):
        w = rollout.discounts * own[:, : len(rollout.dones)]
        blocks.append(gradient_blocks(rollout, *w, floats=CHUNK // len(rollouts)))
    n_starts = returns.shape[1]
    grams = {m: th.zeros(n_starts, n_starts, dtype=th.float64) for m in baselines}
    for block in zip(*blocks, strict=True):
        for m, gradients in zip(baselines, th.cat(block, dim=1), strict=True):
            groups = gradients.double().reshape(n_starts, -1, m, gradients.shape[1]).mean(2)
            products = gram(groups.mean(1))
            products.diagonal().copy_(groups.square().sum(2).mean(1))
            grams[m] += products
    return grams


def share_between(returns: th.Tensor, counts: th.Tensor) -> th.Tensor:
    """
    ``σ²_between / (σ²_between + σ²_within)`` of returns ``(n_starts, k)``, for resamples of starts ``(r, n_starts)``.

    The means of k episodes vary by ``σ²_between + σ²_within / k`` (Searle, Casella and McCulloch, 1992, chapter 3).
    """
    centered = without_rounding(returns - returns.mean(), returns.abs().max())
    means = centered.mean(1)
    within = counts @ centered.var(1) / counts.sum(1)
    between = (variance(compute_moments(means[:, None] * means, counts)) - within / returns.shape[1]).clamp(min=0)
    return between / (between + within)
