"""
Plain MLPs for many observations, forwards and backwards.

The chain rule is written out (Rumelhart, Hinton and Williams, 1986): for a layer ``y = f(x)`` and a loss L, δ = ∂L/∂y
becomes ∂L/∂x = δ ∂f/∂x, from the last layer to the first. Through modules and autograd, a critic's gradient takes 1.5
to 1.9 times as long with tanh, which PyTorch's own makes slow on a CPU, and 1.2 to 1.4 times with ReLU
(``examples/benchmarks/mlp_passes.py``: 64 to 2048 observations, medians of 500 rounds).

Layers are ``Linear``, ``Tanh`` and ``ReLU``, as ``layers`` finds them, which share no parameter. A temperature is none
of them: it divides what the last puts out. But for ``through`` and ``divided``, autograd must not record what is done.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from torch.nn import functional as F


def activations(layers: list[th.nn.Module], x: th.Tensor) -> list[th.Tensor]:
    """
    The input and the output of each layer.

    :param layers: The layers
    :param x: Shape ``(n, n_in)``
    :return: One more than there are layers, each of shape ``(n, width)``; what precedes a tanh may be lost
    """
    xs, is_linear = [x], False
    for layer in layers:
        if isinstance(layer, th.nn.Tanh):
            # No derivative asks for what a linear layer put out, so tanh may write over it
            x = tanh(x, in_place=is_linear)
        else:
            x = F.linear(x, layer.weight, layer.bias) if isinstance(layer, th.nn.Linear) else x.relu()
        xs.append(x)
        is_linear = isinstance(layer, th.nn.Linear)
    return xs


def tanh(x: th.Tensor, in_place: bool) -> th.Tensor:
    """
    tanh, on a CPU by NumPy.

    :param x: Any shape
    :param in_place: Whether to write over x
    """
    out = x if in_place else th.empty_like(x)
    if x.device.type != "cpu":
        return th.tanh(x, out=out)
    np.tanh(x.numpy(), out=out.numpy())
    return out


def parameters_of(layers: list[th.nn.Module]) -> list[th.Tensor]:
    """
    W and b of each linear layer, one after the other.

    :param layers: The layers
    """
    return [part for layer in layers if isinstance(layer, th.nn.Linear) for part in (layer.weight, layer.bias)]


def deltas(
    layers: list[th.nn.Module], weights: Sequence[th.Tensor], xs: Sequence[th.Tensor], delta: th.Tensor
) -> Iterator[tuple[th.Tensor, th.Tensor]]:
    """
    δ = ∂L/∂z of each linear layer ``z = W x + b``, from the last to the first.

    Before it, ``∂L/∂x = δ W``; before a tanh, ``δ (1 − y²)``; before a ReLU, δ where y > 0.

    :param layers: The layers
    :param weights: W of each linear layer
    :param xs: As ``activations`` gives them
    :param delta: ∂L/∂y of the last output y, shape ``(n, width)``
    :return: Of each linear layer: δ of shape ``(n, n_out)`` and x of shape ``(n, n_in)``
    """
    remaining = list(weights)
    for i, layer in reversed(list(enumerate(layers))):
        if isinstance(layer, th.nn.Linear):
            yield delta, xs[i]
            weight = remaining.pop()
            delta = delta @ weight if i > 0 else delta
        elif isinstance(layer, th.nn.Tanh):
            delta = th.ops.aten.tanh_backward(delta, xs[i + 1])
        else:
            delta = th.ops.aten.threshold_backward(delta, xs[i + 1], 0)


def gradients(
    layers: list[th.nn.Module], weights: Sequence[th.Tensor], xs: Sequence[th.Tensor], delta: th.Tensor
) -> list[th.Tensor]:
    """
    ``∂L/∂W = δᵀ x`` and ``∂L/∂b = Σ δ`` of each linear layer, as ``parameters_of`` has them.

    :param layers: The layers
    :param weights: W of each linear layer
    :param xs: As ``activations`` gives them
    :param delta: ∂L/∂y of the last output y, shape ``(n, width)``
    """
    found = []
    for d, x in deltas(layers, weights, xs, delta):
        # BLAS takes up to five times as long for a product of many rows and few columns
        found += [d.sum(0), (x.T @ d).T if x.shape[1] < d.shape[1] else d.T @ x]
    return found[::-1]


def squared_error(
    layers: list[th.nn.Module], parameters: list[th.nn.Parameter], x: th.Tensor, targets: th.Tensor
) -> tuple[th.Tensor, list[th.Tensor]]:
    """
    ``L = mean (y − G)²`` of an MLP with one output y, and ∂L/∂θ.

    :param layers: The layers
    :param parameters: θ, some of their parameters
    :param x: Shape ``(n, n_in)``
    :param targets: G, shape ``(n,)``
    """
    everything = parameters_of(layers)
    with th.no_grad():
        xs = activations(layers, x)
        delta = (2 / len(x)) * (xs[-1] - targets[:, None])
        found = dict(zip(everything, gradients(layers, everything[::2], xs, delta), strict=True))
        return F.mse_loss(xs[-1].flatten(), targets), [found[parameter] for parameter in parameters]


def through(layers: list[th.nn.Module], x: th.Tensor) -> th.Tensor:
    """
    The layers one after the other, over τ where they have a temperature. Autograd can differentiate it once, by the
    parameters; x is constant.

    :param layers: The layers
    :param x: Shape ``(n, n_in)``
    :return: Shape ``(n, width)``
    """
    return divided(layers, Mlp.apply(layers, x, *parameters_of(layers)))  # type: ignore[no-untyped-call]


def divided(layers: list[th.nn.Module], outputs: th.Tensor) -> th.Tensor:
    """
    ``y / τ``, or y where the last layer has no temperature.

    :param layers: The layers
    :param outputs: y
    """
    for divide in layers[-1]._forward_hooks.values():
        outputs = divide(layers[-1], None, outputs)
    return outputs


class Mlp(th.autograd.Function):
    """The layers one after the other, as autograd sees them."""

    @staticmethod
    def forward(ctx: Any, layers: list[th.nn.Module], x: th.Tensor, *parameters: th.Tensor) -> th.Tensor:
        xs, weights = activations(layers, x), parameters[::2]
        ctx.layers, ctx.n_weights = layers, len(weights)
        ctx.save_for_backward(*weights, *xs)
        return xs[-1]

    @staticmethod
    def backward(ctx: Any, delta: th.Tensor) -> tuple[th.Tensor | None, ...]:
        if th.is_grad_enabled():
            raise NotImplementedError(
                "The fast pass of a plain MLP has no second derivative (create_graph=True): policy.evaluate_actions has"
            )
        weights, xs = ctx.saved_tensors[: ctx.n_weights], ctx.saved_tensors[ctx.n_weights :]
        return None, None, *gradients(ctx.layers, weights, xs, delta)
