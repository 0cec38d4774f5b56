"""The RL Zoo's commands, with REINFORCE and FiniteDifference: ``python -m sb3_reinforce.zoo <command> ...``."""

import argparse
import contextlib
import difflib
import importlib
import io
import os
import runpy
import secrets
import subprocess
import sys
from collections.abc import Iterator
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
from rl_zoo3 import utils

from sb3_reinforce.common.arguments import unknown_name
from sb3_reinforce.common.processes import Processes, is_leader, rank_and_size
from sb3_reinforce.zoo import ALGORITHMS
from sb3_reinforce.zoo.settings import ConfigurationError

PLOTS = ("plot_train", "all_plots", "plot_from_file")
# Modules of the Zoo without a function
SCRIPTS = ("record_video", "benchmark")
COMMANDS = ("train", "enjoy", *PLOTS, *SCRIPTS)
NOT_OFFERED = {
    "push_to_hub": "it cannot be imported with the huggingface_sb3 of today: upload the folder with `hf upload`",
    "load_from_hub": "no models of these algorithms are published; for the Zoo's: python -m rl_zoo3.load_from_hub",
    "record_training": "record the checkpoints one by one: record_video --load-checkpoint STEPS",
}


def key_and_value(text: str) -> tuple[str, Any]:
    """A ``KEY:VALUE`` argument of the Zoo, which evaluates the value as Python with the names of its ``utils``."""
    key, colon, value = text.partition(":")
    if not colon:
        raise argparse.ArgumentTypeError(f"{text!r} must be KEY:VALUE")
    try:
        return key, eval(value, dict(vars(utils)))
    except Exception as error:
        message = f"the value of {text!r} must be Python ({error!r}); write a text as KEY:\"'TEXT'\""
        raise argparse.ArgumentTypeError(message) from error


def run_script(command: str) -> None:
    """Run a script of the Zoo; its benchmark calls ``python enjoy.py``, which becomes the ``enjoy`` of this module."""
    call = subprocess.call
    enjoy = [sys.executable, "-m", "sb3_reinforce.zoo", "enjoy"]
    if command == "benchmark":
        # A file enjoy.py would have to lie in the user's folder, and `python` may be another interpreter
        subprocess.call = lambda arguments: call([*enjoy, *arguments[2:]])  # type: ignore[assignment,misc]
    try:
        runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")
    finally:
        subprocess.call = call


@contextlib.contextmanager
def one_of_several(arguments: list[str]) -> Iterator[list[str]]:
    """The arguments of ``train`` with a seed that all processes share; process 0 alone prints and keeps its folder."""
    if rank_and_size() == (0, 1):
        yield arguments
        return
    with Processes() as processes:
        shared = processes.exchange(secrets.randbelow(2**31))[0]
    arguments = ["--seed", str(shared), *arguments]
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--seed", type=int)
    # In place of a negative seed the Zoo would draw one in each process
    if parser.parse_known_args(arguments)[0].seed < 0:
        arguments += ["--seed", str(shared)]
    if is_leader():
        yield arguments
        return
    with TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        yield [*arguments, "--log-folder", folder]


