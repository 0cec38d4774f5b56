"""The settings that REINFORCE and FiniteDifference may have in the Zoo, and the errors about wrong ones."""

import difflib
import inspect
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, get_args

from rl_zoo3 import exp_manager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import Schedule

from sb3_reinforce.common.arguments import check_integer, check_number
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.reinforce import REINFORCE

Settings = dict[str, Any]
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"reinforce": REINFORCE, "finite_difference": FiniteDifference}
HYPERPARAMS = Path(__file__).parent / "hyperparams"
# The keys that the Zoo reads itself, and the arguments that it passes itself
ZOO_KEYS = {
    "n_timesteps", "n_envs", "normalize", "env_wrapper", "vec_env_wrapper", "callback", "frame_stack", "env_kwargs",
    "monitor_kwargs",
}  # fmt: skip
ZOO_ARGUMENTS = {"self", "env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}
LINEAR = re.compile(r"lin_([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)", re.IGNORECASE)


class ConfigurationError(ValueError):
    """A wrong setting, which the command line reports without a traceback."""


def allowed_keys(algorithm: str) -> set[str]:
    """The keys that an algorithm's entry in a configuration may have."""
    return inspect.signature(ALGORITHMS[algorithm]).parameters.keys() - ZOO_ARGUMENTS | ZOO_KEYS


def scheduled_keys(algorithm: str) -> set[str]:
    """The arguments of an algorithm that may be schedules."""
    parameters = inspect.signature(ALGORITHMS[algorithm]).parameters.values()
    return {parameter.name for parameter in parameters if Schedule in get_args(parameter.annotation)}


def closest(name: str, names: Iterable[str]) -> str:
    """``: did you mean X?`` with the closest of the names, or nothing where none is close."""
    return "".join(f": did you mean {near}?" for near in difflib.get_close_matches(name, names, n=1))


def check_hyperparams(algorithm: str, hyperparams: Settings, optimize: bool) -> None:
    """Raise an error for settings that the Zoo would fail on; the algorithm checks its own arguments."""
    allowed = allowed_keys(algorithm)
    for key in hyperparams:
        if key not in allowed:
            hint = closest(str(key), allowed) or f", only {', '.join(sorted(allowed))}"
            raise ConfigurationError(f"{key!r} is not a setting of {algorithm}{hint}")
    for key in ("policy", "n_timesteps"):
        if key not in hyperparams:
            raise ConfigurationError(f"The settings of {algorithm} must hold {key}, which the Zoo reads even with -n")
    if not isinstance(hyperparams["policy"], str):
        raise ConfigurationError(f"policy must be a name, or the path of a class, got {hyperparams['policy']!r}")
    for key, value in hyperparams.items():
        if isinstance(value, str):
            if re.fullmatch(r"[-+\d.]+e[-+\d]+", value, re.IGNORECASE):
                raise ConfigurationError(f"{key} is the text {value!r}, as YAML reads it: write !!float {value}")
            if key in scheduled_keys(algorithm) and not LINEAR.fullmatch(value):
                raise ConfigurationError(f"{key} must be a number, or lin_NUMBER to fall linearly to 0, got {value!r}")
    for key in ("policy_kwargs", "monitor_kwargs", "env_kwargs"):
        as_dict(key, hyperparams.get(key))
    if not isinstance(hyperparams.get("normalize"), bool):
        as_dict("normalize", hyperparams.get("normalize"))
    for key in ("n_envs", "frame_stack"):
        check_integer(key, hyperparams.get(key, 1), 1)
    check_number("n_timesteps", hyperparams["n_timesteps"], 1)
    if optimize and (hyperparams.get("n_episodes") or hyperparams.get("baseline", "value") != "value"):
        raise ConfigurationError(
            "-optimize samples n_steps and gae_lambda, which need baseline='value' and no n_episodes, got "
            f"baseline={hyperparams.get('baseline', 'value')!r} and n_episodes={hyperparams.get('n_episodes')!r}"
        )


def as_dict(key: str, value: Any) -> Settings:
    """A setting as a dict: the Zoo evaluates a text as Python, with the names of the module `exp_manager`."""
    result = {} if value is None else value
    if isinstance(value, str) and key != "env_kwargs":
        try:
            result = eval(value, dict(vars(exp_manager)))
        except Exception as error:
            raise ConfigurationError(f"{key} must be Python, but {value!r} raises {error!r}") from error
    if not isinstance(result, dict):
        raise ConfigurationError(f"{key} must be a dict, got {value!r}")
    return result
