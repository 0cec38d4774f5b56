"""The RL Zoo's commands end to end, for both algorithms and one of the Zoo's own."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

pytest.importorskip("rl_zoo3")
matplotlib = pytest.importorskip("matplotlib")

import optuna
import rl_zoo3
import torch as th
import yaml
from gymnasium.error import DependencyNotInstalled
from matplotlib import pyplot

from sb3_reinforce.zoo import ALGORITHMS, HYPERPARAMS
from sb3_reinforce.zoo.__main__ import main

# The Zoo and what it calls warn of their own affairs
pytestmark = pytest.mark.filterwarnings("ignore")
NAMES = [*ALGORITHMS, "a2c"]
RUN = "CartPole-v1_1"
TASKS = {
    "CartPole-v1", "Acrobot-v1", "MountainCar-v0", "MountainCarContinuous-v0", "Pendulum-v1", "LunarLander-v3",
    "LunarLanderContinuous-v3", "BipedalWalker-v3", "HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Swimmer-v5",
    "Ant-v5", "InvertedPendulum-v5", "Reacher-v5",
}  # fmt: skip


def zoo(*arguments: str) -> None:
    """A command, as from a shell in the current folder."""
    with mock.patch.object(sys, "argv", ["sb3-reinforce-zoo", *arguments]), matplotlib.rc_context({"backend": "agg"}):
        main()


def train(name: str, *arguments: str, env: str = "CartPole-v1") -> None:
    zoo("train", "--algo", name, "--env", env, "--seed", "1", "--eval-episodes", "2", *arguments)


def parameters(path: Path) -> th.Tensor:
    name = path.parent.parent.name
    return th.nn.utils.parameters_to_vector(rl_zoo3.ALGOS[name].load(path, device="cpu").policy.parameters())


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two runs of each algorithm, with evaluations and checkpoints."""
    folder = tmp_path_factory.mktemp("zoo")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name in NAMES:
            for _ in range(2):
                train(name, "-n", "400", "--eval-freq", "200", "--save-freq", "200")
    return folder


