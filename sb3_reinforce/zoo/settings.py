"""What an entry of a configuration for the RL Zoo may hold, and the errors that name what it may not."""

import importlib
import re
import runpy
from collections.abc import Iterable, Iterator
from inspect import signature
from pathlib import Path
from typing import Any, get_args

import yaml
from rl_zoo3 import exp_manager, utils
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import Schedule

from sb3_reinforce.common.arguments import check_integer, check_number, own_arguments, unknown_name
from sb3_reinforce.common.base import BasePolicyGradient
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.recurrent import RecurrentREINFORCE
from sb3_reinforce.reinforce import REINFORCE

Settings = dict[str, Any]
ALGORITHMS: dict[str, type[BasePolicyGradient]] = {
    "reinforce": REINFORCE,
    "reinforce_lstm": RecurrentREINFORCE,
    "finite_difference": FiniteDifference,
}
# The keys that the Zoo reads itself, and the arguments that it passes itself
ZOO_KEYS = {
    "n_timesteps", "n_envs", "normalize", "env_wrapper", "vec_env_wrapper", "callback", "frame_stack", "env_kwargs",
    "monitor_kwargs",
}  # fmt: skip
ZOO_ARGUMENTS = {"env", "tensorboard_log", "seed", "verbose", "device"}
# In a configuration, a section by environment: the entries keep to the keys of the Zoo and the arguments of the
# algorithm, so that other scripts can read them
TRAIN_ENV_KWARGS = "train_env_kwargs"
# Settings that name classes by their path
CLASS_KEYS = ("policy", "env_wrapper", "vec_env_wrapper", "callback")
# Settings whose dict may be given as a text
PYTHON_KEYS = ("policy_kwargs", "monitor_kwargs", "normalize")
LINEAR = re.compile(r"lin_([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)", re.IGNORECASE)


class ConfigurationError(ValueError):
    """A wrong setting, which the command line reports without a traceback."""


def load_configuration(config: str) -> Any:
    """Load what a YAML file, a Python file or a module holds, as the Zoo does."""
    try:
        if config.endswith((".yml", ".yaml")):
            return yaml.safe_load(Path(config).read_text(encoding="utf-8"))
        names = runpy.run_path(config) if config.endswith(".py") else vars(importlib.import_module(config))
    except (OSError, SyntaxError, yaml.YAMLError) as error:
        raise ConfigurationError(f"{config} cannot be read: {error}") from error
    if "hyperparams" not in names:
        raise ConfigurationError(f"{config} must define a dict named hyperparams")
    return names["hyperparams"]


def allowed_keys(algorithm: str) -> set[str]:
    """The keys that an algorithm's entry in a configuration may have."""
    arguments = own_arguments(ALGORITHMS[algorithm], BasePolicyGradient)
    return arguments.keys() - ZOO_ARGUMENTS | ZOO_KEYS | {TRAIN_ENV_KWARGS}


def scheduled_keys(algorithm: str) -> set[str]:
    """The arguments of an algorithm that may be schedules."""
    arguments = own_arguments(ALGORITHMS[algorithm], BasePolicyGradient)
    return {name for name, argument in arguments.items() if Schedule in get_args(argument.annotation)}


def check_keys(algorithm: str, keys: Iterable[str]) -> None:
    """Raise an error for a key that the algorithm's entry may not have; it says what to use instead."""
    allowed = allowed_keys(algorithm)
    for key in keys:
        if key not in allowed:
            wrong = f"{algorithm} has no setting {key}"
            if instead := ALGORITHMS[algorithm]._instead.get(key):
                raise ConfigurationError(f"{wrong}: {instead}")
            raise ConfigurationError(str(unknown_name(f"{wrong}: a setting", "one of", sorted(allowed), key)))


def check_hyperparams(algorithm: str, hyperparams: Settings) -> None:
    """Raise an error for settings that the Zoo would fail on; the algorithm checks its own arguments."""
    check_keys(algorithm, hyperparams)
    for key in ("policy", "n_timesteps"):
        if key not in hyperparams:
            raise ConfigurationError(f"The settings of {algorithm} must hold {key}, which the Zoo reads even with -n")
    if not isinstance(hyperparams["policy"], str):
        raise ConfigurationError(f"policy must be a name, or the path of a class, got {hyperparams['policy']!r}")
    for key, value in hyperparams.items():
        if isinstance(value, str):
            if re.fullmatch(r"[-+\d.]+e[-+\d]+", value, re.IGNORECASE):
                raise ConfigurationError(
                    f"{key} must be a number, got the string {value!r}: write !!float {value} in YAML, and {value} "
                    "without quotes in -params"
                )
            if key in scheduled_keys(algorithm) and not LINEAR.fullmatch(value):
                raise ConfigurationError(f"{key} must be a number, or lin_NUMBER to fall linearly to 0, got {value!r}")
    for key, path, names in classes_of(hyperparams):
        try:
            found = utils.get_class_by_name(path)
        except (AttributeError, TypeError, ValueError) as error:
            raise ConfigurationError(f"{key} must be the path of a class, got {path!r}: {error}") from error
        if key != "policy":
            positional = () if key == "callback" else ("env",)
            try:
                # An unknown name first: it is often a misspelling of the missing one
                signature(found).bind_partial(*positional, **names)
                signature(found).bind(*positional, **names)
            except TypeError as error:
                raise ConfigurationError(f"The arguments of {path} in {key}: {error}") from error
    for key in ("n_envs", "frame_stack"):
        check_integer(key, hyperparams.get(key, 1), 1)
    check_number("n_timesteps", hyperparams["n_timesteps"], 1)
    for key, value in hyperparams.items():
        try:
            yaml.unsafe_load(yaml.dump(value))
        except Exception as error:
            # Reading back calls whatever the text names
            raise ConfigurationError(
                f"{key} cannot be read again from the config.yml beside the model: put functions and classes into a "
                f"module that can be imported ({error})"
            ) from error


def classes_of(hyperparams: Settings) -> Iterator[tuple[str, Any, Settings]]:
    """Each path of a class that the Zoo will import, with its setting before and its keyword arguments after it."""
    for key in CLASS_KEYS:
        given = hyperparams.get(key)
        if given is None:
            continue
        for each in given if isinstance(given, list) else [given]:
            path, names = next(iter(each.items())) if isinstance(each, dict) and each else (each, {})
            is_name = key == "policy" and "." not in str(path)
            if names is None:
                raise ConfigurationError(f"The arguments of {path} in {key} must be a dict, got None")
            if not (is_name or isinstance(path, BaseCallback if key == "callback" else type)):
                yield key, path, as_dict(f"The arguments of {path} in {key}", names)


def as_dict(key: str, value: Any) -> Settings:
    """A setting as a dict: the Zoo evaluates a text as Python, with the names of one of its modules."""
    result = {} if value is None or (key == "normalize" and isinstance(value, bool)) else value
    if isinstance(value, str) and key in PYTHON_KEYS:
        try:
            # enjoy evaluates normalize in the module utils
            for module in (utils, exp_manager) if key == "normalize" else (exp_manager,):
                result = eval(value, dict(vars(module)))
        except Exception as error:
            raise ConfigurationError(
                f"{key} must be Python that the Zoo can evaluate, but {value!r} raises {error!r}"
            ) from error
    if not isinstance(result, dict):
        flag = "True, False or " if key == "normalize" else ""
        raise ConfigurationError(f"{key} must be {flag}a dict, got {value!r}")
    return result
