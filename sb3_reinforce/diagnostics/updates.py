"""What training knows of its updates, for whoever watches it."""

from dataclasses import dataclass

import torch as th

from sb3_reinforce.reinforce import REINFORCE


@dataclass(frozen=True)
class Update:
    """
    What training knew of one update.

    :param kl: The mean of log π_old − log π_new over steps of the rollout, how far the policy moved
    :param entropy: Mean entropy of the policy; NaN where it is not known
    :param std: Mean standard deviation of the actions of a Gaussian policy; NaN for other policies
    :param grad_norm: Norm of the gradient before clipping
    :param explained_variance: Of the critic; NaN without one
    :param gradient: Some components of the gradient, shape ``(c,)``
    :param return_scale: Root mean square of the returns
    :param return_std: Standard deviation of the returns
    :param n_episodes: Episodes in the rollout, parts of episodes too
    :param n_steps: Steps used
    :param used_fraction: Share of the steps that were used
    """

    kl: float
    entropy: float
    std: float
    grad_norm: float
    explained_variance: float
    gradient: th.Tensor
    return_scale: float
    return_std: float
    n_episodes: int
    n_steps: int
    used_fraction: float


@dataclass(frozen=True)
class Seen:
    """
    What a pitfall is detected from.

    :param model: The model
    :param updates: The last updates, at most 50
    :param n_updates: All updates so far
    """

    model: REINFORCE
    updates: list[Update]
    n_updates: int
