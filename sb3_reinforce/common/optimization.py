"""
One optimizer step from given gradients, refused before anything is changed if a gradient is not finite, and taken back
if the parameters would not be.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

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
    flat = [gradient.flatten() for gradient in gradients if gradient is not None]
    norm = float(th.linalg.vector_norm(th.cat(flat)))
    if not math.isfinite(norm):
        raise ValueError(
            f"The gradient of the {name} is not finite (norm {norm}). The parameters are those before this step; a "
            "lower learning_rate, a max_grad_norm or scaled rewards (VecNormalize) may help"
        )
    scale = 1.0 if max_grad_norm is None else min(1.0, max_grad_norm / (norm + 1e-6))
    optimizer.zero_grad()
    for parameter, gradient in zip(parameters, gradients, strict=True):
        scaled = gradient if gradient is None or scale == 1 else gradient * scale
        parameter.grad = None if scaled is None else as_parameter(scaled, parameter)
    optimizer.step()
    return norm


def as_parameter(gradient: th.Tensor, parameter: th.nn.Parameter) -> th.Tensor:
    """
    The gradient in the layout of its parameter: a fused optimizer goes through both as they lie in memory.

    :param gradient: Of the parameter's shape
    :param parameter: The parameter
    """
    if gradient.stride() == parameter.stride() and gradient.dtype == parameter.dtype:
        return gradient
    return th.empty_like(parameter).copy_(gradient)


def in_a_row(parameters: Sequence[th.nn.Parameter]) -> th.Tensor:
    """
    A copy of all values, shape ``(n,)``.

    :param parameters: The parameters, in any memory format
    """
    return th.cat([parameter.detach().flatten() for parameter in parameters])


@contextmanager
def kept_finite(optimizer: th.optim.Optimizer, parameters: Sequence[th.nn.Parameter], name: str) -> Iterator[None]:
    """
    Parameters that are changed within the block become what they were before it, if one of them is not finite after it.
    The optimizer, whose moments may not be finite either, then begins anew.

    A finite gradient can do that: Adam without its ``eps`` divides 0 by 0, and weight decay may be too large.

    :param optimizer: What changes them
    :param parameters: The parameters
    :param name: What they belong to, for the message
    :raises ValueError: If one of them is not finite
    """
    before = in_a_row(parameters)
    try:
        yield
    finally:
        if not math.isfinite(th.linalg.vector_norm(in_a_row(parameters), ord=math.inf)):
            with th.no_grad():
                for parameter, old in zip(parameters, th.split(before, [p.numel() for p in parameters]), strict=True):
                    parameter.copy_(old.view_as(parameter))
            optimizer.state.clear()
            raise ValueError(
                f"A step made a parameter of the {name} that is not finite. The parameters are those before it, and "
                "the optimizer begins anew; a lower learning_rate, other optimizer_kwargs or scaled rewards "
                "(VecNormalize) may help"
            )


def fuse(optimizer: th.optim.Optimizer) -> None:
    """
    Let Adam do its step in one kernel, a fourth of the time for small networks, unless the user has chosen otherwise.

    :param optimizer: Any optimizer; only Adam and AdamW are changed
    """
    if type(optimizer) in (th.optim.Adam, th.optim.AdamW):
        for group in optimizer.param_groups:
            group["fused"] = group["fused"] is not False and not group["foreach"]
