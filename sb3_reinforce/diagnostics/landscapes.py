"""The performance landscape: U(θ) on a plane through a policy's parameters, and gradients projected on it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce.common.arguments import check_integer, check_kind, check_number
from sb3_reinforce.diagnostics.sampling import env_of, episode_bar, seeded
from sb3_reinforce.diagnostics.statistics import check_directions
from sb3_reinforce.estimation.estimators import check_candidates
from sb3_reinforce.policies.evaluation import evaluation_mode
from sb3_reinforce.policies.parameters import read, searched_parameters
from sb3_reinforce.sampling.candidate_actors import make_candidate_actor
from sb3_reinforce.sampling.candidates import CandidateStep, evaluate_candidates, seeds_of
from sb3_reinforce.sampling.measurement import undisturbed


class CandidateUtility:
    """
    ``U(θ) = E[Σ_t r_t]`` of parameter vectors: the mean return of episodes in a model's environments.

    The policy samples its actions, so this is the utility whose gradient REINFORCE estimates at γ = 1. With gSDE each
    step has new noise, as with ``sde_sample_freq=1``. Candidates share their seeds as in FiniteDifference; every call
    uses new ones.

    Call it with candidates of shape ``(k, n)`` or ``(m, k, n)``. It returns their utilities, ``(k,)`` or ``(m, k)``,
    float64. ``theta`` has the model's own parameters, ``(n,)``. Rewards are not scaled by VecNormalize. Each call
    leaves the environments at the start of an episode, with new seeds from NumPy's global generator.

    :param model: A model with an actor-critic policy and environments
    :param n_episodes: Episodes per utility
    :param seed: Seed of the environments. PyTorch's global generator draws the actions: call ``th.manual_seed`` to
        repeat them
    :raises TypeError: If the model has no actor-critic policy
    :raises ValueError: If it has no environments, its policy has a memory or nothing to train, or a number is out of
        its range
    """

    def __init__(self, model: BaseAlgorithm, n_episodes: int, seed: int):
        if not isinstance(getattr(model, "policy", None), ActorCriticPolicy):
            raise TypeError(f"model must have an actor-critic policy, got {model!r} of type {type(model).__name__}")
        self.model = model
        self.env = env_of(model)
        self.n_episodes = check_integer("n_episodes", n_episodes, 1)
        # Were it the first seed, neighboring seeds would share nearly all of their episodes
        self.seed = int(np.random.default_rng(check_integer("seed", seed, 0)).integers(2**31))
        self.n_steps = 0
        #: A bar of tqdm that counts episodes, or None
        self.bar: Any = None
        self.policy = cast(ActorCriticPolicy, model.policy)
        self.parameters = searched_parameters(self.policy)
        self.theta = read(self.parameters)

    def __call__(self, thetas: th.Tensor) -> th.Tensor:
        """
        Evaluate candidates.

        :param thetas: Shape ``(k, n)``, or ``(m, k, n)``
        :return: Their utilities, shape ``(k,)`` or ``(m, k)``, float64
        :raises ValueError: If the shape is another, a number is not finite, or an episode does not end
        """
        candidates = check_candidates("thetas must be", thetas, len(self.theta)).reshape(-1, len(self.theta))
        seeds = seeds_of(thetas.shape, self.n_episodes, self.seed)
        self.seed = int(seeds[-1, -1]) + 1
        limit = getattr(self.model, "max_episode_steps", 100_000)
        actor = make_candidate_actor(self.policy, self.parameters, self.env.num_envs, deterministic=False)
        with undisturbed(self.model), evaluation_mode(self.policy):
            returns = evaluate_candidates(actor, self.env, candidates, seeds, self.n_episodes, limit, self._count)
        return th.as_tensor(returns).mean(1).reshape(thetas.shape[:-1])

    def _count(self, step: CandidateStep) -> None:
        """Count the steps of all environments, including idle ones."""
        self.n_steps += len(step.dones)
        if self.bar is not None:
            self.bar.update(int(np.count_nonzero(step.finished)))


@dataclass(frozen=True)
class Landscape:
    """
    ``U(θ + x d_1 + y d_2)`` on a grid.

    :param scales: The values of x and of y, shape ``(s,)``
    :param utilities: Shape ``(s, s)``: rows are y, columns are x
    :param steps: By name, the projection (x, y) of each gradient on the plane, scaled to the length of the largest
        scale; shape ``(2,)``, or ``(m, 2)`` for m gradients
    :param n_episodes: Episodes per point
    """

    scales: np.ndarray
    utilities: np.ndarray
    steps: dict[str, np.ndarray]
    n_episodes: int

    def __str__(self) -> str:
        span = f"{self.utilities.min():.4g} to {self.utilities.max():.4g}"
        points = f"{len(self.scales)} x {len(self.scales)} points"
        return f"Utilities from {span} at {points}, {self.n_episodes} episodes each; plot_landscape draws them"


def landscape(
    model: BaseAlgorithm,
    gradients: Mapping[str, th.Tensor] | None = None,
    directions: th.Tensor | None = None,
    extent: float = 1.0,
    n_points: int = 11,
    n_episodes: int = 5,
    seed: int = 0,
    progress_bar: bool = False,
) -> Landscape:
    """
    Evaluate the utility on a plane through θ.

    :param model: A model with an actor-critic policy; it is not changed. The environments are reset and get new seeds,
        so A2C and PPO must not be measured in ``on_step``, and cannot continue their ``learn`` after a measurement that
        failed
    :param gradients: Gradients to draw, by name, for the actor's parameters without ``log_std``: each of shape
        ``(n,)``, or ``(m, n)`` for several estimates of one gradient
    :param directions: Two directions of shape ``(2, n)``, which are scaled to the norm of θ; None for two random ones,
        normalized filter by filter (Li et al., 2018, section 4)
    :param extent: Half the width of the plane, in multiples of the directions
    :param n_points: Points along each side, at least 2
    :param n_episodes: Episodes per point
    :param seed: Seed of the directions and of the episodes
    :param progress_bar: Display a bar of tqdm that counts the episodes
    :return: The utilities on the plane, and the projections of the gradients
    :raises TypeError: If an argument is of the wrong kind
    :raises ValueError: If an argument is out of its range or of the wrong shape, all of the actor's parameters are 0,
        the model has no environment or is collecting a rollout, the policy has a memory, or the environments cannot be
        seeded one by one
    """
    check_number("extent", extent, 0, above=True)
    check_integer("n_points", n_points, 2)
    seed = check_integer("seed", seed, 0)
    utility = CandidateUtility(model, n_episodes, seed)
    n = len(utility.theta)
    if not utility.theta.any():
        raise ValueError("model's actor parameters are all 0, and landscape scales its directions to their norm")
    gradients = {} if gradients is None else gradients
    check_kind("gradients", gradients, (Mapping,), "a dictionary of tensors by name")
    if directions is None:
        drawn = th.randn(2, n, dtype=th.float64, generator=th.Generator().manual_seed(seed))
        plane = th.stack([filter_normalized(direction, utility.parameters) for direction in drawn])
    else:
        directions = check_directions("directions", directions, (2, n))
        plane = directions / directions.norm(dim=1, keepdim=True) * utility.theta.norm()
    steps = {}
    for name, given in gradients.items():
        shape = (len(given), n) if isinstance(given, th.Tensor) and given.dim() == 2 else (n,)
        gradient = check_directions(f"gradients[{name!r}]", given, shape)
        steps[name] = extent * projected(gradient, plane)
    scales = th.linspace(-extent, extent, n_points, dtype=th.float64)
    grid = th.stack(th.meshgrid(scales, scales, indexing="xy"), dim=-1).reshape(-1, 2)
    episodes = episode_bar(progress_bar, n_episodes * len(grid))
    with seeded(cast(ActorCriticPolicy, model.policy), seed), episodes as bar:
        utility.bar = bar
        utilities = utility(utility.theta + grid @ plane).reshape(n_points, n_points)
    return Landscape(scales.numpy(), utilities.numpy(), steps, n_episodes)


def projected(gradients: th.Tensor, plane: th.Tensor) -> np.ndarray:
    """The projections of gradients ``(..., n)`` on a plane (2, n), as (x, y) of length 1, shape ``(..., 2)``."""
    flat = gradients.reshape(-1, plane.shape[1])
    found = th.linalg.lstsq(plane.T, flat.T).solution.T.reshape(*gradients.shape[:-1], 2)
    directions: np.ndarray = (found / found.norm(dim=-1, keepdim=True).clamp(min=1e-300)).numpy()
    return directions


def filter_normalized(direction: th.Tensor, like: Sequence[th.Tensor]) -> th.Tensor:
    """
    ``d_f ← d_f ‖θ_f‖ / ‖d_f‖`` (n,) for each filter f, a row of a weight matrix or a whole bias (Li et al., 2018).

    Without it, the scale of a layer, which a later layer can undo, would determine how steep the landscape looks.
    """
    parts = th.split(direction, [parameter.numel() for parameter in like])
    scaled = []
    for d, parameter in zip(parts, like, strict=True):
        n_filters = len(parameter) if parameter.dim() > 1 else 1
        d = d.reshape(n_filters, -1)
        filters = parameter.detach().cpu().double().reshape(n_filters, -1)
        scaled.append((d / d.norm(dim=1, keepdim=True) * filters.norm(dim=1, keepdim=True)).flatten())
    return th.cat(scaled)
