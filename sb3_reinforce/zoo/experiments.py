"""Experiments of the RL Zoo with the algorithms of this package: their settings are found, fitted and converted."""

import re
from collections import OrderedDict
from pathlib import Path
from pprint import pprint
from typing import Any

import gymnasium as gym
import rl_zoo3
import yaml
from gymnasium import spaces
from rl_zoo3 import exp_manager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule

from sb3_reinforce.common.processes import is_leader
from sb3_reinforce.zoo.settings import (
    ALGORITHMS,
    LINEAR,
    PYTHON_KEYS,
    TRAIN_ENV_KWARGS,
    ZOO_ARGUMENTS,
    ConfigurationError,
    Settings,
    allowed_keys,
    as_dict,
    check_hyperparams,
    classes_of,
    load_configuration,
    scheduled_keys,
)

HYPERPARAMS = Path(__file__).parent / "hyperparams"
# What Stable-Baselines3 says of normalize and --trained-agent
UNFIT = re.compile("VecNormalize only supports|(Observation|Action) spaces do not match")
# The policies that replace others where observations are dicts
FOR_DICTS = dict.fromkeys(("MlpPolicy", "CnnPolicy", "LinearPolicy"), "MultiInputPolicy")
FOR_DICTS |= dict.fromkeys(("MlpLstmPolicy", "CnnLstmPolicy"), "MultiInputLstmPolicy")


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
            # Stable-Baselines3 asserts with a sentence that it supports the spaces; errors about an argument name it at
            # these places; all other errors keep their traceback
            found = re.findall(r"(?:^`?|, got |unexpected keyword argument ')(\w+)", str(error))
            named = {*map(str.lower, found)}
            is_unsupported = (isinstance(error, AssertionError) and str(error)) or UNFIT.match(str(error))
            if not (is_unsupported or self.argument_names & named):
                raise
            source = ""
            in_files = self.argument_names - ZOO_ARGUMENTS - {"observation_space", "action_space"}
            if in_files & named and self.trial_id is None:
                source = f" (settings that -params does not give are from {self.model_config or self.config})"
            raise ConfigurationError(f"{error}{source}") from error

    def learn(self, model: BaseAlgorithm) -> None:
        """Train as the Zoo does, with callbacks in process 0 only: the Zoo ends the first of them itself."""
        if not is_leader():
            self.callbacks = []
        super().learn(model)

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
        if self.continue_training:
            # The model keeps its window, which load cannot replace
            found.pop("stats_window_size", None)
        replaced = self.custom_hyperparams or {}
        if self.continue_training and (fixed := {"policy", "policy_kwargs", "stats_window_size"} & replaced.keys()):
            raise ConfigurationError(f"--trained-agent keeps the model's {min(fixed)}: leave it out of -params")
        found.update(replaced)
        for key in ("env_kwargs", "vec_env_wrapper"):
            # enjoy fails where a key is there without a value
            if found.get(key, key) is None:
                del found[key]
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
        # The Zoo converts only two, to a class of the Zoo that loading the model would need. It has no public method to
        # override
        converted = dict(hyperparams)
        for key in scheduled_keys(self.algo) & hyperparams.keys():
            if isinstance(hyperparams[key], str) and (start := LINEAR.fullmatch(hyperparams[key])):
                converted[key] = LinearSchedule(float(start[1]), 0.0, 1.0)
        return converted


def make_experiment(args: Any, algo: str, *others: Any, **kwargs: Any) -> exp_manager.ExperimentManager:
    """Make an ``Experiment`` for the algorithms of this package, and the Zoo's ``ExperimentManager`` for others."""
    manager = Experiment if algo in ALGORITHMS else exp_manager.ExperimentManager
    return manager(args, algo, *others, **kwargs)


def find_settings(experiment: Experiment) -> Settings:
    """Read the entry of the environment, ``atari`` or ``default``, or the settings of the model that continues."""
    if experiment.model_config is not None:
        print(f"Continuing with the settings of the model: {experiment.model_config}")
        # The Zoo writes an OrderedDict, which safe_load refuses
        return dict(yaml.unsafe_load(experiment.model_config.read_text(encoding="utf-8")))
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


def fit_default(default: Settings, experiment: Experiment) -> Settings:
    """Leave out the settings that do not go with the spaces of the environment, and use a policy that does."""
    given = {**default, **(experiment.custom_hyperparams or {})}
    check_hyperparams(experiment.algo, given)
    env = gym.make(experiment.env_name.gym_id, **(experiment.env_kwargs or given.get("env_kwargs") or {}))
    wrap = rl_zoo3.get_wrapper_class(given)
    env = wrap(env) if wrap else env
    env.close()
    fitted = dict(default)
    if not can_be_normalized(env.observation_space, as_dict("normalize", default.get("normalize"))):
        fitted.pop("normalize", None)
    if isinstance(env.action_space, spaces.Box):
        fitted.pop("temperature", None)
    if isinstance(env.observation_space, spaces.Dict):
        fitted["policy"] = FOR_DICTS.get(given["policy"], given["policy"])
    return fitted


def can_be_normalized(space: spaces.Space[Any], normalize: Settings) -> bool:
    """Whether ``VecNormalize`` takes the observations with these arguments."""
    if not normalize.get("norm_obs", True):
        return True
    parts = [space]
    if isinstance(space, spaces.Dict):
        parts = [space.spaces.get(key, space) for key in normalize.get("norm_obs_keys") or space.spaces]
    return all(isinstance(part, spaces.Box) for part in parts)
