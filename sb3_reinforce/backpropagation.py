"""
Plain MLPs for many observations, forwards and backwards.

On a few hundred observations autograd takes as long to record a pass as the pass itself, and PyTorch's tanh takes ten
times as long as NumPy's on a CPU. So the chain rule is written out (Rumelhart, Hinton and Williams, 1986): for a layer
``y = f(x)`` and a loss L, δ = ∂L/∂y becomes ∂L/∂x = δ ∂f/∂x, from the last layer to the first.

Layers are ``Linear``, ``Tanh`` and ``ReLU``, as ``layers`` finds them, which share no parameter. All but ``through`` is
called where autograd records nothing.
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
    xs, before = [x], None
    for layer in layers:
        # No derivative asks for what a linear layer put out, so the next tanh may write over it
        x = tanh(x, in_place=isinstance(before, th.nn.Linear)) if isinstance(layer, th.nn.Tanh) else layer(x)
        xs.append(x)
        before = layer
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


def deltas(
    layers: list[th.nn.Module], xs: Sequence[th.Tensor], delta: th.Tensor
) -> Iterator[tuple[th.nn.Linear, th.Tensor, th.Tensor]]:
    """
    δ = ∂L/∂z of each linear layer ``z = W x + b``, from the last to the first.

    Before it, ``∂L/∂x = δ W``; before a tanh, ``δ (1 − y²)``; before a ReLU, δ where y > 0; before a temperature,
    ``δ / τ``.

    :param layers: The layers
    :param xs: As ``activations`` gives them
    :param delta: ∂L/∂y of the last output y, shape ``(n, width)``
    :return: Of each linear layer: itself, δ of shape ``(n, n_out)`` and x of shape ``(n, n_in)``
    """
    for i, layer in reversed(list(enumerate(layers))):
        if isinstance(layer, th.nn.Linear):
            for divide in layer._forward_hooks.values():
                delta = divide(layer, None, delta)
            yield layer, delta, xs[i]
            if i > 0:
                delta = delta @ layer.weight
        elif isinstance(layer, th.nn.Tanh):
            delta = th.ops.aten.tanh_backward(delta, xs[i + 1])
        else:
            delta = th.ops.aten.threshold_backward(delta, xs[i + 1], 0)


def gradients(layers: list[th.nn.Module], xs: Sequence[th.Tensor], delta: th.Tensor) -> dict[th.Tensor, th.Tensor]:
    """
    ``∂L/∂W = δᵀ x`` and ``∂L/∂b = Σ δ`` of each linear layer.

    :param layers: The layers
    :param xs: As ``activations`` gives them
    :param delta: ∂L/∂y of the last output y, shape ``(n, width)``
    """
    found: dict[th.Tensor, th.Tensor] = {}
    for layer, d, x in deltas(layers, xs, delta):
        # BLAS takes up to five times as long for a product of many rows and few columns
        is_narrow = layer.in_features < layer.out_features
        found[layer.weight] = (x.T @ d).T.contiguous() if is_narrow else d.T @ x
        found[layer.bias] = d.sum(0)
    return found


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
    with th.no_grad():
        xs = activations(layers, x)
        found = gradients(layers, xs, (2 / len(x)) * (xs[-1] - targets[:, None]))
        return F.mse_loss(xs[-1].flatten(), targets), [found[parameter] for parameter in parameters]


def through(layers: list[th.nn.Module], x: th.Tensor) -> th.Tensor:
    """
    The layers one after the other, as one operation that autograd can differentiate once by their parameters.

    :param layers: The layers
    :param x: Shape ``(n, n_in)``
    :return: Shape ``(n, width)``
    """
    parameters = [parameter for layer in layers for parameter in layer.parameters()]
    return Mlp.apply(layers, x, *parameters)  # type: ignore[no-untyped-call, no-any-return]


class Mlp(th.autograd.Function):
    """``through`` as autograd sees it."""

    @staticmethod
    def forward(ctx: Any, layers: list[th.nn.Module], x: th.Tensor, *parameters: th.nn.Parameter) -> th.Tensor:
        xs = activations(layers, x)
        ctx.layers, ctx.n_activations = layers, len(xs)
        ctx.save_for_backward(*xs, *parameters)
        return xs[-1]

    @staticmethod
    @th.autograd.function.once_differentiable
    def backward(ctx: Any, delta: th.Tensor) -> tuple[th.Tensor | None, ...]:
        saved = ctx.saved_tensors
        found = gradients(ctx.layers, saved[: ctx.n_activations], delta)
        return None, None, *(found[parameter] for parameter in saved[ctx.n_activations :])
