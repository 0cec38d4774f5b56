"""What a model saves: files that are written whole or not at all, and states that are checked before they are taken."""

import io
import json
import os
import pickle
import random
import shutil
import warnings
import zipfile
from collections.abc import Mapping, Set
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.save_util import open_path

from sb3_reinforce.common.processes import is_leader, rank_and_size

PathOrFile: TypeAlias = str | Path | io.BufferedIOBase
# The names in REINFORCE's parameters; FiniteDifference lacks the last
STATES_OF_BOTH = ("policy", "policy.optimizer", "critic_optimizer")
# Flags of optimizers: PyTorch fills in those that a state from another version of it lacks
FLAGS = ("decoupled_weight_decay", "foreach", "fused", "maximize", "capturable", "differentiable")


def write_whole(target: PathOrFile, content: bytes) -> None:
    """Write to where Stable-Baselines3 saves; at each moment either the old file or the new one exists."""
    if not isinstance(target, (str, Path)):
        open_path(target, "w").write(content)
        return
    if not is_leader():
        return
    path = Path(target)
    path = path if path.suffix else path.with_name(f"{path.name}.zip")
    if path.is_dir():
        warnings.warn(f"{path} is a folder: the model is saved to {path}_2", stacklevel=3)
        path = path.with_name(f"{path.name}_2")
    # The file that a link points to: the link stays a link
    path = path.resolve()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix=".", dir=path.parent) as folder:
            temporary = Path(folder, path.name)
            with open(temporary, "xb") as file:
                if path.exists():
                    shutil.copymode(path, temporary)
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def check_archive(source: PathOrFile, needed: tuple[str, ...]) -> dict[str, Any]:
    """Check that a saved model has the needed parts and the right checksums, and return its attributes as JSON."""
    file: Any = open_path(source, "r", suffix="zip")
    try:
        with zipfile.ZipFile(file) as archive:
            parts = archive.namelist()
            damaged = archive.testzip()
            if damaged is not None:
                raise zipfile.BadZipFile(f"the checksum of its part {damaged!r} is wrong")
            attributes: dict[str, Any] = json.loads(archive.read("data")) if "data" in parts else {}
    except Exception as error:
        # Bytes that have changed raise errors of many kinds
        raise ValueError(f"{source} is damaged, or not a saved model: {error}") from error
    finally:
        if isinstance(source, (str, Path)):
            file.close()
    missing = [name for name in needed if name not in parts]
    if missing:
        raise ValueError(f"{source} is not a saved model, or not a whole one: it has no {', '.join(missing)}")
    return attributes


def defaults_to_choose_again(saved: Mapping[str, Any], given: Set[str], n_envs: int | None) -> dict[str, None]:
    """The defaults to choose again if arguments are given or the environments or processes differ, each with None."""
    has_same_envs = n_envs in (None, saved.get("n_envs")) and rank_and_size()[1] == saved.get("_n_processes", 1)
    if not given and has_same_envs:
        return {}
    chosen = saved.get("_chosen_defaults", {})
    return {name: None for name, value in chosen.items() if saved.get(name) == value and name not in given}


def check_states(states: Mapping[str, Any], names: list[str], exact_match: bool) -> dict[str, Any]:
    """Check that there is a state for all of ``names`` or, without ``exact_match``, for some, and return these."""
    own = {name: states[name] for name in names if name in states}
    allowed = {*names} if exact_match else {*names, *STATES_OF_BOTH}
    if not states.keys() <= allowed or not own or (exact_match and len(own) < len(names)):
        raise ValueError(
            f"load_path_or_dict must have {'all' if exact_match else 'some'} of {', '.join(names)} and nothing else, "
            f"got {', '.join(map(str, states))}: exact_match=False takes {{'policy': ...}} alone too"
        )
    for name, state in own.items():
        if not isinstance(state, Mapping):
            raise TypeError(f"load_path_or_dict[{name!r}] must be a dict, as of state_dict(), got {state!r}")
    return own


