"""Helpers for tensors and dicts of tensors."""

from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

TensorOrDict = TypeVar("TensorOrDict", th.Tensor, PyTorchObs)


def flatten(tensors: TensorOrDict) -> TensorOrDict:
    """``(n_steps, n_envs, ...)`` to ``(n_steps * n_envs, ...)``."""
    if isinstance(tensors, th.Tensor):
        return tensors.flatten(0, 1)
    return {key: part.flatten(0, 1) for key, part in tensors.items()}


def take(tensors: TensorOrDict, index: th.Tensor | slice | int) -> TensorOrDict:
    """``tensors[index]``, for each tensor of a dict; for arrays too."""
    if isinstance(tensors, dict):
        return {key: part[index] for key, part in tensors.items()}
    return tensors[index]


def select(tensors: TensorOrDict, mask: th.Tensor) -> TensorOrDict:
    """The steps in a mask of shape ``(n_steps, n_envs)``, without a copy if these are all steps."""
    return flatten(tensors) if bool(mask.all()) else take(tensors, mask)


def stack(observations: list[Any]) -> Any:
    """Single observations, arrays or dicts of arrays, as a batch."""
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)


def to_vector(tensors: Iterable[th.Tensor | None]) -> th.Tensor:
    """A copy of the elements of all tensors, shape ``(n,)``, without those that are None."""
    return th.cat([tensor.detach().flatten() for tensor in tensors if tensor is not None])