@pytest.fixture
def folder(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(trained)
    return trained


@pytest.mark.parametrize("name", NAMES)
def test_train_finds_the_settings_without_a_conf_file(name: str, folder: Path) -> None:
    run = folder / "logs" / name / RUN
    own = HYPERPARAMS if name in ALGORITHMS else Path(rl_zoo3.__file__).parent / "hyperparams"
    published = yaml.safe_load((own / f"{name}.yml").read_text())["CartPole-v1"]
    assert dict(yaml.unsafe_load((run / "CartPole-v1" / "config.yml").read_text())) == published
    assert {"CartPole-v1.zip", "best_model.zip", "evaluations.npz"} <= {path.name for path in run.iterdir()}


@pytest.mark.parametrize("which", [(), ("--load-best",), ("--load-last-checkpoint",)])
@pytest.mark.parametrize("name", NAMES)
def test_enjoy(name: str, which: tuple[str, ...], folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    zoo("enjoy", "--algo", name, "-f", "logs", "--exp-id", "1", "--no-render", "-n", "600", *which)
    assert "Mean reward: " in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
def test_record_video(name: str, folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("pygame")
    zoo("record_video", "--algo", name, "-f", "logs", "--exp-id", "1", "-n", "20", "-o", str(tmp_path))
    assert [path.suffix for path in tmp_path.iterdir()] == [".mp4"]


@pytest.mark.parametrize("name", NAMES)
def test_train_goes_on_from_a_model(name: str, folder: Path, tmp_path: Path) -> None:
    path = folder / "logs" / name / RUN / "CartPole-v1.zip"
    train(name, "-n", "100", "-i", str(path), "-params", "learning_rate:0.0", "-f", str(tmp_path), "--eval-freq", "-1")
    # With a rate of 0 what is saved is what was loaded
    assert th.equal(parameters(path), parameters(tmp_path / name / RUN / path.name))


def test_statistics_of_normalization_come_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("--algo", "finite_difference", "--env", "Pendulum-v1", "-f", str(tmp_path))
    zoo("train", *common, "-n", "200", "--eval-freq", "-1")
    zoo("enjoy", *common, "--no-render", "-n", "200")
    assert "Loading running average" in capsys.readouterr().out


def test_benchmark_evaluates_every_algorithm(folder: Path) -> None:
    zoo("benchmark", "--log-dir", "logs", "--benchmark-dir", "benchmark", "--no-hub", "-n", "600", "--num-threads", "1")
    rows = (folder / "benchmark.md").read_text()
    assert all(f"|{name}" in rows for name in NAMES)


def test_plots(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in NAMES:
        zoo("plot_train", "-a", name, "-e", "CartPole", "-f", "logs", "-w", "2")
        assert len(pyplot.gca().lines) >= 2
    zoo("all_plots", "-a", *NAMES, "-e", "CartPole-v1", "-f", "logs", "-o", "results", "--no-million")
    table = capsys.readouterr().out
    assert all(name.upper() in table for name in NAMES)
    zoo("plot_from_file", "-i", "results", "--rliable", "--versus", "--iqm", "-o", "figure.png", "--format", "png")
    assert (folder / "figure.png").stat().st_size > 0


@pytest.mark.parametrize("name", ALGORITHMS)
def test_optuna_tunes_and_its_trials_can_be_trained(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    study = ("--storage", "study.log", "--study-name", "study", "--eval-freq", "-1", "-n", "200")
    train(name, "-optimize", "--n-trials", "2", "--n-evaluations", "1", "--no-optim-plots", *study)
    backend = optuna.storages.journal.JournalFileBackend("study.log")
    trials = optuna.load_study(study_name="study", storage=optuna.storages.JournalStorage(backend)).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "COMPLETE"]
    for number, trial in enumerate(trials):
        train(name, *study, "--trial-id", str(number))
        config = yaml.unsafe_load(Path(f"logs/{name}/CartPole-v1_{number + 2}/CartPole-v1/config.yml").read_text())
        assert config["learning_rate"] == trial.params["learning_rate"]


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_sample_makes_a_model_and_can_be_made_again_from_its_trial(name: str) -> None:
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    published = yaml.safe_load((HYPERPARAMS / f"{name}.yml").read_text())
    for entry in ("CartPole-v1", "MountainCarContinuous-v0"):
        fixed = {key: published[entry][key] for key in ("policy", "estimator", "n_top") if key in published[entry]}
        for _ in range(20):
            trial = study.ask()
            sample = HYPERPARAMS_SAMPLER[name](trial, 1, 8, {})
            assert HYPERPARAMS_CONVERTER[name](trial.params) == sample
            ALGORITHMS[name](env=entry, device="cpu", **{**fixed, **sample})


def test_the_settings_cover_what_is_promised() -> None:
    published = yaml.safe_load((HYPERPARAMS / "reinforce.yml").read_text())
    assert published.keys() >= TASKS | {"atari", "default"}


@pytest.mark.parametrize(
    ("name", "env"),
    [
        (name, env)
        for name in ALGORITHMS
        for env in yaml.safe_load((HYPERPARAMS / f"{name}.yml").read_text())
        if env not in ("atari", "default")
    ],
)
def test_every_entry_trains(name: str, env: str, tmp_path: Path) -> None:
    try:
        rl_zoo3.utils.gym.make(env).close()
    except DependencyNotInstalled as error:
        pytest.skip(str(error))
    train(name, "-n", "1", "--eval-freq", "-1", "-f", str(tmp_path), env=env)
    assert (tmp_path / name / f"{env}_1" / f"{env}.zip").exists()


def test_importing_is_all_that_a_script_around_the_zoo_needs(tmp_path: Path) -> None:
    script = """
import sys
import sb3_reinforce.zoo
from rl_zoo3.train import train
sys.argv += ["--algo", "reinforce", "-n", "128", "--eval-freq", "-1"]
train()
"""
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, capture_output=True)
    assert (tmp_path / "logs" / "reinforce" / RUN / "CartPole-v1.zip").exists()


def wrong_config(entry: str) -> Callable[[Path], list[str]]:
    def arguments(folder: Path) -> list[str]:
        (folder / "wrong.yml").write_text(f"CartPole-v1: {entry}")
        return ["train", "--algo", "reinforce", "-conf", str(folder / "wrong.yml"), "-f", str(folder)]

    return arguments


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ("{policy: MlpPolicy}", "must hold n_timesteps"),
        ("{n_timesteps: 100}", "must hold policy"),
        ("{policy: MlpPolicy, n_timesteps: 1e6}", "write !!float 1e6"),
        ("{policy: MlpPolicy, n_timesteps: 100, learning_rate: 1e-3}", "write !!float 1e-3"),
        ("{policy: MlpPolicy, n_timesteps: 100, learning_rate: cos_1e-3}", "lin_NUMBER"),
        ("{policy: MlpPolicy, n_timesteps: 100, n_step: 5}", "did you mean n_steps"),
        ("{policy: MlpPolicy, n_timesteps: 100, seed: 5}", "'seed' is not a setting"),
        ("{policy: MlpPolicy, n_timesteps: 100, gamma: 3}", "gamma must be finite and >= 0 and <= 1, got 3"),
    ],
)
def test_a_wrong_configuration_is_named(entry: str, sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=sentence):
        zoo(*wrong_config(entry)(tmp_path))


def test_optuna_refuses_what_its_samples_do_not_go_with(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="-optimize samples n_steps"):
        train("reinforce", "-optimize", "-params", "n_episodes:8", "-f", str(tmp_path))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["fly"], "there is no command 'fly', only train, enjoy"),
        (["push_to_hub"], "push_to_hub is not offered"),
        (["train", "--algo", "reinforc"], "invalid choice: 'reinforc'"),
        (["train", "--env", "CartPol-v1"], "--env CartPol-v1 is not registered, but CartPole-v"),
        (["train", "-params", "baseline:none"], "write a text as"),
        (["train", "--trial-id", "1"], "--trial-id needs --storage and --study-name"),
        (["enjoy", "--algo", "reinforce"], "no published models of reinforce"),
    ],
)
def test_a_wrong_command_is_answered_with_a_sentence(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        zoo(*arguments)
    assert sentence in capsys.readouterr().err


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for module in [module for module in sys.modules if module.startswith("rl_zoo3.plots")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "seaborn", None)
    with pytest.raises(SystemExit):
        zoo("plot_train")
    message = capsys.readouterr().err
    assert "seaborn" in message and "pip install 'sb3-reinforce[zoo]'" in message
