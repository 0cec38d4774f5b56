"""
The natural policy gradient: the direction F⁻¹ g, scaled to a given divergence from the policy that has acted.

F is the Fisher information of the policy at the states of the rollout (Kakade, 2001, "A Natural Policy Gradient";
Peters and Schaal, 2008, section 4).
"""

import copy
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any

import torch as th
from stable_baselines3.common.distributions import kl_divergence
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.nn.attention import SDPBackend, sdpa_kernel

from sb3_reinforce.common.optimization import finite_norm
from sb3_reinforce.common.tensors import to_vector
from sb3_reinforce.policies.evaluation import Parameters, action_distribution
from sb3_reinforce.policies.parameters import write

DEFAULT_TARGET_KL = 0.01
# The damping c of SB3-Contrib's TRPO where actions have one dimension, and the number of iterations of Schulman et al.
# (2015, appendix C)
DAMPING = 0.1
N_ITERATIONS = 10
# A step whose measured divergence exceeds the target by this factor is shortened, by half at most
TOLERANCE = 1.2
MAX_REDUCTIONS = 20
# The residual, relative to b, at which a system is solved
PRECISION = 1e-10


@contextmanager
def twice_differentiable() -> Iterator[None]:
    """Without cuDNN, fused attention and compiled networks, which PyTorch cannot differentiate twice."""
    with th.backends.cudnn.flags(enabled=False), sdpa_kernel(SDPBackend.MATH), th.compiler.set_stance("force_eager"):
        yield


@twice_differentiable()
def natural_step(
    policy: ActorCriticPolicy,
    obs: Any,
    parameters: Parameters,
    gradients: Sequence[th.Tensor | None],
    target_kl: float,
) -> tuple[float, float]:
    """
    ``θ ← θ − α d`` with ``(F + c I) d = g / ‖g‖`` and ``α² dᵀ F d / 2 = target_kl``, for the gradient g of the loss;
    returns ‖g‖ and the mean divergence.

    The parameters stay as they are, with a warning, where no such step is found.
    """
    parameters = [each for each, gradient in zip(parameters, gradients, strict=True) if gradient is not None]
    if not parameters:
        return 0.0, 0.0
    g = to_vector(gradients)
    norm = finite_norm(g, "policy", "scaled rewards (VecNormalize)")
    # A schedule may fall to a target of 0
    if norm == 0 or target_kl == 0:
        return norm, 0.0
    divergence = divergence_from_now(policy, obs)
    fisher_product = hessian_vector_product(divergence(), parameters)
    # α undoes the scale of g
    d = conjugate_gradients(lambda v: fisher_product(v) + DAMPING * v, g / norm)
    curvature = float(d @ fisher_product(d))
    kl = None
    if 0 < curvature < math.inf:
        kl = line_search(parameters, d, math.sqrt(2 * target_kl / curvature), divergence, target_kl)
    if kl is None:
        # Leaves no graph in the policy, which could not be deep-copied with one
        measured(divergence)
        warnings.warn(
            "The natural step is left out, and the parameters are unchanged: no step with a KL divergence of about "
            f"target_kl={target_kl:.2g} was found. Usually the policy is almost deterministic: raise ent_coef, and "
            "temperature (discrete actions) or min_std (Box actions)",
            # The decorator is a level
            stacklevel=3,
        )
        return norm, 0.0
    return norm, kl


@th.no_grad()
def check_distribution(policy: ActorCriticPolicy, obs: Any, actions: th.Tensor, log_prob: th.Tensor) -> None:
    """Refuse a distribution without a known KL, or with another log π in evaluation mode than the one in training."""
    distribution = action_distribution(policy, obs)
    try:
        kl_divergence(distribution, distribution)
    except (AssertionError, AttributeError, NotImplementedError) as error:
        raise ValueError(
            f"step='natural' needs a KL divergence that PyTorch knows, and {type(distribution).__name__} of "
            f"{type(policy).__name__} has none: use step='optimizer'"
        ) from error
    own = distribution.log_prob(actions)
    if not th.allclose(own, log_prob, rtol=1e-3, atol=1e-4):
        raise ValueError(
            f"step='natural' needs the distribution of the actions, and get_distribution of {type(policy).__name__} "
            "does not give the log π that it learns from (dropout, batch normalization, or overridden methods): use "
            "step='optimizer'"
        )


def divergence_from_now(policy: ActorCriticPolicy, obs: Any) -> Callable[[], th.Tensor]:
    """A function that returns the mean of KL(π_now(·|s) ‖ π(·|s)) over the observations."""
    with th.no_grad():
        # A copy, since the policy has one distribution object, which each evaluation fills
        now: Any = copy.copy(action_distribution(policy, obs))

    def divergence() -> th.Tensor:
        kl = kl_divergence(now, action_distribution(policy, obs))
        return kl.sum() / len(kl)

    return divergence


def hessian_vector_product(output: th.Tensor, parameters: Parameters) -> Callable[[th.Tensor], th.Tensor]:
    """``v ↦ H v`` for the Hessian H of an output (Pearlmutter, 1994); 0 for parameters that it does not depend on."""
    gradients = th.autograd.grad(output, parameters, create_graph=True, materialize_grads=True)
    gradient = th.cat([each.flatten() for each in gradients])
    return lambda v: to_vector(th.autograd.grad(gradient @ v, parameters, retain_graph=True, materialize_grads=True))


def conjugate_gradients(product: Callable[[th.Tensor], th.Tensor], b: th.Tensor) -> th.Tensor:
    """x with ``A x ≈ b`` for a positive definite A (Hestenes and Stiefel, 1952), or 0 if A is found not to be."""
    x = th.zeros_like(b)
    residual = b
    direction = b
    square = b @ b
    for _ in range(N_ITERATIONS):
        if square <= PRECISION**2 * (b @ b):
            break
        # Step rᵀr / dᵀAd along d; then r ← r − step · A d, and d ← r + (rᵀr after / rᵀr before) d
        image = product(direction)
        step = square / (direction @ image)
        if not 0 < step < math.inf:
            return th.zeros_like(b)
        x = x + step * direction
        residual = residual - step * image
        next_square = residual @ residual
        direction = residual + next_square / square * direction
        square = next_square
    return x


def line_search(
    parameters: Parameters, d: th.Tensor, length: float, divergence: Callable[[], th.Tensor], target_kl: float
) -> float | None:
    """Step to ``θ − length · d``, shortened until KL is at most 1.2 times the target; return KL, or None."""
    before = to_vector(parameters)
    with ExitStack() as undo:
        undo.callback(write, parameters, before)
        for _ in range(MAX_REDUCTIONS):
            write(parameters, before - length * d)
            kl = measured(divergence)
            if kl <= TOLERANCE * target_kl:
                undo.pop_all()
                return max(kl, 0.0)
            # The divergence is about quadratic in the length
            length *= max(0.5, math.sqrt(target_kl / kl))
    return None


@th.no_grad()
def measured(divergence: Callable[[], th.Tensor]) -> float:
    """The divergence, or ∞ where it is not a number."""
    try:
        kl = float(divergence())
    except ValueError:
        # PyTorch makes no distribution of outputs that are not finite
        return math.inf
    return math.inf if math.isnan(kl) else kl
