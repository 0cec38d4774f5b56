"""An experiment of the RL Zoo that finds, checks and converts the settings of REINFORCE and FiniteDifference."""

import importlib
import re
import runpy
from collections import OrderedDict
from pathlib import Path
from pprint import pprint
from typing import Any

import gymnasium as gym
import rl_zoo3
import yaml
from gymnasium import spaces
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce.zoo.configuration import (
    ALGORITHMS,
    HYPERPARAMS,
    LINEAR,
    ConfigurationError,
    Settings,
    allowed_keys,
    as_dict,
    check_hyperparams,
    scheduled_keys,
)


class Experiment(ExperimentManager):
    """
    The Zoo's ``ExperimentManager`` for ``reinforce`` and ``finite_difference``.

    Without the keyword ``config`` the settings are read from ``HYPERPARAMS``, or from the model whose training
    continues. The default entry is fitted to the spaces of the environment. Trial 0 of a study counts as a trial. A
    text ``lin_NUMBER`` becomes a schedule in every argument that may be one. A wrong setting raises a ``ValueError`` or
    a ``TypeError`` that names it.

    :param arguments: Positional arguments of ``ExperimentManager``
    :param kwargs: Keyword arguments of ``ExperimentManager``
    """

    def __init__(self, *arguments: Any, **kwargs: Any):
        super().__init__(*arguments, **kwargs)
        self.model_config: Path | None = None
        self.argument_names = allowed_keys(self.algo)
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
            named = re.findall(r"(?:^Invalid value for |^|, got |unexpected keyword argument ')(\w+)", str(error))
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
        check_hyperparams(self.algo, found, self.optimize_hyperparameters)
        for key in ("policy_kwargs", "env_kwargs"):
            self.argument_names |= as_dict(key, found.get(key)).keys()
        saved = OrderedDict(sorted(found.items()))
        pprint(saved)
        return found, saved

    def _preprocess_hyperparams(self, hyperparams: Settings) -> tuple[Any, ...]:
        """Convert texts as the Zoo does, and ``lin_NUMBER`` in every argument that may be a schedule."""
        # The Zoo converts two of them, to a class without which the saved model could not be loaded. No public method
        # stands between the settings and the model
        linear = {}
        for key in scheduled_keys(self.algo) & hyperparams.keys():
            if isinstance(hyperparams[key], str) and (start := LINEAR.fullmatch(hyperparams[key])):
                linear[key] = LinearSchedule(float(start[1]), 0.0, 1.0)
        others = {key: value for key, value in hyperparams.items() if key not in linear}
        processed, *rest = super()._preprocess_hyperparams(others)
        return processed | linear, *rest


def make_experiment(args: Any, algo: str, *others: Any, **kwargs: Any) -> ExperimentManager:
    """Make an ``Experiment`` for the algorithms of this package, and the Zoo's ``ExperimentManager`` for others."""
    return (Experiment if algo in ALGORITHMS else ExperimentManager)(args, algo, *others, **kwargs)


def find_settings(experiment: Experiment) -> Settings:
    """Read the entry of the environment, ``atari`` or ``default``, or the settings of the model that continues."""
    if experiment.model_config is not None:
        print(f"Continuing with the settings of the model: {experiment.model_config}")
        # The Zoo writes an OrderedDict, which safe_load refuses
        return dict(yaml.unsafe_load(experiment.model_config.read_text()))
    config, env_id = experiment.config, experiment.env_name.gym_id
    print(f"Loading hyperparameters from: {config}")
    published = load_configuration(config)
    if not isinstance(published, dict):
        raise ConfigurationError(f"{config} must map environments to settings, got a {type(published).__name__}")
    fallback = "atari" if experiment.is_atari(env_id) else "default"
    if env_id not in published and fallback not in published:
        raise ConfigurationError(f"{config} must have an entry {env_id} or {fallback}")
    key = env_id if env_id in published else fallback
    if not isinstance(published[key], dict):
        raise ConfigurationError(
            f"The entry {key} of {config} must hold settings, such as policy: 'MlpPolicy', got {published[key]!r}"
        )
    found = dict(published[key])
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
        fitted["policy"] = "MultiInputPolicy"
    return fitted
