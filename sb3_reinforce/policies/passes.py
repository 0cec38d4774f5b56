"""
Passes through plain MLPs for a handful of observations, as a few NumPy operations.

PyTorch's modules take far longer there than the arithmetic. For many observations see ``backpropagation``.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import numpy as np
import torch as th
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float32]

# Products beyond which NumPy's BLAS starts threads of its own, whatever number the user has set for PyTorch
ONE_THREAD = 2**18


def lay_out(layers: list[th.nn.Module], n: int) -> Callable[[np.ndarray], Floats]:
    """
    The layers as one function of observations, with the parameters that they have now.

    Each observation is a column above a 1, so that the bias is one more column of the weights,
    ``W x + b = [W b] [x; 1]``, and all that follows happens in place.

    :param layers: ``Linear``, ``Tanh`` and ``ReLU`` layers
    :param n: Number of observations at a time
    :return: A function of arrays of shape ``(n, ...)``; returns shape ``(n, width)``
    """
    x = inputs = above_ones(next(layer.in_features for layer in layers if isinstance(layer, th.nn.Linear)), n)
    operations: list[Callable[[], Any]] = []
    for layer in layers:
        if isinstance(layer, th.nn.Linear):
            y = above_ones(layer.out_features, n)
            operations.append(product(layer, x, y[:-1]))
            x = y
        elif isinstance(layer, th.nn.Tanh):
            operations.append(partial(np.tanh, x[:-1], out=x[:-1]))
        else:
            operations.append(partial(np.maximum, x, 0, out=x))

    def outputs(obs: np.ndarray) -> Floats:
        inputs[:-1] = obs.reshape(n, -1).T
        for operation in operations:
            operation()
        # Not the room itself, which the next observations will overwrite
        y: Floats = x[:-1].T.copy()
        return y

    return outputs


def above_ones(width: int, n: int) -> Floats:
    """
    Room for n columns, each above a 1.

    :param width: Their length without the 1
    :param n: Number of columns
    """
    return np.ones((width + 1, n), dtype=np.float32)


def product(layer: th.nn.Linear, x: Floats, out: Floats) -> Callable[[], Any]:
    """
    ``[W b] x``, over τ where the layer has a temperature, as a function of what stands in x when it is called.

    :param layer: W and b
    :param x: Shape ``(n_in + 1, n)``
    :param out: Where to write, shape ``(n_out, n)``
    """
    weights = th.cat([layer.weight.detach(), layer.bias.detach()[:, None]], dim=1)
    for divide in layer._forward_hooks.values():
        weights = divide(layer, None, weights)
    if x.shape[1] * weights.numel() > ONE_THREAD:
        return partial(th.mm, weights, th.from_numpy(x), out=th.from_numpy(out))
    return partial(np.dot, weights.numpy(), x, out)
