"""
Plain MLPs: which actors are known to be one, and their forward pass without the overhead of modules.

A network is plain only if everything on the way from the observation to its output is an unchanged object of
Stable-Baselines3 or PyTorch. A hook, a replaced method or a class of the user makes it general, and then the policy
itself is called. (Hooks that PyTorch registers for all modules at once are not looked for.)
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.distributions import (
    BernoulliDistribution,
    CategoricalDistribution,
    DiagGaussianDistribution,
    MultiCategoricalDistribution,
)
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor, MlpExtractor
from torch import nn

Float32s: TypeAlias = NDArray[np.float32]

DISTRIBUTIONS = (BernoulliDistribution, CategoricalDistribution, DiagGaussianDistribution, MultiCategoricalDistribution)
ELEMENTWISE = (
    nn.Tanh, nn.ReLU, nn.Identity, nn.ELU, nn.SELU, nn.CELU, nn.SiLU, nn.GELU, nn.Mish, nn.Sigmoid, nn.LogSigmoid,
    nn.LeakyReLU, nn.ReLU6, nn.Softplus, nn.Softsign, nn.Hardtanh, nn.Hardswish, nn.Hardsigmoid, nn.Tanhshrink,
)  # fmt: skip
# The activations that NumPy computes, each in place
IN_PLACE: dict[type[nn.Module], Callable[[Float32s], Float32s]] = {
    nn.Tanh: lambda x: np.tanh(x, out=x),
    nn.ReLU: lambda x: np.maximum(x, 0, out=x),
}
# What a subclass of ActorCriticPolicy may override and still act as one: these methods only build its networks
CONSTRUCTION = {"__init__", "_build", "_build_mlp_extractor", "_get_constructor_parameters", "make_features_extractor"}
# The dicts in which a module keeps its hooks, by the name that PyTorch gives them
HOOKS = tuple(name for name in vars(nn.Identity()) if name.endswith("_hooks"))
# Multiplications beyond which NumPy's BLAS starts threads, whatever number the user has set for PyTorch
ONE_THREAD = 2**18


class DivideLogits:
    """``π(a|s) ∝ exp(logits(s, a) / τ)``: a forward hook of the layer that computes the logits."""

    def __init__(self, temperature: th.Tensor):
        self.temperature = temperature

    def __call__(self, module: nn.Module, inputs: Any, logits: th.Tensor) -> th.Tensor:
        """``logits / τ``."""
        # The policy may have been moved since
        return logits / self.temperature.to(logits.device)


def hooks_of(module: nn.Module) -> list[Any]:
    """All hooks that are registered on a module."""
    attributes = vars(module)
    return [hook for name in HOOKS for hook in attributes[name].values()]


def temperature_hook(module: nn.Module) -> DivideLogits | None:
    """The hook that holds the temperature of a layer, if it has one."""
    return next((hook for hook in hooks_of(module) if isinstance(hook, DivideLogits)), None)


@lru_cache
def methods_of(cls: Any) -> frozenset[str]:
    """The names of all methods of a class."""
    return frozenset(name for name in dir(cls) if callable(getattr(cls, name, None)))


def own_methods(cls: type, base: type) -> frozenset[str]:
    """The methods of ``base`` that a class overrides; all of them if it is not a subclass, like a compiled one."""
    if base not in cls.__mro__:
        return methods_of(base)
    subclasses = cls.__mro__[: cls.__mro__.index(base)]
    return methods_of(base) & {name for subclass in subclasses for name in vars(subclass)}


def overrides(policy: ActorCriticPolicy, *methods: str) -> bool:
    """Whether the class of a policy, or the instance, has its own version of one of these methods."""
    return not own_methods(type(policy), ActorCriticPolicy).union(vars(policy)).isdisjoint(methods)


def is_unchanged(thing: Any) -> bool:
    """Whether an instance has no replaced method, and no hook but the temperature's."""
    cls: Any = type(thing)
    hooks = hooks_of(thing) if isinstance(thing, nn.Module) else []
    return methods_of(cls).isdisjoint(vars(thing)) and all(isinstance(hook, DivideLogits) for hook in hooks)


