"""
The pitfalls of the policy gradient, one function each: what was observed in training, and which argument to change.

Each takes the ``History`` of a training and returns a sentence, or None. The thresholds are far from healthy runs: a
pitfall that is reported is there, one that is not may still be.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean, median
from typing import Any, TypeAlias

import torch as th
from gymnasium import spaces

from sb3_reinforce.diagnostics.statistics import compute_moments, gram, signal_to_noise
from sb3_reinforce.policies.natural import DEFAULT_TARGET_KL
from sb3_reinforce.reinforce import REINFORCE


@dataclass(frozen=True)
class Update:
    """What is known of one update; NaN for what is not known."""

    kl: float  # of the policy step, as logged
    randomness: float  # share of the randomness that the policy could have, from 0 to 1
    grad_norm: float  # before clipping
    explained_variance: float  # of the critic
    gradient: th.Tensor  # some components, shape (c,); none if the actor is frozen
    return_scale: float  # root mean square of the returns
    target_scale: float  # root mean square of the critic's targets: returns to go, even if reward_to_go=False
    target_std: float
    n_episodes: int  # parts of episodes count
    n_steps: int  # steps used
    used_fraction: float  # share of the steps that were used
    temperature: float  # of the rollout


@dataclass(frozen=True)
class History:
    """What a pitfall is detected from."""

    model: REINFORCE
    updates: list[Update]  # the last ones, at most 50
    n_updates: int
    progress_remaining: float  # from 1 to 0
    path: float  # Σ √(2 KL) over the updates of this call of learn
    n_moves: int  # how many of these changed the policy
    share: float  # of this call of learn that follows the first change of the policy, from 0 to 1


Pitfall: TypeAlias = Callable[[History], str | None]


def scheduled(value: Any, history: History) -> float:
    """The present value of an argument that may be a schedule."""
    return float(value(history.progress_remaining) if callable(value) else value)


def step_bound(history: History) -> tuple[str, float]:
    """The argument that bounds a step of the policy, and its present value."""
    model = history.model
    if model.step == "natural":
        target_kl = DEFAULT_TARGET_KL if model.target_kl is None else model.target_kl
        return "target_kl", scheduled(target_kl, history)
    return "learning_rate", scheduled(model.lr_schedule, history)


def rate_too_large(history: History) -> str | None:
    """
    A KL divergence above 1 in one update, a median above 0.1 over ten, or randomness that falls within ten by more than
    half of what the policy could have, unless the temperature has fallen.
    """
    updates = history.updates[-10:]
    steps = [update.kl for update in updates if not math.isnan(update.kl)]
    before = updates[0].randomness
    after = updates[-1].randomness
    if history.progress_remaining > 0.5 and before < 0.05:
        # Without randomness any rate is too large: see deterministic_too_early
        return None
    argument, value = step_bound(history)
    remedy = f"Lower {argument} (now {value:.2g})"
    if steps and (steps[-1] > 1 or (len(steps) == 10 and median(steps) > 0.1)):
        return (
            f"The policy changes too much per update: the KL divergence of the last one is {steps[-1]:.2g} (median of "
            f"the last {len(steps)}: {median(steps):.2g}; 0.01 is usual). {remedy}, or use a falling schedule"
        )
    if before - after > 0.5 and updates[-1].temperature > 0.9 * updates[0].temperature:
        return (
            f"The entropy collapses: within {len(updates)} updates the policy went from {before:.0%} to {after:.0%} of "
            f"the randomness that it could have. {remedy}, or raise ent_coef"
        )
    return None


def rate_too_small(history: History) -> str | None:
    """
    After half of the training and ten updates, steps ``√(2 KL)`` below 0.01 on average, whose sum will stay below 0.3.

    If all steps have one direction, the policy ends at a KL divergence of about ``path² / 2``, 0.045, from its start;
    otherwise it ends nearer.
    """
    is_slow = history.path < min(0.3 * history.share, 0.01 * history.n_moves)
    # A run of a few updates is a trial
    if history.n_moves < 10 or history.share <= 0.5 or not is_slow:
        return None
    argument, value = step_bound(history)
    n_steps = history.model.n_steps if history.model.step == "optimizer" else None
    more_updates = "" if n_steps is None else f", or lower n_steps (now {n_steps}) for more updates"
    return (
        f"The policy hardly changes: {history.n_moves} updates, in {history.share:.0%} of the training, moved it by a "
        f"KL divergence of at most about {history.path**2 / 2:.2g}. Raise {argument} (now {value:.2g}){more_updates}"
    )


def unscaled_returns(history: History) -> str | None:
    """Returns in the thousands that nothing normalizes."""
    model = history.model
    scale = history.updates[-1].return_scale
    # The natural step does not depend on the scale, but the critic's does
    is_natural = model.step == "natural"
    is_scaled = not model.has_critic if is_natural else model.normalize_advantage
    if scale <= 1000 or is_scaled:
        return None
    what, remedy = ("critic's gradient", "") if is_natural else ("gradient", ", or set normalize_advantage=True")
    return (
        f"The returns have a root mean square of {scale:.3g}, and the {what} has their scale. Wrap the environment in "
        f"VecNormalize with norm_reward=True{remedy}"
    )


def too_few_episodes(history: History) -> str | None:
    """
    A signal-to-noise ratio below 0.1 of the gradients of 50 updates with, on average, fewer than 8 whole episodes or,
    in fixed rollouts, 64 steps.

    The ratio alone would not do: it is near 0 for a policy that has nothing left to learn, however large its batches.
    """
    n_episodes = fmean(update.n_episodes for update in history.updates)
    n_steps = fmean(update.n_steps for update in history.updates)
    # Parameters may be frozen or unfrozen on the way, and then gradients are not comparable
    gradients = [update.gradient for update in history.updates]
    is_comparable = len(gradients[-1]) > 0 and all(each.shape == gradients[-1].shape for each in gradients)
    is_large = n_episodes >= 8 if history.model.n_steps is None else n_steps >= 64
    if len(gradients) < 50 or not is_comparable or is_large:
        return None
    ratio = float(signal_to_noise(compute_moments(gram(th.stack(gradients)))))
    if ratio < 0.1 or math.isnan(ratio):
        argument = "n_episodes" if history.model.n_steps is None else "n_steps, or the number of environments"
        if history.model.episodes_per_start > 1:
            argument = "the number of environments, and n_episodes with it if it is set"
        shown = f"{ratio:.2g}" if ratio > 0 else "not distinguishable from 0"
        return (
            f"The gradient is mostly noise: over the last {len(gradients)} updates its signal-to-noise ratio is "
            f"{shown}, with {n_steps:.0f} steps from {n_episodes:.1f} episodes per update. Raise {argument}"
        )
    return None


def uses_total_return(history: History) -> str | None:
    """Every action weighted by the whole return, in episodes of more than one step."""
    if not history.model.reward_to_go and history.updates[-1].n_steps > history.updates[-1].n_episodes:
        return (
            "Every action is weighted by the total return, which includes rewards from before it. Set "
            "reward_to_go=True, which usually has less variance (and with discount_scores=True the same expectation)"
        )
    return None


def spikes_without_clipping(history: History) -> str | None:
    """A gradient ten times as long as usual, without a bound on its norm: the natural step does not depend on it."""
    norms = [update.grad_norm for update in history.updates]
    is_unbounded = history.model.step == "optimizer" and history.model.max_grad_norm in (None, math.inf)
    if is_unbounded and len(norms) >= 20:
        usual = median(norms[:-1])
        if norms[-1] > 10 * usual > 0:
            return (
                f"A gradient has norm {norms[-1]:.3g}, and the median is {usual:.3g}: one such batch can undo what was "
                "learned. Set max_grad_norm, 0.5 for example"
            )
    return None


def useless_critic(history: History) -> str | None:
    """Values that explain less than 5 % of the variance of their targets, after 100 updates and half of training."""
    # Targets that vary by less than a tenth of their size, as of a pole that never falls, leave nothing to explain
    varied = [update for update in history.updates if update.target_std > 0.1 * update.target_scale]
    explained = [each.explained_variance for each in varied if math.isfinite(each.explained_variance)]
    late = history.n_updates >= 100 and history.progress_remaining < 0.5
    if history.model.has_critic and late and len(explained) >= 25 and median(explained) < 0.05:
        return (
            f"The critic explains almost none of the variance of the returns: the median of train/explained_variance "
            f"is {median(explained):.2g}. Raise n_critic_updates={history.model.n_critic_updates!r} or "
            "critic_learning_rate, scale the returns (VecNormalize), or use another baseline"
        )
    return None


def deterministic_too_early(history: History) -> str | None:
    """Less than 5 % of the randomness left, before half of the training is over."""
    left = history.progress_remaining
    share = history.updates[-1].randomness
    if left > 0.5 and share < 0.05:
        remedy = f"raise temperature (now {history.updates[-1].temperature:.2g})"
        if isinstance(history.model.action_space, spaces.Box):
            remedy = "raise min_std or log_std_init (for actions in the hundreds, scale them to [-1, 1])"
        ent_coef = scheduled(history.model.ent_coef, history)
        return (
            f"With {left:.0%} of the training left the policy is almost deterministic ({share:.1%} of the randomness "
            f"that it could have), and its scores vanish. Raise ent_coef (now {ent_coef:.2g}), "
            f"{remedy}, or lower {step_bound(history)[0]}"
        )
    return None


def cut_episodes(history: History) -> str | None:
    """More than a tenth of the steps left out, because ``n_steps`` cuts their episodes and there is no critic."""
    model = history.model
    share = fmean(update.used_fraction for update in history.updates)
    if model.n_steps is not None and not model.has_critic and share < 0.9:
        return (
            f"n_steps={model.n_steps} cuts episodes: {1 - share:.0%} of the steps are left out, mostly in long "
            "episodes, which biases the gradient. Set n_episodes instead, or use baseline='value'"
        )
    return None


PITFALLS: dict[str, Pitfall] = {
    "rate_too_large": rate_too_large,
    "rate_too_small": rate_too_small,
    "unscaled_returns": unscaled_returns,
    "too_few_episodes": too_few_episodes,
    "total_return": uses_total_return,
    "spikes_without_clipping": spikes_without_clipping,
    "useless_critic": useless_critic,
    "deterministic_too_early": deterministic_too_early,
    "cut_episodes": cut_episodes,
}

# A pitfall is not reported after one of its causes. The policy's learning rate is by default the critic's too
CAUSES = {
    "deterministic_too_early": {"rate_too_large"},
    "rate_too_small": {"rate_too_large", "deterministic_too_early"},
    "too_few_episodes": {"rate_too_large", "deterministic_too_early"},
    "useless_critic": {"rate_too_large", "rate_too_small", "unscaled_returns"},
}