def may_be_infinite(policy: th.nn.Module) -> set[str]:
    """Names of what is not trained, such as a mask that a user's policy adds to its logits."""
    frozen = {name for name, each in policy.named_parameters(remove_duplicate=False) if not each.requires_grad}
    buffers = {name for name, _ in policy.named_buffers(remove_duplicate=False)}
    return {f".policy.{name}" for name in frozen | buffers}


def check_finite_state(state: Any, infinite: set[str], name: str = "") -> None:
    """Check the numbers of a nested state; those with a name in ``infinite`` may be infinite, but not NaN."""
    if isinstance(state, (th.Tensor, float)):
        number = th.as_tensor(state)
        if th.isnan(number).any() or (name not in infinite and th.isinf(number).any()):
            raise ValueError(f"load_path_or_dict must have finite numbers, got {number} for {name[1:]}")
    elif isinstance(state, (Mapping, list, tuple)):
        parts = state.items() if isinstance(state, Mapping) else enumerate(state)
        for key, part in parts:
            check_finite_state(part, infinite, f"{name}.{key}")


def optimizer_mismatch(optimizer: th.optim.Optimizer, state: Mapping[str, Any]) -> str:
    """Return why a state does not belong to this kind of optimizer and its parameters, "" if it does."""
    own = optimizer.state_dict()
    groups = state.get("param_groups", [])
    if [len(group.get("params", ())) for group in groups] != [len(group["params"]) for group in own["param_groups"]]:
        return "it has other groups of parameters"
    for setting in own["param_groups"][0]:
        if any(setting not in {*group, *FLAGS} for group in groups):
            return f"it has no {setting}: it belongs to another optimizer"
    if "fused" in optimizer.defaults:
        # A fused step goes through moments and parameter side by side, and would write beyond shorter moments
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        for index, moments in state.get("state", {}).items():
            if index not in range(len(parameters)):
                return f"it has moments of a parameter {index}"
            for key, moment in moments.items():
                shape = tuple(np.shape(moment))
                needed = tuple(parameters[index].shape)
                if shape not in ((), needed):
                    return f"its {key} of parameter {index} must have shape {needed}, got {shape}"
    return ""


def load_policy(policy: th.nn.Module, state: Mapping[str, Any], exact_match: bool) -> bool:
    """Load the parameters of a policy, and return whether they were all there, and no others."""
    missing, others = policy.load_state_dict(state, strict=exact_match)
    kind = type(policy).__name__
    if len(others) == len(state):
        raise ValueError(f"load_path_or_dict['policy'] has no parameter of {kind}, got {others}")
    if missing:
        warnings.warn(f"load_path_or_dict['policy'] has no {', '.join(missing)}: they stay as they are", stacklevel=3)
    if others:
        left_out = f"{', '.join(others)} of load_path_or_dict['policy']: they are left out"
        warnings.warn(f"{kind} has no {left_out}", stacklevel=3)
    return not (missing or others)


def load_part(part: th.nn.Module | th.optim.Optimizer, name: str, state: Any, exact_match: bool) -> None:
    """Load a network of a subclass, or an optimizer; a state of another kind is left out, or an error if exact."""
    if not isinstance(part, th.optim.Optimizer):
        part.load_state_dict(state, strict=exact_match)
        return
    reason = optimizer_mismatch(part, state)
    needed = f"load_path_or_dict[{name!r}] must be the state of {type(part).__name__} for this policy"
    if not reason:
        # Copies, or two models that one dict is given to would share their moments
        part.load_state_dict(deepcopy(dict(state)))
    elif exact_match:
        raise ValueError(
            f"{needed}, but {reason}. If the saved model had another optimizer, make a model, give it that optimizer, "
            "and call set_parameters. To leave this state out, call set_parameters with exact_match=False"
        )
    else:
        warnings.warn(f"{needed}, but {reason}. It is left out", stacklevel=3)


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
