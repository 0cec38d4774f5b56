"""Helpers for tensors and nested dicts of tensors."""

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
import torch as th

# A tensor, or a nested dict of tensors
TensorOrDict: TypeAlias = Any


def flatten(tensors: TensorOrDict) -> TensorOrDict:
    """``(n_steps, n_envs, ...)`` to ``(n_steps * n_envs, ...)``."""
    if isinstance(tensors, th.Tensor):
        return tensors.flatten(0, 1)
    return {key: flatten(part) for key, part in tensors.items()}


def take(tensors: TensorOrDict, index: Any) -> TensorOrDict:
    """``tensors[index]``, for each tensor of a dict; for arrays too."""
    if isinstance(tensors, dict):
        return {key: take(part, index) for key, part in tensors.items()}
    return tensors[index]


def select(tensors: TensorOrDict, mask: th.Tensor) -> TensorOrDict:
    """The steps in a mask of shape ``(n_steps, n_envs)``, without a copy if these are all steps."""
    return flatten(tensors) if bool(mask.all()) else take(tensors, mask)


def shaped_like(tensors: TensorOrDict, obs: Any) -> TensorOrDict:
    """A batch of observations in the shape of stored ones, which have one dimension more for single numbers."""
    if isinstance(tensors, dict):
        return {key: shaped_like(part, obs[key]) for key, part in tensors.items()}
    return th.as_tensor(obs, device=tensors.device).reshape(-1, *tensors.shape[1:])


def concatenate(*tensors: TensorOrDict) -> TensorOrDict:
    """The rows of all tensors, shape ``(n, ...)``, for each tensor of the dicts."""
    first = tensors[0]
    if isinstance(first, dict):
        return {key: concatenate(*(each[key] for each in tensors)) for key in first}
    return th.cat(tensors)


def stack(observations: list[Any]) -> Any:
    """Single observations, arrays or dicts of arrays, as a batch."""
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)


def to_vector(tensors: Iterable[th.Tensor | None]) -> th.Tensor:
    """A copy of the elements of all tensors, shape ``(n,)``, without those that are None."""
    return th.cat([tensor.detach().flatten() for tensor in tensors if tensor is not None])
