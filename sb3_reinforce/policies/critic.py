"""The critic: its values along a rollout, and its regression on the returns by an optimizer of its own."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.utils import obs_as_tensor
from torch.nn import functional as F

from sb3_reinforce.common import optimization
from sb3_reinforce.common.tensors import flatten, stack, take
from sb3_reinforce.estimation.returns import Floats
from sb3_reinforce.policies.backpropagation import activations, squared_error
from sb3_reinforce.policies.evaluation import Parameters, tells_values
from sb3_reinforce.policies.plain_mlp import critic_layers, overrides
from sb3_reinforce.sampling.collection import Ends


@th.no_grad()
def values_of(policy: ActorCriticPolicy, buffer: RolloutBuffer) -> np.ndarray:
    """
    V(s_t) in one batch, or as it was told along with the actions.

    :param policy: The policy
    :param buffer: The rollout buffer
    :return: Shape ``(n_steps, n_envs)``, float32
    """
    if tells_values(policy, with_critic=True):
        return buffer.values
    obs = flatten(obs_as_tensor(buffer.observations, policy.device))
    return value_function(policy)(obs).reshape(buffer.rewards.shape).cpu().numpy()


@th.no_grad()
def values_after(policy: ActorCriticPolicy, values: Floats, last_obs: Any, ends: Ends) -> Floats:
    """
    V of the state that follows each step: 0 after a terminal one, V(terminal observation) at a time limit.

    :param policy: The policy
    :param values: V(s_t), shape ``(n_steps, n_envs)``
    :param last_obs: The observations after the last step
    :param ends: How the episodes ended
    :return: Shape ``(n_steps, n_envs)``
    """

    value = value_function(policy)

    def predict(obs: Any) -> Floats:
        return value(obs_as_tensor(obs, policy.device)).flatten().cpu().numpy()

    following = np.where(ends.dones, 0.0, np.vstack([values[1:], predict(last_obs)]))
    if ends.terminal_obs:
        steps, envs = zip(*ends.terminal_obs, strict=True)
        following[steps, envs] = predict(stack(list(ends.terminal_obs.values())))
    return following


def value_function(policy: ActorCriticPolicy) -> Callable[[Any], th.Tensor]:
    """
    V as a function of ``n`` observations, of shape ``(n, 1)``: the policy's own, or a plain MLP's in less time. It is
    called where autograd records nothing.

    :param policy: The policy
    """
    layers = critic_layers(policy)
    return policy.predict_values if layers is None else lambda obs: activations(layers, obs.flatten(1).float())[-1]


def fit_critic(
    policy: ActorCriticPolicy,
    optimizer: th.optim.Optimizer,
    parameters: Parameters,
    obs: PyTorchObs,
    returns: th.Tensor,
    n_updates: int,
    batch_size: int,
    max_grad_norm: float | None,
) -> float:
    """
    Lower the mean of ``(G_t − V(s_t))²`` over the rollout, in minibatches drawn without replacement.

    :param policy: The policy
    :param optimizer: The critic's optimizer
    :param parameters: The parameters to change
    :param obs: ``n`` observations
    :param returns: G_t, shape ``(n,)``
    :param n_updates: Passes over the rollout
    :param batch_size: Size of a minibatch; the last one of a pass may be smaller
    :param max_grad_norm: Bound on the norm of a step's gradient, None for no bound
    :return: The mean of the minibatches' losses; 0 for a critic without parameters of its own
    :raises ValueError: If a gradient is not finite; the critic keeps the parameters of the step before. If a parameter
        is not finite afterwards; the critic keeps those before all passes
    """
    if not parameters:
        return 0.0
    losses = []
    inputs, error_and_gradients = regression(policy, parameters, obs)
    with optimization.kept_finite(optimizer, parameters, "critic"):
        for _ in range(n_updates):
            for batch in minibatches(len(returns), batch_size, returns.device):
                error, gradients = error_and_gradients(take(inputs, batch), returns[batch])
                optimization.step(optimizer, parameters, gradients, max_grad_norm, "critic")
                losses.append(error)
    return float(th.stack(losses).mean())


def minibatches(n: int, size: int, device: th.device) -> Sequence[th.Tensor | slice]:
    """
    The steps of each minibatch, drawn without replacement; all of them in one are not put into another order.

    :param n: Number of steps
    :param size: Size of a minibatch; the last one may be smaller
    :param device: Where the steps are
    """
    if size >= n:
        return [slice(None)]
    return th.randperm(n).to(device).split(size)  # type: ignore[no-untyped-call, no-any-return]


def regression(
    policy: ActorCriticPolicy, parameters: Parameters, obs: PyTorchObs
) -> tuple[PyTorchObs, Callable[[Any, th.Tensor], tuple[th.Tensor, Sequence[th.Tensor]]]]:
    """
    What a pass of the critic computes.

    :param policy: The policy
    :param parameters: The parameters that the critic's passes change
    :param obs: ``n`` observations
    :return: ``n`` inputs, and the mean squared error and its gradient as a function of any number of them and of as
        many returns
    """
    layers = critic_layers(policy)
    # A user's hook on a parameter is called by autograd
    if layers is not None and not any(parameter._backward_hooks for parameter in parameters):
        return obs.flatten(1).float(), partial(squared_error, layers, parameters)  # type: ignore[union-attr]
    inputs, value = what_learns(policy, parameters, obs)

    def by_autograd(inputs: Any, returns: th.Tensor) -> tuple[th.Tensor, Sequence[th.Tensor]]:
        error = F.mse_loss(value(inputs).flatten(), returns)
        return error.detach(), th.autograd.grad(error, parameters)

    return inputs, by_autograd


def what_learns(
    policy: ActorCriticPolicy, parameters: Parameters, obs: PyTorchObs
) -> tuple[PyTorchObs, Callable[[Any], th.Tensor]]:
    """
    The critic without a features extractor that its passes leave as it is: its features are the same in all of them.

    :param policy: The policy
    :param parameters: The parameters that the critic's passes change
    :param obs: ``n`` observations
    :return: ``n`` observations or features, and V as a function of as many of them as one likes
    """
    extractor, changed = policy.vf_features_extractor, {id(parameter) for parameter in parameters}
    # In training mode Dropout draws anew for each pass, and BatchNorm looks at each minibatch
    is_fixed = type(extractor) is FlattenExtractor or not extractor.training
    if overrides(policy, "predict_values") or not is_fixed or not changed.isdisjoint(map(id, extractor.parameters())):
        return obs, policy.predict_values
    with th.no_grad():
        features = BasePolicy.extract_features(policy, obs, extractor)
    return features, lambda features: policy.value_net(policy.mlp_extractor.forward_critic(features))
