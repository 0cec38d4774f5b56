"""The RL Zoo's commands, with REINFORCE and FiniteDifference: ``python -m sb3_reinforce.zoo <command> ...``."""

import argparse
import difflib
import importlib
import os
import runpy
import subprocess
import sys
from typing import Any
from unittest import mock

import gymnasium as gym
from huggingface_hub.errors import HTTPError
from rl_zoo3 import utils

from sb3_reinforce.zoo import ALGORITHMS
from sb3_reinforce.zoo.configuration import ConfigurationError

FUNCTIONS = {
    "train": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "plot_train": "rl_zoo3.plots.plot_train",
    "all_plots": "rl_zoo3.plots.all_plots",
    "plot_from_file": "rl_zoo3.plots.plot_from_file",
}
SCRIPTS = {"record_video": "rl_zoo3.record_video", "benchmark": "rl_zoo3.benchmark"}
COMMANDS = (*FUNCTIONS, *SCRIPTS)
CHECKED = ("train", "enjoy", "record_video", "benchmark")
# What the extra brings and `import rl_zoo3` does not need
EXTRA = {"matplotlib", "pandas", "requests", "rliable", "scipy", "seaborn"}
NOT_OFFERED = {
    "push_to_hub": "the Zoo's push_to_hub cannot be imported with any huggingface_sb3 that it can be installed with",
    "load_from_hub": "it only downloads the Zoo's own models: python -m rl_zoo3.load_from_hub",
    "record_training": "record the checkpoints one by one: record_video --load-checkpoint STEPS",
}


def run_script(module: str) -> None:
    """
    Run a script of the Zoo's. Its benchmark calls ``python enjoy.py`` in the current folder: let that be ours.

    :param module: The module that is a script
    :raises ConfigurationError: If the benchmark cannot reach the Hugging Face hub
    """
    call, ask_hub = subprocess.call, utils.get_hf_trained_models

    def call_enjoy(command: list[str], **kwargs: Any) -> int:
        if command[:2] == ["python", "enjoy.py"]:
            command = [sys.executable, "-m", "sb3_reinforce.zoo", "enjoy", *command[2:]]
        return call(command, **kwargs)

    def models_of_hub() -> dict[str, tuple[str, str]]:
        try:
            models: dict[str, tuple[str, str]] = ask_hub()
        except (OSError, HTTPError) as error:
            raise ConfigurationError(f"the Hugging Face hub does not answer ({error}): pass --no-hub") from error
        return models

    with (
        mock.patch.object(subprocess, "call", call_enjoy),
        mock.patch.object(utils, "get_hf_trained_models", models_of_hub),
    ):
        runpy.run_module(module, run_name="__main__")


def check_key_value(text: str) -> None:
    """
    Check an argument of the Zoo's kind, whose values are Python.

    :param text: KEY:VALUE
    :raises ArgumentTypeError: If it is not
    """
    _, colon, value = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r} must be KEY:VALUE")
    try:
        eval(value, dict(vars(utils)))
    except Exception as error:
        hint = f"of {text!r} the value must be Python, but it says {error!r}; write a text as KEY:\"'TEXT'\""
        raise argparse.ArgumentTypeError(hint) from error


def import_packages(command: str, arguments: list[str]) -> list[str]:
    """
    Import the packages that register environments.

    :param command: The Zoo's command
    :param arguments: Those of the command
    :return: What the command is to get: the Zoo's record_video does not know ``--gym-packages``
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    given, others = parser.parse_known_args(arguments)
    for package in given.gym_packages:
        importlib.import_module(package)
    return others if command == "record_video" else arguments


def check(parser: argparse.ArgumentParser, command: str, arguments: list[str]) -> None:
    """
    Say what is wrong with arguments that the Zoo would accept, ignore or stumble over.

    :param parser: Exits with a sentence
    :param command: The Zoo's command
    :param arguments: Those of the command
    """
    known = argparse.ArgumentParser(parser.prog, parser.usage, add_help=False, allow_abbrev=False)
    known.add_argument("--env")
    known.add_argument("--algo")
    known.add_argument("-f", "--folder")
    known.add_argument("-i", "--trained-agent")
    known.add_argument("--storage")
    known.add_argument("--study-name")
    known.add_argument("--trial-id")
    known.add_argument("--log-dir", default="rl-trained-agents/")
    known.add_argument("--no-hub", action="store_true")
    for names in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",)):
        known.add_argument(*names, nargs="+", type=check_key_value)
    given, _ = known.parse_known_args(arguments)
    if command == "benchmark":
        if not os.path.isdir(given.log_dir):
            parser.error(f"--log-dir {given.log_dir} is not a folder: pass that of your models, such as logs")
        if given.no_hub and not utils.get_trained_models(given.log_dir):
            parser.error(f"--log-dir {given.log_dir} holds no trained models: pass the folder that train has written")
        return
    if given.env is not None and given.env not in gym.registry:
        near = difflib.get_close_matches(given.env, gym.registry, n=1)
        parser.error(
            f"--env {given.env} is not registered{f', but {near[0]} is' if near else ''}; an environment of another "
            "package needs --gym-packages PACKAGE"
        )
    if command != "train":
        if given.algo in ALGORITHMS and given.folder is None:
            parser.error(f"there are no published models of {given.algo}: pass the folder of your own, such as -f logs")
        return
    if given.trial_id and not (given.storage and given.study_name):
        parser.error("--trial-id needs --storage and --study-name: without them the Zoo ignores it")
    if given.trained_agent and not (given.trained_agent.endswith(".zip") and os.path.isfile(given.trained_agent)):
        parser.error(f"--trained-agent {given.trained_agent} is not the .zip file of a model")


def main() -> None:
    """Run one of the Zoo's commands with the arguments of the command line."""
    parser = argparse.ArgumentParser(
        prog="sb3-reinforce-zoo", description=__doc__, usage="%(prog)s [-h] {" + ",".join(COMMANDS) + "} ..."
    )
    parser.add_argument("command")
    command = parser.parse_args(sys.argv[1:2]).command
    if command in NOT_OFFERED:
        parser.error(f"{command} is not offered: {NOT_OFFERED[command]}")
    if command not in COMMANDS:
        parser.error(f"there is no command {command!r}, only {', '.join(COMMANDS)}")
    arguments = sys.argv[2:]
    try:
        if command in CHECKED and not {"-h", "--help"} & {*arguments}:
            arguments = import_packages(command, arguments)
            check(parser, command, arguments)
        sys.argv = [f"{parser.prog} {command}", *arguments]
        if command in FUNCTIONS:
            getattr(importlib.import_module(FUNCTIONS[command]), command)()
        else:
            run_script(SCRIPTS[command])
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        hint = "it comes with pip install 'sb3-reinforce[zoo]'" if missing in EXTRA else "install it, or mend its name"
        parser.error(f"{error}: {hint}")
    except (ConfigurationError, gym.error.DependencyNotInstalled, ImportError) as error:
        parser.error(str(error))
    except ValueError as error:
        if command != "plot_from_file" or "empty sequence" not in str(error):
            raise
        parser.error(
            "no algorithm has two runs with evaluations at the same steps: all_plots keeps only such runs, and with "
            "--max-timesteps more of them"
        )


if __name__ == "__main__":
    main()
