"""States of networks, optimizers and random generators: what a model saves, and checks before it takes them."""

import pickle
import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th


def check_finite(state: Any, infinite: set[str], name: str = "") -> None:
    """Check the numbers of a nested state; those with a name in ``infinite`` may be infinite, but not NaN."""
    if isinstance(state, (th.Tensor, float)):
        number = th.as_tensor(state)
        if th.isnan(number).any() or (name not in infinite and th.isinf(number).any()):
            raise ValueError(f"load_path_or_dict must have finite numbers, got {number} for {name[1:]}")
    elif isinstance(state, (Mapping, list, tuple)):
        parts = state.items() if isinstance(state, Mapping) else enumerate(state)
        for key, part in parts:
            check_finite(part, infinite, f"{name}.{key}")


def optimizer_mismatch(optimizer: th.optim.Optimizer, state: Mapping[str, Any]) -> str:
    """Return why a state does not belong to this kind of optimizer and its parameters, "" if it does."""
    own = optimizer.state_dict()
    groups = state.get("param_groups", [])
    if [len(group.get("params", ())) for group in groups] != [len(group["params"]) for group in own["param_groups"]]:
        return "it has other groups of parameters"
    for setting, value in own["param_groups"][0].items():
        for group in groups:
            if setting not in group:
                return f"it has no {setting}: it belongs to another optimizer"
            if isinstance(value, (float, tuple)) and type(group[setting]) not in (type(value), list, int):
                return f"its {setting} is {group[setting]!r}"
    parameters = dict(enumerate(parameter for group in optimizer.param_groups for parameter in group["params"]))
    for index, moments in state.get("state", {}).items():
        if index not in parameters:
            return f"it has a parameter {index!r} more"
        shapes = {key: np.shape(value) for key, value in own["state"].get(index, {}).items()}
        if not shapes and "fused" in optimizer.defaults:
            # A fused step goes through moments and parameter side by side, and would write beyond shorter moments
            shapes = dict.fromkeys(moments, tuple(parameters[index].shape))
        for key, shape in shapes.items():
            if key not in moments or np.shape(moments[key]) not in ((), shape):
                return (
                    f"its {key} of parameter {index} must have shape {shape}, got {tuple(np.shape(moments.get(key)))}"
                )
    return ""


def generator_states(device: th.device) -> bytes:
    """Return the states of the global random generators, as bytes, which Stable-Baselines3 does not print."""
    cuda = th.cuda.get_rng_state(device) if device.type == "cuda" else None
    return pickle.dumps((random.getstate(), np.random.get_state(), th.get_rng_state(), cuda))


def restore_generators(states: bytes, device: th.device) -> None:
    """Restore the states of the global random generators, and of the device's if it has one."""
    python, numpy, torch, cuda = pickle.loads(states)
    random.setstate(python)
    np.random.set_state(numpy)
    th.set_rng_state(torch)
    if cuda is not None and device.type == "cuda":
        th.cuda.set_rng_state(cuda, device)
