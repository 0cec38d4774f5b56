"""The RL Zoo's commands, with REINFORCE and FiniteDifference: ``python -m sb3_reinforce.zoo <command> ...``."""

import argparse
import difflib
import importlib
import runpy
import subprocess
import sys
from typing import Any
from unittest import mock

import gymnasium as gym
from rl_zoo3.utils import StoreDict

from sb3_reinforce.zoo import ALGORITHMS

FUNCTIONS = {
    "train": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "plot_train": "rl_zoo3.plots.plot_train",
    "all_plots": "rl_zoo3.plots.all_plots",
    "plot_from_file": "rl_zoo3.plots.plot_from_file",
}
SCRIPTS = {"record_video": "rl_zoo3.record_video", "benchmark": "rl_zoo3.benchmark"}
COMMANDS = (*FUNCTIONS, *SCRIPTS)
NOT_OFFERED = {
    "push_to_hub": "the Zoo's push_to_hub cannot be imported with any huggingface_sb3 that it can be installed with",
    "load_from_hub": "it only downloads the Zoo's own models: python -m rl_zoo3.load_from_hub",
    "record_training": "record the checkpoints one by one: record_video --load-checkpoint STEPS",
}


def run_script(module: str) -> None:
    """
    Run a script of the Zoo's. Its benchmark calls ``python enjoy.py`` in the current folder: let that be ours.

    :param module: The module that is a script
    """
    call = subprocess.call

    def call_enjoy(command: list[str], **kwargs: Any) -> int:
        if command[:2] == ["python", "enjoy.py"]:
            command = [sys.executable, "-m", "sb3_reinforce.zoo", "enjoy", *command[2:]]
        return call(command, **kwargs)

    with mock.patch.object(subprocess, "call", call_enjoy):
        runpy.run_module(module, run_name="__main__")


def check(parser: argparse.ArgumentParser, command: str, arguments: list[str]) -> None:
    """
    Say what is wrong with arguments that the Zoo would accept, ignore or stumble over.

    :param parser: Exits with a sentence
    :param command: The Zoo's command
    :param arguments: Those of the command
    """
    if command not in ("train", "enjoy", "record_video"):
        return
    known = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    known.add_argument("--env")
    known.add_argument("--algo")
    known.add_argument("--gym-packages", nargs="+", default=[])
    known.add_argument("-f", "--folder")
    known.add_argument("--storage")
    known.add_argument("--study-name")
    known.add_argument("--trial-id")
    for names in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",)):
        known.add_argument(*names, nargs="+", action=StoreDict)
    try:
        given, _ = known.parse_known_args(arguments)
    except (NameError, SyntaxError) as error:
        parser.error(f"a value is Python, and this one is not ({error}); write a text as key:\"'text'\"")
    for package in given.gym_packages:
        importlib.import_module(package)
    if given.env is not None and given.env not in gym.registry:
        near = difflib.get_close_matches(given.env, gym.registry, n=1)
        parser.error(
            f"--env {given.env} is not registered{f', but {near[0]} is' if near else ''}; an environment of another "
            "package needs --gym-packages PACKAGE"
        )
    if command == "train" and given.trial_id and not (given.storage and given.study_name):
        parser.error("--trial-id needs --storage and --study-name: without them the Zoo ignores it")
    if command != "train" and given.algo in ALGORITHMS and given.folder is None:
        parser.error(f"there are no published models of {given.algo}: pass the folder of your own, such as -f logs")


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
    check(parser, command, arguments)
    sys.argv = [f"{parser.prog} {command}", *arguments]
    try:
        if command in FUNCTIONS:
            getattr(importlib.import_module(FUNCTIONS[command]), command)()
        else:
            run_script(SCRIPTS[command])
    except ModuleNotFoundError as error:
        parser.error(f"{error}. What the Zoo's commands need comes with pip install 'sb3-reinforce[zoo]'")
    except gym.error.DependencyNotInstalled as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
