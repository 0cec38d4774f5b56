"""
What is asked of an actor-critic policy: log π(a|s), the entropy, V(s), which parameters these depend on, and the
temperature. A method that a user has overridden is called as it is; ``calls`` says which methods are called.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias, cast

import torch as th
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_reinforce.common.tensors import take
from sb3_reinforce.policies.plain_mlp import (
    DivideLogits,
    hooks_of,
    overrides,
    takes_vectors,
    temperature_hook,
)
from sb3_reinforce.policies.sequences import RecurrentPolicy

Parameters: TypeAlias = list[nn.Parameter]

# The fewest steps for an estimate
MIN_STEPS = 64
# At this temperature the logits of float32 networks put all probability on one action
MIN_TEMPERATURE = 1e-3


def calls(policy: ActorCriticPolicy, method: str, with_values: bool = False) -> bool:
    """
    Whether a method, ``forward`` or ``evaluate_actions``, is called instead of ``get_distribution`` (and, with values,
    ``predict_values``).

    True if these would bypass a user's code or hooks. With values also where one call saves a pass through an extractor
    with parameters that actor and critic share, unless one of these is overridden. False for a recurrent policy, which
    has other methods.
    """
    if isinstance(policy, RecurrentPolicy):
        return False
    extractor = policy.features_extractor
    # A user may have replaced one of the three
    is_shared = extractor is policy.pi_features_extractor is policy.vf_features_extractor
    saves_work = with_values and is_shared and bool(list(extractor.parameters()))
    at_once = saves_work and not overrides(policy, "predict_values", "get_distribution")
    return at_once or must_call(policy, method)


def must_call(policy: ActorCriticPolicy, method: str) -> bool:
    """Whether ``get_distribution`` and ``predict_values`` would bypass a user's code or hooks that a method calls."""
    if overrides(policy, method, "extract_features") or hooks_of(policy):
        return True
    mlp = getattr(policy, "mlp_extractor", None)
    return isinstance(mlp, nn.Module) and (bool(hooks_of(mlp)) or "forward" in vars(mlp))


def extract_features(policy: ActorCriticPolicy, obs: PyTorchObs, extractor: nn.Module) -> th.Tensor:
    """The features of ``n`` observations by one of the policy's extractors, shape ``(n, features_dim)``."""
    if isinstance(obs, th.Tensor) and takes_vectors(policy, extractor):
        # The result of the line below, at a tenth of the cost
        return obs.flatten(1).float()
    return BasePolicy.extract_features(policy, obs, extractor)  # type: ignore[arg-type]


@contextmanager
def evaluation_mode(policy: BasePolicy) -> Iterator[None]:
    """Put a policy in evaluation mode in the block; restore its mode."""
    training = policy.training
    policy.set_training_mode(False)
    try:
        yield
    finally:
        policy.set_training_mode(training)


def distribution_of(policy: ActorCriticPolicy, outputs: th.Tensor) -> Distribution:
    """π(·|s) for logits or means of shape ``(n, width)``."""
    kind = policy.action_dist
    if isinstance(kind, DiagGaussianDistribution):
        return kind.proba_distribution(outputs, policy.log_std)
    return kind.proba_distribution(outputs)


def action_distribution(policy: ActorCriticPolicy, obs: Any) -> Distribution:
    """π(·|s) for a batch of observations, or for the rows of sequences if the policy is recurrent."""
    return policy.sequence_distribution(obs) if isinstance(policy, RecurrentPolicy) else policy.get_distribution(obs)


def evaluate(
    policy: ActorCriticPolicy, obs: Any, actions: th.Tensor, with_values: bool = False
) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
    """
    log π(a|s), the entropy of π(·|s), and V(s) or None, each of shape ``(n,)``.

    An entropy without closed form (squashed Gaussian) is estimated, its gradient by the likelihood ratio.
    """
    values: th.Tensor | None = None
    if calls(policy, "evaluate_actions", with_values):
        values, log_prob, entropy = policy.evaluate_actions(obs, actions)
        if entropy is not None and entropy.dim() == 0:
            # A user's method may return the mean, which is all that A2C takes of it
            entropy = entropy.expand_as(log_prob)
    else:
        distribution = action_distribution(policy, obs)
        log_prob = distribution.log_prob(actions)
        entropy = distribution.entropy()
        if with_values:
            values = policy.sequence_values(obs) if isinstance(policy, RecurrentPolicy) else policy.predict_values(obs)
    if log_prob.dim() != 1:
        raise ValueError(
            f"log π of {type(policy).__name__} must have shape (n,), got {tuple(log_prob.shape)}: sum it over the "
            "dimensions of the action"
        )
    if entropy is None:
        # H = −E[log π], ∇H = −E[log π ∇ log π]
        constant = log_prob.detach()
        entropy = -constant * (1 + log_prob - constant)
    return log_prob, entropy, None if values is None else values.flatten()


