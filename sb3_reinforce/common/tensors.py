"""Helpers for tensors and dicts of tensors."""

from collections.abc import Iterable
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

TensorOrDict = TypeVar("TensorOrDict", th.Tensor, PyTorchObs)


def flatten(tensors: TensorOrDict) -> TensorOrDict:
    """
    All steps of a rollout in a row.

    :param tensors: Shape ``(n_steps, n_envs, ...)``, or a dict of such tensors
    :return: Shape ``(n_steps * n_envs, ...)``, or a dict of such tensors
    """
    return tensors.flatten(0, 1) if isinstance(tensors, th.Tensor) else {k: v.flatten(0, 1) for k, v in tensors.items()}


def take(tensors: TensorOrDict, steps: th.Tensor | slice) -> TensorOrDict:
    """
    Some of the steps.

    :param tensors: Shape ``(n, ...)`` or ``(n_steps, n_envs, ...)``, or a dict of such tensors
    :param steps: The indices, a slice, or a mask of shape ``(n_steps, n_envs)``
    :return: These steps in a row, or a dict of such tensors
    """
    return tensors[steps] if isinstance(tensors, th.Tensor) else {key: part[steps] for key, part in tensors.items()}


def select(tensors: TensorOrDict, used: th.Tensor) -> TensorOrDict:
    """
    The steps of a rollout that a mask names, in a row, without a copy where it names all of them.

    :param tensors: Shape ``(n_steps, n_envs, ...)``, or a dict of such tensors
    :param used: Mask of shape ``(n_steps, n_envs)`` with ``n`` True entries
    :return: Shape ``(n, ...)``, or a dict of such tensors
    """
    return flatten(tensors) if bool(used.all()) else take(tensors, used)


def stack(observations: list[Any]) -> Any:
    """
    Make a batch of single observations.

    :param observations: ``n`` observations, arrays or dicts of arrays
    :return: Shape ``(n, ...)``, or a dict of such arrays
    """
    if isinstance(observations[0], dict):
        return {key: np.stack([obs[key] for obs in observations]) for key in observations[0]}
    return np.stack(observations)


def to_vector(tensors: Iterable[th.Tensor]) -> th.Tensor:
    """A copy of all elements as one vector, shape ``(n,)``, in any memory format."""
    return th.cat([tensor.detach().flatten() for tensor in tensors])
