"""One optimizer step from given gradients, refused before anything is changed if a gradient is not finite."""

from collections.abc import Sequence

import numpy as np
import torch as th


def step(
    optimizer: th.optim.Optimizer,
    parameters: Sequence[th.nn.Parameter],
    gradients: Sequence[th.Tensor | None],
    max_grad_norm: float | None,
    name: str,
) -> float:
    """
    Clip the gradients to a common norm and let the optimizer descend along them.

    Other parameters that the optimizer holds have no gradient, and so are left as they are.

    :param optimizer: The optimizer
    :param parameters: The parameters to change
    :param gradients: Their gradients, of the loss that is to fall
    :param max_grad_norm: Bound on the norm of all gradients together, None for no bound
    :param name: What the gradients belong to, for the message
    :return: The norm before clipping
    :raises ValueError: If the norm is not finite; parameters and optimizer stay as they were
    """
    optimizer.zero_grad()
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    norm = float(th.nn.utils.clip_grad_norm_(parameters, np.inf if max_grad_norm is None else max_grad_norm))
    if np.isfinite(norm):
        optimizer.step()
    optimizer.zero_grad()
    if not np.isfinite(norm):
        raise ValueError(
            f"The gradient of the {name} is not finite (norm {norm}). The parameters are those before this step; a "
            "lower learning_rate, a max_grad_norm or scaled rewards (VecNormalize) may help"
        )
    return norm
