"""
The pitfalls of the policy gradient, one function each: what was seen in training, and which argument to change.

Each takes what has been ``Seen`` and returns a sentence, or None. The thresholds are far from what healthy runs show:
a pitfall that is reported is there, one that is not may still be.
"""

import math
from collections.abc import Callable
from statistics import fmean, median
from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_reinforce.diagnostics.moments import gram, moments, signal_to_noise
from sb3_reinforce.diagnostics.updates import Seen, Update

Pitfall: TypeAlias = Callable[[Seen], str | None]


def rate_too_large(seen: Seen) -> str | None:
    """
    A policy that leaps: a KL divergence above 1 in one update, a median above 0.1 over ten, or more than half of the
    randomness that it could have gone within ten.

    :param seen: What was seen
    """
    steps, space = [update.kl for update in seen.updates[-10:]], seen.model.action_space
    remedy = f"Lower the learning rate, now {seen.model.lr_schedule(seen.model._current_progress_remaining):.2g}"
    if steps[-1] > 1 or (len(steps) == 10 and median(steps) > 0.1):
        return (
            f"The policy leaps: its KL divergence from one update to the next is {steps[-1]:.2g} (median of the last "
            f"{len(steps)}: {median(steps):.2g}; 0.01 is usual). {remedy}, or let learning_rate decay"
        )
    before, after = randomness(space, seen.updates[-10:][0]), randomness(space, seen.updates[-1])
    if before - after > 0.5:
        return (
            f"The entropy collapses: within {len(steps)} updates the policy went from {before:.0%} to {after:.0%} of "
            f"the randomness that it could have. {remedy} (learning_rate), or raise ent_coef"
        )
    return None


def unscaled_returns(seen: Seen) -> str | None:
    """
    Returns in the thousands that nothing brings to scale.

    :param seen: What was seen
    """
    scale = seen.updates[-1].return_scale
    if scale > 1000 and not seen.model.normalize_advantage:
        return (
            f"The returns have a root mean square of {scale:.3g}, and the gradient has their scale. Wrap the "
            "environment in VecNormalize, or set normalize_advantage=True"
        )
    return None


def too_few_episodes(seen: Seen) -> str | None:
    """
    A signal-to-noise ratio of the gradients of 50 updates below 0.1, from few episodes or parts of them (fewer than
    eight an update) or few steps (fewer than 64).

    The ratio alone would not do: it is near 0 for a policy that has nothing left to learn, however large its batches.

    :param seen: What was seen
    """
    n_episodes = fmean(update.n_episodes for update in seen.updates)
    n_steps = fmean(update.n_steps for update in seen.updates)
    if len(seen.updates) < 50 or (n_episodes >= 8 and n_steps >= 64):
        return None
    gradients = th.stack([update.gradient for update in seen.updates])
    ratio = float(signal_to_noise(moments(gram(gradients), th.ones(1, len(gradients), dtype=th.float64))))
    if ratio < 0.1 or math.isnan(ratio):
        argument = "n_episodes" if seen.model.n_steps is None else "n_steps, or the number of environments"
        return (
            f"The gradient is mostly noise: over the last {len(gradients)} updates its signal-to-noise ratio is "
            f"{ratio:.2g}, with {n_steps:.0f} steps of {n_episodes:.1f} episodes an update. Raise {argument}: 20 "
            "episodes or more are usual"
        )
    return None


def total_return(seen: Seen) -> str | None:
    """
    Every action weighed by the whole return, in episodes of more than one step.

    :param seen: What was seen
    """
    if not seen.model.reward_to_go and seen.updates[-1].n_steps > seen.updates[-1].n_episodes:
        return (
            "Every action is weighed with the total return, also with rewards from before it. Set reward_to_go=True: "
            "the gradient is the same and its variance lower"
        )
    return None


