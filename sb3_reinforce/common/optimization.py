"""One optimizer step from given gradients, refused or rolled back if a number is not finite."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch as th

from sb3_reinforce.common.tensors import to_vector

REMEDY = "a lower learning rate or scaled rewards (VecNormalize)"


def step(
    optimizer: th.optim.Optimizer,
    parameters: Sequence[th.nn.Parameter],
    gradients: Sequence[th.Tensor | None],
    max_grad_norm: float | None,
    name: str,
) -> float:
    """Clip the gradients of a loss by their common norm, descend along them, and return the norm before clipping."""
    if all(gradient is None for gradient in gradients):
        return 0.0
    norm = finite_norm(to_vector(gradients), name, REMEDY)
    scale = 1.0 if max_grad_norm is None else min(1.0, max_grad_norm / (norm + 1e-6))
    optimizer.zero_grad()
    for parameter, gradient in zip(parameters, gradients, strict=True):
        # In the memory layout of its parameter, which a fused optimizer takes for granted
        parameter.grad = None if gradient is None else th.mul(gradient, scale, out=th.empty_like(parameter))
    optimizer.step()
    return norm


def finite_norm(gradient: th.Tensor, name: str, remedy: str) -> float:
    """The norm of a gradient, which must be finite."""
    norm = float(th.linalg.vector_norm(gradient))
    if not math.isfinite(norm):
        raise ValueError(
            f"The gradient of the {name} is not finite (norm {norm}). The parameters are those before this step; "
            f"{remedy} may help"
        )
    return norm


@contextmanager
def kept_finite(optimizer: th.optim.Optimizer, parameters: Sequence[th.nn.Parameter], name: str) -> Iterator[None]:
    """Roll the parameters back if any of them is not finite when the block ends, and clear the optimizer's state."""
    # Finite gradients can do that: Adam without its eps divides 0 by 0, and weight decay may be too large
    before = [parameter.detach().clone() for parameter in parameters]
    try:
        yield
    finally:
        if not to_vector(parameters).isfinite().all():
            with th.no_grad():
                for parameter, old in zip(parameters, before, strict=True):
                    parameter.copy_(old)
            optimizer.state.clear()
            raise ValueError(
                f"The update of the {name} left a parameter that is not finite. The parameters are those before this "
                "update, and the optimizer starts with an empty state; a lower learning rate, other optimizer_kwargs "
                "or scaled rewards (VecNormalize) may help"
            )


def fuse(optimizer: th.optim.Optimizer) -> None:
    """Let Adam and AdamW take their step in one kernel, unless the user has chosen another implementation."""
    if type(optimizer) in (th.optim.Adam, th.optim.AdamW):
        for group in optimizer.param_groups:
            if group["fused"] is None and group["foreach"] is None and not group["differentiable"]:
                group["fused"] = True
