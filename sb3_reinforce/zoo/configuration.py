"""How the Zoo finds the settings of REINFORCE and FiniteDifference, and what it is told when one is wrong."""

import difflib
import inspect
import re
from pathlib import Path
from typing import Any

import rl_zoo3
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_reinforce import REINFORCE, FiniteDifference

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"reinforce": REINFORCE, "finite_difference": FiniteDifference}
HYPERPARAMS = Path(__file__).parent / "hyperparams"
ZOO_HYPERPARAMS = Path(rl_zoo3.__file__).parent / "hyperparams"
# What the Zoo takes out of a configuration, and what it passes to an algorithm itself
ZOO_KEYS = {
    "n_timesteps", "n_envs", "normalize", "env_wrapper", "vec_env_wrapper", "callback", "frame_stack", "env_kwargs",
    "monitor_kwargs",
}  # fmt: skip
GIVEN_BY_ZOO = {"self", "env", "tensorboard_log", "seed", "verbose", "device", "_init_setup_model"}
Settings = tuple[dict[str, Any], dict[str, Any]]
SCHEDULED = {"learning_rate", "delta_std"}


def read_ours_too() -> None:
    """Let every ``ExperimentManager`` read the settings of this package for its algorithms, and check them."""
    read_zoo = ExperimentManager.read_hyperparameters

    def read_hyperparameters(self: ExperimentManager) -> Settings:
        ours = self.algo in ALGORITHMS
        if ours and Path(self.config) == ZOO_HYPERPARAMS / f"{self.algo}.yml":
            self.config = str(HYPERPARAMS / f"{self.algo}.yml")
        if ours and self.storage and self.study_name and self.trial_id == 0:
            # The Zoo takes 0 for no trial
            trial = self.load_trial(self.storage, self.study_name, 0)
            self.custom_hyperparams = {**trial, **(self.custom_hyperparams or {})}
        settings: Settings = read_zoo(self)
        if ours:
            check_hyperparams(self.algo, settings[0], self.optimize_hyperparameters)
        return settings

    type.__setattr__(ExperimentManager, "read_hyperparameters", read_hyperparameters)


def check_hyperparams(algorithm: str, hyperparams: dict[str, Any], optimize: bool) -> None:
    """
    Check what the Zoo would stumble over; the values themselves are checked by the algorithm.

    :param algorithm: ``"reinforce"`` or ``"finite_difference"``
    :param hyperparams: The entry of a configuration
    :param optimize: Whether Optuna will replace some of it
    :raises ValueError: If a setting is missing, unknown or cannot be read
    """
    allowed = inspect.signature(ALGORITHMS[algorithm].__init__).parameters.keys() - GIVEN_BY_ZOO | ZOO_KEYS
    for key in hyperparams:
        if key not in allowed:
            near = difflib.get_close_matches(str(key), allowed, n=1) or sorted(allowed)
            raise ValueError(f"{key!r} is not a setting of {algorithm}: did you mean {' or '.join(near)}?")
    for key in ("policy", "n_timesteps"):
        if key not in hyperparams:
            raise ValueError(f"The settings of {algorithm} must hold {key}, which the Zoo reads even with -n")
    for key, value in hyperparams.items():
        if isinstance(value, str) and re.fullmatch(r"[-+\d.]+e[-+\d]+", value, re.IGNORECASE):
            raise ValueError(f"{key} is the text {value!r}, as YAML reads it: write !!float {value}")
        if key in SCHEDULED and isinstance(value, str) and not re.fullmatch(r"lin_[-+\d.e]+", value):
            raise ValueError(f"{key} must be a number, or lin_NUMBER to let it fall to 0, got {value!r}")
    if optimize and (hyperparams.get("n_episodes") or hyperparams.get("baseline", "value") != "value"):
        raise ValueError(
            "-optimize samples n_steps and gae_lambda, which need baseline='value' and no n_episodes, got "
            f"baseline={hyperparams.get('baseline', 'value')!r} and n_episodes={hyperparams.get('n_episodes')!r}"
        )
