"""Helpers for tensors and nested dicts of tensors."""

from collections.abc import Callable, Iterable
from typing import Any, TypeAlias

import numpy as np
import torch as th

# Differences up to this fraction of the numbers are rounding errors
ROUNDING = 1e-12
# A tensor, or a nested dict of tensors
TensorOrDict: TypeAlias = Any


def map_parts(function: Callable[..., Any], *tensors: TensorOrDict) -> TensorOrDict:
    """``function(*tensors)``, also of arrays; for dicts, a dict of the results by key."""
    first = tensors[0]
    if isinstance(first, dict):
        return {key: map_parts(function, *(each[key] for each in tensors)) for key in first}
    return function(*tensors)


def flatten(tensors: TensorOrDict) -> TensorOrDict:
    """``(n_steps, n_envs, ...)`` to ``(n_steps * n_envs, ...)``."""
    return map_parts(lambda tensor: tensor.flatten(0, 1), tensors)


def take(tensors: TensorOrDict, index: Any) -> TensorOrDict:
    """``tensors[index]``, for arrays too."""
    return map_parts(lambda tensor: tensor[index], tensors)


def select(tensors: TensorOrDict, mask: th.Tensor) -> TensorOrDict:
    """The steps in a mask of shape ``(n_steps, n_envs)``, without a copy if these are all steps."""
    return flatten(tensors) if bool(mask.all()) else take(tensors, mask)


def shaped_like(tensors: TensorOrDict, obs: Any) -> TensorOrDict:
    """A batch of observations in the shape of stored ones, which have one dimension more for single numbers."""

    def reshape(tensor: th.Tensor, part: Any) -> th.Tensor:
        return th.as_tensor(part, device=tensor.device).reshape(-1, *tensor.shape[1:])

    return map_parts(reshape, tensors, obs)


def concatenate(*tensors: TensorOrDict) -> TensorOrDict:
    """The rows of all tensors, shape ``(n, ...)``."""
    return map_parts(lambda *parts: th.cat(parts), *tensors)


def stack(observations: list[Any]) -> Any:
    """Single observations, arrays or dicts of arrays, as a batch."""
    return map_parts(lambda *parts: np.stack(parts), *observations)


def to_vector(tensors: Iterable[th.Tensor | None]) -> th.Tensor:
    """A copy of the elements of all tensors, shape ``(n,)``, without those that are None."""
    return th.cat([tensor.detach().flatten() for tensor in tensors if tensor is not None])