def spikes_without_clipping(seen: Seen) -> str | None:
    """
    A gradient ten times the usual one, and no bound on it.

    :param seen: What was seen
    """
    norms = [update.grad_norm for update in seen.updates]
    if seen.model.max_grad_norm is None and len(norms) >= 20 and norms[-1] > 10 * median(norms[:-1]) > 0:
        return (
            f"A gradient has norm {norms[-1]:.3g}, and the median is {median(norms[:-1]):.3g}: one such batch can undo "
            "what was learned. Set max_grad_norm, 0.5 for example"
        )
    return None


def useless_critic(seen: Seen) -> str | None:
    """
    A critic whose values explain none of the variance of the returns, after 100 updates and half of the training.

    Returns that vary by less than a tenth of their size, as those of a pole that never falls, leave little to explain.

    :param seen: What was seen
    """
    explained = [update.explained_variance for update in seen.updates if worth_explaining(update)]
    late = seen.n_updates >= 100 and seen.model._current_progress_remaining < 0.5
    if seen.model.has_critic and late and len(explained) >= 25 and median(explained) <= 0:
        return (
            f"The critic explains nothing of the returns: the median of train/explained_variance is "
            f"{median(explained):.2g}. Raise n_critic_updates={seen.model.n_critic_updates!r} or critic_learning_rate, "
            "scale the returns (VecNormalize), or use another baseline"
        )
    return None


def worth_explaining(update: Update) -> bool:
    """
    Whether there is a critic, and returns that vary.

    :param update: The update
    """
    return math.isfinite(update.explained_variance) and update.return_std > 0.1 * update.return_scale


def deterministic_too_early(seen: Seen) -> str | None:
    """
    Nothing left to draw from, before half of the training is over.

    :param seen: What was seen
    """
    left, share = seen.model._current_progress_remaining, randomness(seen.model.action_space, seen.updates[-1])
    if left > 0.5 and share < 0.05:
        remedy = "raise temperature"
        if isinstance(seen.model.action_space, spaces.Box):
            remedy = "raise min_std or log_std_init (for actions in the hundreds, scale them to [-1, 1])"
        return (
            f"With {left:.0%} of the training left the policy is all but deterministic ({share:.1%} of the randomness "
            f"that it could have), and its scores vanish. Raise ent_coef (now "
            f"{seen.model._scheduled('ent_coef'):.2g}), {remedy}, or lower learning_rate"
        )
    return None


def randomness(space: spaces.Space[Any], update: Update) -> float:
    """
    The entropy by the largest possible one, or for a Box the standard deviation by half of the mean width, at most 1.

    :param space: The action space
    :param update: The update
    :return: NaN where it is not known
    """
    if isinstance(space, spaces.Box):
        return min(1.0, update.std / float((space.high - space.low).mean() / 2))
    if isinstance(space, spaces.Discrete):
        largest = math.log(space.n)
    elif isinstance(space, spaces.MultiDiscrete):
        largest = float(np.log(space.nvec).sum())
    else:
        largest = math.log(2) * math.prod(space.shape or ())
    return update.entropy / largest if largest > 0 else float("nan")


def cut_episodes(seen: Seen) -> str | None:
    """
    More than a tenth of the steps left out, because ``n_steps`` cuts their episodes and there is no critic.

    :param seen: What was seen
    """
    share = fmean(update.used_fraction for update in seen.updates)
    if seen.model.n_steps is not None and not seen.model.has_critic and share < 0.9:
        return (
            f"n_steps={seen.model.n_steps} cuts episodes: {1 - share:.0%} of the steps are left out, those of long "
            "episodes first, which biases the gradient. Set n_episodes instead, or use baseline='value'"
        )
    return None


PITFALLS: dict[str, Pitfall] = {
    "rate_too_large": rate_too_large,
    "unscaled_returns": unscaled_returns,
    "too_few_episodes": too_few_episodes,
    "total_return": total_return,
    "spikes_without_clipping": spikes_without_clipping,
    "useless_critic": useless_critic,
    "deterministic_too_early": deterministic_too_early,
    "cut_episodes": cut_episodes,
}
