"""The RL Zoo's commands end to end, for both algorithms and one of the Zoo's own."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("matplotlib")

import gymnasium as gym
import rl_zoo3
import yaml
from matplotlib import pyplot
from zoo_commands import NAMES, RUN, config_of, train, zoo

from sb3_reinforce.zoo import ALGORITHMS, HYPERPARAMS

# The Zoo and its dependencies emit warnings of their own
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The current folder, with two runs of each algorithm, with evaluations and checkpoints."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("zoo"))
        for name in NAMES:
            for _ in range(2):
                train(name, "-n", "400", "--eval-freq", "200", "--save-freq", "200")
        yield Path.cwd()


@pytest.mark.parametrize("name", NAMES)
def test_train_finds_the_settings_without_a_conf_file(name, folder):
    run = folder / "logs" / name / RUN
    own = HYPERPARAMS if name in ALGORITHMS else Path(rl_zoo3.__file__).parent / "hyperparams"
    published = yaml.safe_load((own / f"{name}.yml").read_text())["CartPole-v1"]
    assert config_of(run) == published
    assert {"CartPole-v1.zip", "best_model.zip", "evaluations.npz"} <= {path.name for path in run.iterdir()}


@pytest.mark.parametrize("name", NAMES)
def test_enjoy(name, folder, capsys):
    for which in ((), ("--load-best",), ("--load-last-checkpoint",)):
        zoo("enjoy", "--algo", name, "-f", "logs", "--exp-id", "1", "--no-render", "-n", "600", *which)
        assert "Mean reward: " in capsys.readouterr().out


@pytest.mark.parametrize("name", ["reinforce", "finite_difference"])
def test_record_video_also_of_an_environment_of_another_package(name, tmp_path, monkeypatch):
    pytest.importorskip("pygame")
    (tmp_path / "own_envs.py").write_text(
        "import gymnasium as gym\n"
        "gym.register('Own-v0', 'gymnasium.envs.classic_control.cartpole:CartPoleEnv', max_episode_steps=50)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_envs", raising=False)
    common = ("--algo", name, "--env", "Own-v0", "--gym-packages", "own_envs", "-f", str(tmp_path), "-n", "40")
    zoo("train", *common)
    zoo("record_video", *common, "-o", str(tmp_path / "videos"))
    gym.registry.pop("Own-v0")
    assert [path.suffix for path in (tmp_path / "videos").iterdir()] == [".mp4"]


def test_statistics_of_normalization_come_back(tmp_path, capsys):
    common = ("--algo", "finite_difference", "--env", "Pendulum-v1", "-f", str(tmp_path))
    zoo("train", *common, "-n", "200", "--eval-freq", "-1")
    zoo("enjoy", *common, "--no-render", "-n", "200")
    assert "Loading running average" in capsys.readouterr().out


def test_benchmark_evaluates_the_algorithms_of_this_package(folder, tmp_path):
    # The Zoo starts a process for each model: here only for this one
    shutil.copytree(folder / "logs" / "finite_difference" / RUN, tmp_path / "finite_difference" / RUN)
    arguments = ("--no-hub", "-n", "600", "--num-threads", "1")
    zoo("benchmark", "--log-dir", str(tmp_path), "--benchmark-dir", str(tmp_path / "results"), *arguments)
    assert "|finite_difference|CartPole-v1|" in (folder / "benchmark.md").read_text().replace(" ", "")


def test_plots(folder, capsys):
    for name in NAMES:
        pyplot.close("all")
        zoo("plot_train", "-a", name, "-e", "CartPole", "-f", "logs", "-w", "2")
        assert len(pyplot.gca().lines) >= 2
    zoo("all_plots", "-a", *NAMES, "-e", "CartPole-v1", "-f", "logs", "-o", "results", "--no-million")
    table = capsys.readouterr().out
    assert all(name.upper() in table for name in NAMES)
    zoo("plot_from_file", "-i", "results", "-o", "figure.png", "--format", "png")
    assert (folder / "figure.png").stat().st_size > 0


def test_importing_is_all_that_a_script_around_the_zoo_needs(tmp_path):
    script = """
import sys
import sb3_reinforce.zoo
from rl_zoo3.train import train
sys.argv += ["--algo", "reinforce", "-n", "128", "--eval-freq", "-1"]
train()
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "logs" / "reinforce" / RUN / "CartPole-v1.zip").exists()


WITHOUT_ZOO = """
import importlib, sys
sys.modules.update(rl_zoo3=None, optuna=None)
from sb3_reinforce import REINFORCE, FiniteDifference
for path, algorithm in zip(sys.argv[2:], (REINFORCE, FiniteDifference)):
    print(algorithm.load(path).learning_rate(0.5))
try:
    import sb3_reinforce.zoo
except ImportError as error:
    print(error)
module, _, function = sys.argv[1].partition(":")
getattr(importlib.import_module(module), function)()
"""


def test_without_the_zoo_its_models_load_and_its_bridge_says_what_to_install(tmp_path):
    for name in ALGORITHMS:
        train(name, "-n", "64", "-f", str(tmp_path), "--eval-freq", "-1", "-params", "learning_rate:'lin_5E-1'")
    pyproject = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    console_script = pyproject.partition('sb3-reinforce-zoo = "')[2].partition('"')[0]
    models = [str(tmp_path / name / RUN / "CartPole-v1.zip") for name in ALGORITHMS]
    command = [sys.executable, "-W", "ignore", "-c", WITHOUT_ZOO, console_script, *models]
    result = subprocess.run(command, capture_output=True, text=True)
    *rates, sentence = result.stdout.splitlines()[-3:]
    assert rates == ["0.25", "0.25"]
    assert sentence.startswith("sb3_reinforce.zoo needs the RL Zoo")
    assert "pip install 'sb3-reinforce[zoo]'" in sentence and "pip install -e '.[zoo]'" in sentence
    assert result.stderr == f"sb3-reinforce-zoo: error: {sentence}\n" and result.returncode == 2