def import_packages(command: str, arguments: list[str]) -> list[str]:
    """Import the packages of ``--gym-packages``, and return the arguments for a command that may not know this one."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--gym-packages", nargs="+", default=[])
    given, others = parser.parse_known_args(arguments)
    for package in given.gym_packages:
        importlib.import_module(package)
    return others if command == "record_video" else arguments


def check(parser: argparse.ArgumentParser, command: str, arguments: list[str]) -> None:
    """Exit with a sentence where the Zoo would ignore an argument or end with a traceback."""
    known = argparse.ArgumentParser(parser.prog, parser.usage, add_help=False, allow_abbrev=False)
    known.add_argument("--env", default="CartPole-v1")
    known.add_argument("--algo", default="ppo")
    known.add_argument("--exp-id", type=int, default=0)
    for name in ("--storage", "--study-name", "--trial-id", "--load-checkpoint"):
        known.add_argument(name)
    known.add_argument("-f", "--folder", default="rl-trained-agents")
    known.add_argument("-i", "--trained-agent")
    known.add_argument("-optimize", "--optimize", "--optimize-hyperparameters", dest="optimizes", action="store_true")
    for name in ("--load-best", "--load-last-checkpoint"):
        known.add_argument(name, action="store_true")
    for names in (("-params", "--hyperparams"), ("--env-kwargs",), ("--eval-env-kwargs",)):
        known.add_argument(*names, nargs="+", type=key_and_value, default=[])
    given, _ = known.parse_known_args(arguments)
    if given.algo not in utils.ALGOS:
        parser.error(str(unknown_name("--algo", "one of", utils.ALGOS, given.algo)))
    if given.env not in gym.registry:
        near = difflib.get_close_matches(given.env, gym.registry, n=1)
        hint = f": did you mean {near[0]}?" if near else ""
        other = "an environment of another package needs --gym-packages PACKAGE"
        parser.error(f"--env {given.env} is not registered ({other}){hint}")
    for option, env_kwargs in (("--env-kwargs", given.env_kwargs), ("--eval-env-kwargs", given.eval_env_kwargs)):
        try:
            if env_kwargs:
                gym.make(given.env, **dict(env_kwargs)).close()
        except (AssertionError, TypeError, ValueError) as error:
            parser.error(f"{option}: {error}")
    if command != "train":
        check_trained_model(parser, command, given)
        return
    if given.trial_id and not (given.storage and given.study_name):
        parser.error("--trial-id needs --storage and --study-name: without them the Zoo ignores it")
    if (given.storage or given.study_name) and not (given.trial_id or given.optimizes):
        parser.error("--storage and --study-name need -optimize or --trial-id: without them the Zoo ignores both")
    if given.trained_agent and given.optimizes:
        parser.error("--trained-agent cannot be tuned: with it the Zoo ignores -optimize")
    if given.trained_agent and not (given.trained_agent.endswith(".zip") and os.path.isfile(given.trained_agent)):
        parser.error(f"--trained-agent {given.trained_agent} is not the .zip file of a model")


def check_trained_model(parser: argparse.ArgumentParser, command: str, given: argparse.Namespace) -> None:
    """Exit with a sentence where there is no model, unless it is one that the Zoo downloads."""
    which = (given.load_best, given.load_checkpoint, given.load_last_checkpoint)
    try:
        # The command itself prints the same again
        with contextlib.redirect_stdout(io.StringIO()):
            utils.get_model_path(given.exp_id, given.folder, given.algo, utils.EnvironmentName(given.env), *which)
    except (AssertionError, ValueError) as error:
        if command == "record_video" or given.algo in ALGORITHMS or "rl-trained-agents" not in given.folder:
            parser.error(
                f"{error}: pass the folder of your models, such as -f logs, their --algo and --env, or an --exp-id"
            )


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
        parser.error(str(unknown_name("the command", "one of", COMMANDS, command)))
    arguments = sys.argv[2:]
    try:
        if command in ("train", "enjoy", "record_video") and not {"-h", "--help"} & {*arguments}:
            arguments = import_packages(command, arguments)
            check(parser, command, arguments)
        sys.argv = [f"{parser.prog} {command}", *arguments]
        if command == "train":
            with one_of_several(arguments) as own_arguments:
                sys.argv[1:] = own_arguments
                importlib.import_module("rl_zoo3.train").train()
        elif command in SCRIPTS:
            run_script(command)
        else:
            module = f"rl_zoo3.plots.{command}" if command in PLOTS else f"rl_zoo3.{command}"
            getattr(importlib.import_module(module), command)()
    except ModuleNotFoundError as error:
        parser.error(f"{error}: install it, or correct its name; what the Zoo needs comes with the extra [zoo]")
    except (ConfigurationError, gym.error.DependencyNotInstalled, ImportError) as error:
        parser.error(str(error))
    except FileNotFoundError as error:
        if command not in PLOTS:
            raise
        parser.error(str(error))
    except ValueError as error:
        if command != "plot_from_file" or "empty sequence" not in str(error):
            raise
        parser.error(
            "no algorithm has two runs with evaluations at the same steps. Pass a file from all_plots -o: all_plots "
            "drops runs that are shorter than the longest one, unless --max-timesteps cuts all to a common length"
        )


if __name__ == "__main__":
    main()
