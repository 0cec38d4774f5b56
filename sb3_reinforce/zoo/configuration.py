"""What the settings of REINFORCE and FiniteDifference may be in the Zoo, and what is said when one is wrong."""

import difflib
import inspect
import re
from pathlib import Path
from typing import Any, get_args

from rl_zoo3 import exp_manager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import Schedule

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.common.arguments import check_integer, check_number

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"reinforce": REINFORCE, "finite_difference": FiniteDifference}
HYPERPARAMS = Path(__file__).parent / "hyperparams"
# What the Zoo takes out of a configuration, and what it passes to an algorithm itself
ZOO_KEYS = {
    "n_timesteps", "n_envs", "normalize", "env_wrapper", "vec_env_wrapper", "callback", "frame_stack", "env_kwargs",
    "monitor_kwargs",
}  # fmt: skip
GIVEN_BY_ZOO = {"self", "env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}
LINEAR = re.compile(r"lin_([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)", re.IGNORECASE)


class ConfigurationError(ValueError):
    """A wrong setting: of this error the command line shows the sentence alone."""


def settings(algorithm: str) -> set[str]:
    """
    :param algorithm: ``"reinforce"`` or ``"finite_difference"``
    :return: The keys that its entry in a configuration may have
    """
    return inspect.signature(ALGORITHMS[algorithm].__init__).parameters.keys() - GIVEN_BY_ZOO | ZOO_KEYS


def scheduled(algorithm: str) -> set[str]:
    """
    :param algorithm: ``"reinforce"`` or ``"finite_difference"``
    :return: Its arguments that may be schedules
    """
    parameters = inspect.signature(ALGORITHMS[algorithm].__init__).parameters.values()
    return {parameter.name for parameter in parameters if Schedule in get_args(parameter.annotation)}


def check_hyperparams(algorithm: str, hyperparams: dict[str, Any], optimize: bool) -> None:
    """
    Check what the Zoo would stumble over; the values themselves are checked by the algorithm.

    :param algorithm: ``"reinforce"`` or ``"finite_difference"``
    :param hyperparams: The entry of a configuration
    :param optimize: Whether Optuna will replace some of it
    :raises TypeError: If the number of environments or of steps is none
    :raises ValueError: If a setting is missing, unknown, out of its range or cannot be read
    """
    allowed = settings(algorithm)
    for key in hyperparams:
        if key not in allowed:
            near = difflib.get_close_matches(str(key), allowed, n=1) or sorted(allowed)
            raise ConfigurationError(f"{key!r} is not a setting of {algorithm}: did you mean {' or '.join(near)}?")
    for key in ("policy", "n_timesteps"):
        if key not in hyperparams:
            raise ConfigurationError(f"The settings of {algorithm} must hold {key}, which the Zoo reads even with -n")
    if not isinstance(hyperparams["policy"], str):
        raise ConfigurationError(f"policy must be a name, or the path of a class, got {hyperparams['policy']!r}")
    for key, value in hyperparams.items():
        if isinstance(value, str):
            _check_text(key, value, key in scheduled(algorithm))
    for key in hyperparams.keys() & {"normalize", "policy_kwargs", "monitor_kwargs"}:
        _check_dict(key, hyperparams[key])
    if not isinstance(hyperparams.get("env_kwargs", {}), dict):
        raise ConfigurationError(f"env_kwargs must be a dict, got {hyperparams['env_kwargs']!r}")
    for key in ("n_envs", "frame_stack"):
        check_integer(key, hyperparams.get(key, 1), 1)
    check_number("n_timesteps", hyperparams["n_timesteps"], 1)
    if optimize and (hyperparams.get("n_episodes") or hyperparams.get("baseline", "value") != "value"):
        raise ConfigurationError(
            "-optimize samples n_steps and gae_lambda, which need baseline='value' and no n_episodes, got "
            f"baseline={hyperparams.get('baseline', 'value')!r} and n_episodes={hyperparams.get('n_episodes')!r}"
        )


def _check_text(key: str, value: str, may_fall: bool) -> None:
    if re.fullmatch(r"[-+\d.]+e[-+\d]+", value, re.IGNORECASE):
        raise ConfigurationError(f"{key} is the text {value!r}, as YAML reads it: write !!float {value}")
    if may_fall and not LINEAR.fullmatch(value):
        raise ConfigurationError(f"{key} must be a number, or lin_NUMBER to let it fall to 0, got {value!r}")


def _check_dict(key: str, value: Any) -> None:
    """Of a text the Zoo takes the value in Python, with the names of its own module."""
    result = value
    if isinstance(value, str):
        try:
            result = eval(value, dict(vars(exp_manager)))
        except Exception as error:
            raise ConfigurationError(f"{key} must be Python, but of {value!r} it says {error!r}") from error
    if not (isinstance(result, dict) or (key == "normalize" and isinstance(value, bool))):
        raise ConfigurationError(f"{key} must be a dict, or Python for one such as 'dict(KEY=VALUE)', got {value!r}")