def plain_actor(policy: ActorCriticPolicy, base: type[ActorCriticPolicy] = ActorCriticPolicy) -> list[nn.Module] | None:
    """
    The layers from the features to the logits or means of a policy whose actor is known to be plain, else None.

    They are ``Linear`` layers with a bias and elementwise activations, and the features are the flattened observations.
    A class that overrides methods of ``base`` is not known to be plain.
    """
    distribution = getattr(policy, "action_dist", None)
    if type(distribution) not in DISTRIBUTIONS or not is_unchanged(distribution):
        return None
    # A user's policy may lack any of these parts
    mlp = getattr(policy, "mlp_extractor", None)
    if own_methods(type(policy), base) - CONSTRUCTION or type(mlp) is not MlpExtractor:
        return None
    body = mlp.policy_net
    if type(body) is not nn.Sequential or not is_plain_extractor(getattr(policy, "pi_features_extractor", None)):
        return None
    layers = [*body, getattr(policy, "action_net", None)]
    is_plain = all(map(is_plain_layer, layers)) and all(map(is_unchanged, (policy, mlp, body, *layers)))
    return layers if is_plain else None


def is_plain_extractor(extractor: Any) -> bool:
    """Whether a features extractor only flattens observations."""
    if type(extractor) not in (FlattenExtractor, CombinedExtractor):
        return False
    parts = (type(extractor), nn.ModuleDict, nn.Flatten)
    return all(type(part) in parts and is_unchanged(part) for part in extractor.modules())


def is_plain_layer(layer: Any) -> bool:
    """Whether a layer is linear with a bias, or an elementwise activation that does not overwrite its input."""
    if getattr(layer, "inplace", False):
        return False
    return type(layer) in ELEMENTWISE or (type(layer) is nn.Linear and layer.bias is not None)


def takes_vectors(policy: ActorCriticPolicy, extractor: nn.Module) -> bool:
    """Whether the features of a policy are known to be its observations, flattened."""
    space = policy.observation_space
    is_flat = isinstance(space, spaces.Box) and not is_image_space(space) and type(extractor) is FlattenExtractor
    return is_flat and is_plain_extractor(extractor)


def numpy_layers(
    policy: ActorCriticPolicy, base: type[ActorCriticPolicy] = ActorCriticPolicy
) -> list[nn.Module] | None:
    """The layers of a plain actor that ``numpy_forward`` can compute, else None."""
    layers = plain_actor(policy, base)
    if layers is None or not has_numpy_form(layers) or not takes_vectors(policy, policy.pi_features_extractor):
        return None
    return layers


def has_numpy_form(layers: list[nn.Module]) -> bool:
    """Whether ``numpy_forward`` can compute these layers: tanh and ReLU after linear ones, in float32 on a CPU."""
    if not isinstance(layers[0], nn.Linear) or not all(type(layer) in (nn.Linear, *IN_PLACE) for layer in layers):
        return False
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    return all(parameter.dtype is th.float32 and parameter.device.type == "cpu" for parameter in parameters)


def numpy_forward(layers: list[nn.Module], n: int) -> Callable[[np.ndarray], Float32s]:
    """
    Plain layers as one function from ``n`` observations to outputs of shape ``(n, n_out)``.

    For a handful of observations modules take far longer than the arithmetic. Weights are views of the parameters, so
    that changes in place count at once. The next call may overwrite the result.
    """
    operations = [
        linear_operation(layer.weight, layer.bias, n) if isinstance(layer, nn.Linear) else IN_PLACE[type(layer)]
        for layer in layers
    ]
    hook = temperature_hook(layers[-1])

    # As PyTorch, without warnings: some BLAS kernels read beyond the end of an array and flag what they find there
    @np.errstate(all="ignore")
    def outputs(obs: np.ndarray) -> Float32s:
        x: Float32s = obs.reshape(n, -1).astype(np.float32, copy=False)
        for operation in operations:
            x = operation(x)
        return x if hook is None else x / np.float32(float(hook.temperature))

    return outputs


def linear_operation(weight: th.Tensor, bias: th.Tensor, n: int) -> Callable[[Float32s], Float32s]:
    """``x Wᵀ + b`` as a function of x of shape ``(n, n_in)``, written to memory that is used again at each call."""
    weight = weight.detach()
    bias = bias.detach()
    transposed = weight.numpy().T
    addend = bias.numpy()
    y = np.empty((n, len(weight)), dtype=np.float32)

    def by_numpy(x: Float32s) -> Float32s:
        np.dot(x, transposed, y)
        np.add(y, addend, y)
        return y

    def by_torch(x: Float32s) -> Float32s:
        th.addmm(bias, th.from_numpy(x), weight.T, out=th.from_numpy(y))
        return y

    return by_torch if n * weight.numel() > ONE_THREAD else by_numpy
