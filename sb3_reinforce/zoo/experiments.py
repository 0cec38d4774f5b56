"""Experiments of the RL Zoo with the algorithms of this package: their settings are found, checked and converted."""

import importlib
import re
import runpy
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from pprint import pprint
from typing import Any, get_args

import gymnasium as gym
import rl_zoo3
import yaml
from gymnasium import spaces
from rl_zoo3 import exp_manager, utils
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce.common.arguments import check_integer, check_number, own_arguments, unknown_name
from sb3_reinforce.common.base import BasePolicyGradient
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.recurrent import RecurrentREINFORCE
from sb3_reinforce.reinforce import REINFORCE

Settings = dict[str, Any]
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "reinforce": REINFORCE,
    "reinforce_lstm": RecurrentREINFORCE,
    "finite_difference": FiniteDifference,
}
HYPERPARAMS = Path(__file__).parent / "hyperparams"
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


class Experiment(exp_manager.ExperimentManager):
    """
    The Zoo's ``ExperimentManager`` for ``reinforce``, ``reinforce_lstm`` and ``finite_difference``.

    Without the keyword ``config`` the settings are read from ``HYPERPARAMS``, or from the model whose training
    continues. The default entry is fitted to the spaces of the environment. Trial 0 of a study counts as a trial. A
    text ``lin_NUMBER`` becomes a schedule in every argument that may be one. ``train_env_kwargs`` are keyword arguments
    of the training environments alone. A wrong setting raises a ``ValueError`` or a ``TypeError`` that names it.

    :param arguments: Positional arguments of ``ExperimentManager``
    :param kwargs: Keyword arguments of ``ExperimentManager``
    """

    def __init__(self, *arguments: Any, **kwargs: Any):
        super().__init__(*arguments, **kwargs)
        self.model_config: Path | None = None
        self.argument_names = allowed_keys(self.algo) | ZOO_ARGUMENTS | {"observation_space", "action_space"}
        if kwargs.get("config") is None:
            self.config = str(HYPERPARAMS / f"{self.algo}.yml")
            written = Path(self.trained_agent).parent / self.env_name / "config.yml"
            if self.continue_training and written.is_file():
                self.model_config = written

    def setup_experiment(self) -> tuple[BaseAlgorithm, Settings] | None:
        """Make the model as the Zoo does; a setting that the algorithm refuses raises a ``ConfigurationError``."""
        try:
            return super().setup_experiment()
        except (AssertionError, TypeError, ValueError) as error:
            # Stable-Baselines3 asserts that a policy supports the spaces; errors about an argument name it at these
            # places; all other errors keep their traceback
            named = re.findall(r"(?:^`?|, got |unexpected keyword argument ')(\w+)", str(error))
            if isinstance(error, AssertionError) or not self.argument_names.isdisjoint(map(str.lower, named)):
                raise ConfigurationError(str(error)) from error
            raise

    def read_hyperparameters(self) -> tuple[Settings, Settings]:
        """Return the settings, checked, and a sorted copy, which the Zoo writes beside the model."""
        found = find_settings(self)
        # The Zoo takes trial 0 for none
        if self.storage and self.study_name and self.trial_id is not None:
            try:
                found.update(self.load_trial(self.storage, self.study_name, self.trial_id))
            except (KeyError, IndexError) as error:
                raise ConfigurationError(
                    f"There is no trial {self.trial_id} of {self.algo} in a study {self.study_name!r} of "
                    f"{self.storage}: pass another --trial-id, --study-name or --storage"
                ) from error
        found.update(self.custom_hyperparams or {})
        if "env_kwargs" in found and self.env_kwargs:
            found["env_kwargs"] = self.env_kwargs
        check_hyperparams(self.algo, found)
        keywords = {key: as_dict(key, found.get(key)) for key in (*PYTHON_KEYS, "env_kwargs", TRAIN_ENV_KWARGS)}
        # Evaluations are in the entry's environment too, unless the command line names another
        if self.eval_env_kwargs == self.env_kwargs:
            self.eval_env_kwargs = {**keywords["env_kwargs"], **self.env_kwargs}
        for names in (*keywords.values(), *(names for _, _, names in classes_of(found))):
            self.argument_names |= names.keys()
        saved = OrderedDict(sorted(found.items()))
        pprint(saved)
        if found.pop(TRAIN_ENV_KWARGS, None):
            # The Zoo's commands read env_kwargs from the saved settings too, for the environments that they show
            found["env_kwargs"] = {**keywords["env_kwargs"], **keywords[TRAIN_ENV_KWARGS], **self.env_kwargs}
        return found, saved

    def _preprocess_schedules(self, hyperparams: Settings) -> Settings:  # type: ignore[override]
        """Convert ``lin_NUMBER`` in every argument that may be a schedule; the algorithms take numbers themselves."""
        # The Zoo converts two of them, to a class without which the saved model could not be loaded. No public method
        # stands between the settings and the model
        converted = dict(hyperparams)
        for key in scheduled_keys(self.algo) & hyperparams.keys():
            if isinstance(hyperparams[key], str) and (start := LINEAR.fullmatch(hyperparams[key])):
                converted[key] = LinearSchedule(float(start[1]), 0.0, 1.0)
        return converted


def make_experiment(args: Any, algo: str, *others: Any, **kwargs: Any) -> exp_manager.ExperimentManager:
    """Make an ``Experiment`` for the algorithms of this package, and the Zoo's ``ExperimentManager`` for others."""
    return (Experiment if algo in ALGORITHMS else exp_manager.ExperimentManager)(args, algo, *others, **kwargs)


