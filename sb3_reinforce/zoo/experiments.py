"""How the Zoo's experiments find, check and convert the settings of REINFORCE and FiniteDifference."""

import functools
import importlib
import inspect
import re
import runpy
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from pprint import pprint
from typing import Any

import gymnasium as gym
import rl_zoo3
import yaml
from gymnasium import spaces
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce.zoo.configuration import (
    ALGORITHMS,
    HYPERPARAMS,
    LINEAR,
    ConfigurationError,
    check_hyperparams,
    scheduled,
    settings,
)

Method = Callable[..., Any]
Settings = dict[str, Any]
# Of an installed Zoo, and of a cloned one
ZOO_FOLDERS = [folder / "hyperparams" for folder in Path(rl_zoo3.__file__).parents[:2]]


def extend_experiments() -> None:
    """Let every ``ExperimentManager`` use the functions of this module for the algorithms of this package."""
    for ours in (read_hyperparameters, _preprocess_hyperparams, setup_experiment):
        _extend(ours)


def _extend(ours: Method) -> None:
    # Unwrapped: after a reload of this module ours would otherwise get ours
    zoos = inspect.unwrap(getattr(ExperimentManager, ours.__name__))

    @functools.wraps(zoos)
    def method(manager: ExperimentManager, *arguments: Any) -> Any:
        if manager.algo in ALGORITHMS:
            return ours(zoos, manager, *arguments)
        return zoos(manager, *arguments)

    setattr(ExperimentManager, ours.__name__, method)


def setup_experiment(zoos: Method, manager: ExperimentManager) -> Any:
    """
    Make a model as the Zoo does, and tell errors of its configuration from others.

    :param zoos: The Zoo's method
    :param manager: The experiment
    :return: The Zoo's result
    :raises ConfigurationError: If an error names a setting, or one of ``policy_kwargs``, where the errors of this
        package do, first or as what they got, or as unexpected
    """
    try:
        return zoos(manager)
    except AssertionError as error:
        # Of Stable-Baselines3, of a policy and the spaces that it does not go with
        raise ConfigurationError(str(error)) from error
    except (TypeError, ValueError) as error:
        names = settings(manager.algo) | (manager._hyperparams.get("policy_kwargs") or {}).keys()
        pattern = r"(?:^Invalid value for |^|, got |unexpected keyword argument ')(\w+)"
        if names.isdisjoint(word.lower() for word in re.findall(pattern, str(error))):
            raise
        raise ConfigurationError(str(error)) from error


def read_hyperparameters(zoos: Method, manager: ExperimentManager) -> tuple[Settings, Settings]:
    """
    Read the settings as the Zoo does, but those of a model that goes on from where the Zoo has written them, and trial
    0 too, which the Zoo takes for none.

    :param zoos: The Zoo's method, which reads only its own
    :param manager: The experiment
    :return: The settings, and a sorted copy to be written beside the model
    :raises ConfigurationError: If they cannot be found
    :raises TypeError: See ``check_hyperparams``
    :raises ValueError: See ``check_hyperparams``
    """
    found = _find(manager)
    if manager.storage and manager.study_name and manager.trial_id is not None:
        try:
            found.update(manager.load_trial(manager.storage, manager.study_name, manager.trial_id))
        except (KeyError, IndexError) as error:
            raise ConfigurationError(
                f"There is no trial {manager.trial_id} of {manager.algo} in a study {manager.study_name!r} of "
                f"{manager.storage}: pass another --trial-id, --study-name or --storage"
            ) from error
    found.update(manager.custom_hyperparams or {})
    if "env_kwargs" in found and manager.env_kwargs:
        found["env_kwargs"] = manager.env_kwargs
    check_hyperparams(manager.algo, found, manager.optimize_hyperparameters)
    saved = OrderedDict(sorted(found.items()))
    pprint(saved)
    return found, saved


def _find(manager: ExperimentManager) -> Settings:
    """The entry of a configuration, of its own where the user has named none."""
    if Path(manager.config) in [folder / f"{manager.algo}.yml" for folder in ZOO_FOLDERS]:
        manager.config = str(HYPERPARAMS / f"{manager.algo}.yml")
        of_model = Path(manager.trained_agent).parent / manager.env_name / "config.yml"
        if manager.continue_training and of_model.is_file():
            print(f"Going on with the settings of the model: {of_model}")
            # The Zoo has written an OrderedDict, which safe_load refuses
            return dict(yaml.unsafe_load(of_model.read_text()))
    print(f"Loading hyperparameters from: {manager.config}")
    published = _load(manager.config)
    if not isinstance(published, dict):
        raise ConfigurationError(
            f"{manager.config} must map environments to settings, got a {type(published).__name__}"
        )
    fallback = "atari" if manager._is_atari else "default"
    key = next((key for key in (manager.env_name.gym_id, fallback) if key in published), None)
    if key is None:
        raise ConfigurationError(f"{manager.config} must have an entry {manager.env_name.gym_id} or {fallback}")
    if not isinstance(published[key], dict):
        raise ConfigurationError(
            f"The entry {key} of {manager.config} must hold settings, such as policy: 'MlpPolicy', got "
            f"{published[key]!r}"
        )
    found = dict(published[key])
    return _fitting(found, manager) if key == "default" else found


def _load(config: str) -> Any:
    try:
        if config.endswith((".yml", ".yaml")):
            return yaml.safe_load(Path(config).read_text())
        if config.endswith(".py"):
            return runpy.run_path(config)["hyperparams"]
    except (OSError, yaml.YAMLError) as error:
        raise ConfigurationError(f"{config} cannot be read: {error}") from error
    return importlib.import_module(config).hyperparams


def _fitting(default: Settings, manager: ExperimentManager) -> Settings:
    """Those of ``default`` that go with the environment's spaces: it was written for any environment."""
    given = {**default, **(manager.custom_hyperparams or {})}
    env = gym.make(manager.env_name.gym_id, **(manager.env_kwargs or given.get("env_kwargs", {})))
    wrap = rl_zoo3.get_wrapper_class(given)
    env = wrap(env) if wrap else env
    env.close()
    space, unfit = env.observation_space, set()
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    if not all(isinstance(part, spaces.Box) for part in parts):
        unfit.add("normalize")
    if isinstance(env.action_space, spaces.Box):
        unfit.add("temperature")
    fitting = {key: value for key, value in default.items() if key not in unfit}
    return fitting | ({"policy": "MultiInputPolicy"} if isinstance(space, spaces.Dict) else {})


def _preprocess_hyperparams(zoos: Method, manager: ExperimentManager, hyperparams: Settings) -> tuple[Any, ...]:
    """
    Turn texts into what they stand for as the Zoo does, and ``lin_NUMBER`` in every argument that may be a schedule.

    The Zoo does so only in ``learning_rate`` and ``delta_std``, and with a class of its own, without which a model
    could not be loaded.

    :param zoos: The Zoo's method
    :param manager: The experiment
    :param hyperparams: The settings
    :return: The Zoo's result
    """
    linear = {}
    for key in scheduled(manager.algo) & hyperparams.keys():
        if isinstance(hyperparams[key], str) and (start := LINEAR.fullmatch(hyperparams[key])):
            linear[key] = LinearSchedule(float(start[1]), 0.0, 1.0)
    processed, *others = zoos(manager, {key: value for key, value in hyperparams.items() if key not in linear})
    return processed | linear, *others
