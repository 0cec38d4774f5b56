"""The Zoo's commands as functions, for its tests."""

import sys
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium as gym
import matplotlib
import pytest
import yaml

from sb3_reinforce.zoo import ALGORITHMS
from sb3_reinforce.zoo.__main__ import main

NAMES = [*ALGORITHMS, "a2c"]
RUN = "CartPole-v1_1"


class AtariEnv(gym.Env[Any, Any]):
    """The Zoo takes an environment with this name in its entry point for a game of Atari."""


GAME = gym.envs.registration.EnvSpec("Game-v0", AtariEnv)


def zoo(*arguments: str) -> None:
    """A command, as from a shell in the current folder."""
    with mock.patch.object(sys, "argv", ["sb3-reinforce-zoo", *arguments]), matplotlib.rc_context({"backend": "agg"}):
        main()


def train(name: str, *arguments: str, env: str = "CartPole-v1") -> None:
    zoo("train", "--algo", name, "--env", env, "--seed", "1", "--eval-episodes", "2", *arguments)


def message_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The last sentence of a command that exits with an error."""
    with pytest.raises(SystemExit):
        zoo(*arguments)
    return capsys.readouterr().err.rpartition("error: ")[2]


def config_of(run: Path) -> dict[str, Any]:
    """The settings that the Zoo has written beside a model."""
    return dict(yaml.unsafe_load((run / run.name.rpartition("_")[0] / "config.yml").read_text()))