def find_settings(experiment: Experiment) -> Settings:
    """Read the entry of the environment, ``atari`` or ``default``, or the settings of the model that continues."""
    if experiment.model_config is not None:
        print(f"Continuing with the settings of the model: {experiment.model_config}")
        # The Zoo writes an OrderedDict, which safe_load refuses
        return dict(yaml.unsafe_load(experiment.model_config.read_text()))
    config, env_id = experiment.config, experiment.env_name.gym_id
    print(f"Loading hyperparameters from: {config}")
    published = as_dict(f"The content of {config}", load_configuration(config))
    fallback = "atari" if experiment.is_atari(env_id) else "default"
    key = env_id if env_id in published else fallback
    if key not in published:
        raise ConfigurationError(f"{config} must have an entry {env_id} or {fallback}")
    found = dict(as_dict(f"The entry {key} of {config}", published[key]))
    train_env_kwargs = as_dict(TRAIN_ENV_KWARGS, published.get(TRAIN_ENV_KWARGS))
    if env_id in train_env_kwargs:
        found.setdefault(TRAIN_ENV_KWARGS, train_env_kwargs[env_id])
    return fit_default(found, experiment) if key == "default" else found


def load_configuration(config: str) -> Any:
    """Load what a YAML file, a Python file or a module holds, as the Zoo does."""
    try:
        if config.endswith((".yml", ".yaml")):
            return yaml.safe_load(Path(config).read_text())
        if config.endswith(".py"):
            return runpy.run_path(config)["hyperparams"]
    except (OSError, yaml.YAMLError) as error:
        raise ConfigurationError(f"{config} cannot be read: {error}") from error
    return importlib.import_module(config).hyperparams


def fit_default(default: Settings, experiment: Experiment) -> Settings:
    """Leave out the settings that do not go with the spaces of the environment, and use a policy that does."""
    given = {**default, **(experiment.custom_hyperparams or {})}
    check_hyperparams(experiment.algo, given)
    env = gym.make(experiment.env_name.gym_id, **(experiment.env_kwargs or given.get("env_kwargs") or {}))
    wrap = rl_zoo3.get_wrapper_class(given)
    env = wrap(env) if wrap else env
    env.close()
    fitted = dict(default)
    space = env.observation_space
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    if not all(isinstance(part, spaces.Box) for part in parts):
        fitted.pop("normalize", None)
    if isinstance(env.action_space, spaces.Box):
        fitted.pop("temperature", None)
    if isinstance(space, spaces.Dict):
        fitted["policy"] = "MultiInputLstmPolicy" if experiment.algo == "reinforce_lstm" else "MultiInputPolicy"
    return fitted


def allowed_keys(algorithm: str) -> set[str]:
    """The keys that an algorithm's entry in a configuration may have."""
    arguments = own_arguments(ALGORITHMS[algorithm], BasePolicyGradient)
    return arguments.keys() - ZOO_ARGUMENTS | ZOO_KEYS | {TRAIN_ENV_KWARGS}


def scheduled_keys(algorithm: str) -> set[str]:
    """The arguments of an algorithm that may be schedules."""
    arguments = own_arguments(ALGORITHMS[algorithm], BasePolicyGradient)
    return {name for name, argument in arguments.items() if Schedule in get_args(argument.annotation)}


def check_hyperparams(algorithm: str, hyperparams: Settings) -> None:
    """Raise an error for settings that the Zoo would fail on; the algorithm checks its own arguments."""
    allowed = allowed_keys(algorithm)
    for key in hyperparams:
        if key not in allowed:
            raise ConfigurationError(str(unknown_name(f"A setting of {algorithm}", "one of", sorted(allowed), key)))
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
    for key, path, _ in classes_of(hyperparams):
        try:
            utils.get_class_by_name(path)
        except (AttributeError, TypeError, ValueError) as error:
            raise ConfigurationError(f"{key} must be the path of a class, got {path!r}: {error}") from error
    for key in ("n_envs", "frame_stack"):
        check_integer(key, hyperparams.get(key, 1), 1)
    check_number("n_timesteps", hyperparams["n_timesteps"], 1)


def classes_of(hyperparams: Settings) -> Iterator[tuple[str, Any, Settings]]:
    """Each path of a class that the Zoo will import, with its setting before and its keyword arguments after it."""
    for key in CLASS_KEYS:
        given = hyperparams.get(key)
        for each in given if isinstance(given, list) else [given]:
            path, names = next(iter(each.items())) if isinstance(each, dict) and each else (each, {})
            is_name = key == "policy" and "." not in str(path)
            if names is None:
                raise ConfigurationError(f"The arguments of {path} in {key} must be a dict, got None")
            if not (is_name or path is None or isinstance(path, BaseCallback if key == "callback" else type)):
                yield key, path, as_dict(f"The arguments of {path} in {key}", names)


def as_dict(key: str, value: Any) -> Settings:
    """A setting as a dict: the Zoo evaluates a text as Python, with the names of the module `exp_manager`."""
    result = {} if value is None or (key == "normalize" and isinstance(value, bool)) else value
    if isinstance(value, str) and key in PYTHON_KEYS:
        try:
            result = eval(value, dict(vars(exp_manager)))
        except Exception as error:
            raise ConfigurationError(f"{key} must be Python, but {value!r} raises {error!r}") from error
    if not isinstance(result, dict):
        raise ConfigurationError(f"{key} must be a dict, got {value!r}")
    return result