def log_prob_of(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> th.Tensor:
    """log π(a|s), shape ``(n,)``; the critic is evaluated only where ``evaluate_actions`` is called."""
    return evaluate(policy, obs, actions)[0]


def sampled_divergence(policy: ActorCriticPolicy, obs: Any, actions: th.Tensor, old: th.Tensor) -> float:
    """
    The mean of KL(π_old ‖ π), estimated by ``r − 1 − log r`` with ``r = π(a|s) / π_old(a|s)`` for actions of π_old.

    Schulman (2020), "Approximating KL Divergence", k₃: never negative, and unbiased for a π that was not trained on
    these actions. NaN if π's outputs are.
    """
    try:
        log_ratio = acting_log_prob(policy, obs, actions) - old
    except ValueError:
        # PyTorch makes no distribution of outputs that are not finite; the next rollout reports them
        return math.nan
    return float((th.expm1(log_ratio) - log_ratio).mean())


def some_steps(policy: ActorCriticPolicy, obs: Any, actions: th.Tensor) -> tuple[Any, th.Tensor]:
    """An eighth of the steps, at least 64, for an estimate; for a recurrent policy all, since sequences stay whole."""
    if isinstance(policy, RecurrentPolicy):
        return obs, actions
    # The same places in each rollout of this length: the policy's random numbers are left alone
    order = th.randperm(len(actions), generator=th.Generator().manual_seed(0))
    steps = order[: max(MIN_STEPS, len(actions) // 8)].to(actions.device)
    return take(obs, steps), actions[steps]


def acting_log_prob(policy: ActorCriticPolicy, obs: Any, actions: th.Tensor) -> th.Tensor:
    """log π(a|s) of the policy that acts, which is in evaluation mode."""
    # A user's evaluate_actions may differentiate
    with th.set_grad_enabled(calls(policy, "evaluate_actions") and overrides(policy, "evaluate_actions")):
        return log_prob_of(policy, obs, actions).detach()


def leave_no_graph(policy: ActorCriticPolicy, obs: Any, actions: th.Tensor) -> None:
    """Evaluate a policy without a graph: it keeps its last distribution, which could not be deep-copied with one."""
    acting_log_prob(policy, obs, actions)


def trainable(policy: ActorCriticPolicy) -> Parameters:
    """The parameters that are trained, which are those that the policy's optimizer holds, in the policy's order."""
    held = {parameter for group in policy.optimizer.param_groups for parameter in group["params"]}
    return [parameter for parameter in policy.parameters() if parameter.requires_grad and parameter in held]


def actor_parameters(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> Parameters:
    """The trainable parameters that log π depends on, in the policy's order."""
    return reached_by(lambda: log_prob_of(policy, obs, actions), trainable(policy))


def critic_parameters(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor) -> Parameters:
    """The trainable parameters that V depends on, in the policy's order."""
    return reached_by(lambda: cast(th.Tensor, evaluate(policy, obs, actions, True)[2]), trainable(policy))


def reached_by(compute: Callable[[], th.Tensor], parameters: Parameters) -> Parameters:
    """The parameters that an output depends on."""
    # A compiled network has gradients of 0 instead of None
    with th.compiler.set_stance("force_eager"):
        output = compute()
        if not (parameters and output.requires_grad):
            return []
        gradients = th.autograd.grad(output.sum(), parameters, allow_unused=True)
    return [p for p, gradient in zip(parameters, gradients, strict=True) if gradient is not None]


def temperature_of(policy: ActorCriticPolicy) -> float:
    """The temperature at which a policy acts."""
    layer = getattr(policy, "action_net", None)
    hook = None if layer is None else temperature_hook(layer)
    return 1.0 if hook is None else float(hook.temperature)


def set_temperature(policy: ActorCriticPolicy, temperature: float) -> None:
    """
    Let the policy act and be evaluated at temperature max(τ, 1e-3): a schedule may fall to 0.

    ``policy.save`` does not keep it, ``model.save`` does.
    """
    layer = getattr(policy, "action_net", None)
    hook = None if layer is None else temperature_hook(layer)
    if hook is None:
        if temperature == 1:
            return
        if layer is None:
            raise ValueError(f"temperature needs a policy with an action_net, and {type(policy).__name__} has none")
        hook = DivideLogits(th.ones((), dtype=th.float32, device=policy.device))
        layer.register_forward_hook(hook)
    # The policy may have been moved since
    hook.temperature = hook.temperature.to(policy.device).fill_(max(temperature, MIN_TEMPERATURE))


@th.no_grad()
def floor_std(policy: ActorCriticPolicy, min_std: float) -> None:
    """``log_std ← max(log_std, log min_std)``: project the standard deviations to at least ``min_std``."""
    if min_std > 0:
        if not hasattr(policy, "log_std"):
            raise ValueError(f"min_std needs a policy with a log_std, and {type(policy).__name__} has none")
        if min_std > 1 and getattr(policy.action_dist, "use_expln", False):
            raise ValueError(f"min_std must be at most 1 with use_expln=True, got {min_std}")
        policy.log_std.clamp_(min=math.log(min_std))
