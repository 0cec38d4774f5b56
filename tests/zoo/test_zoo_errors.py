"""What the Zoo's commands say of a wrong command, a wrong configuration and a missing package."""

import importlib
import sys
from unittest import mock

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("matplotlib")

import rl_zoo3
import stable_baselines3
from huggingface_hub.errors import HTTPError
from rl_zoo3.exp_manager import ExperimentManager
from zoo_commands import message_of, train

# The Zoo and its dependencies emit warnings of their own
pytestmark = pytest.mark.filterwarnings("ignore")
REINFORCE = ["train", "--algo", "reinforce"]


ENTRY = "policy: MlpPolicy, n_timesteps: 100"
CONFIGURATIONS = [
    ("[1, 2]", "must map environments to settings, got a list"),
    ("", "must map environments to settings, got a NoneType"),
    ("CartPole-v1: {", "cannot be read: "),
    ("Acrobot-v1: {policy: MlpPolicy}", "must have an entry CartPole-v1 or default"),
    ("CartPole-v1:", "The entry CartPole-v1 of"),
    ("CartPole-v1: 5", "must hold settings, such as policy: 'MlpPolicy', got 5"),
    ("CartPole-v1: {policy: MlpPolicy}", "must hold n_timesteps"),
    ("CartPole-v1: {n_timesteps: 100}", "must hold policy"),
]
SETTINGS = [
    ("policy: 5", "policy must be a name, or the path of a class, got 5"),
    ("policy: Mlp", "policy must be a class or one of 'MlpPolicy'"),
    ("policy: CnnPolicy", "You should use NatureCNN only with images"),
    ("n_timesteps: 1e6", "write !!float 1e6"),
    ("n_timesteps: 0", "n_timesteps must be finite and >= 1, got 0"),
    ("n_envs: 0", "n_envs must be at least 1, got 0"),
    ("learning_rate: 1e-3", "write !!float 1e-3"),
    ("learning_rate: cos_1e-3", "lin_NUMBER"),
    ("ent_coef: lin_x", "lin_NUMBER"),
    ("learning_rate: null", "Invalid value for learning_rate: None"),
    ("n_step: 5", "did you mean n_steps"),
    ("seed: 5", "'seed' is not a setting"),
    ("gamma: 3", "gamma must be in [0, 1], got 3"),
    ("gamma: x", "gamma must be a number, got 'x' of type str"),
    ("policy_kwargs: 'dict('", "must be Python, but 'dict(' raises SyntaxError"),
    ("policy_kwargs: [1]", "policy_kwargs must be a dict"),
    ("policy_kwargs: {net: [5]}", "unexpected keyword argument 'net'"),
    ("policy: LinearPolicy, policy_kwargs: {net_arch: [5]}", "has no hidden layers"),
    ("normalize: nn.Norm", "but 'nn.Norm' raises AttributeError"),
    ("env_kwargs: 3", "env_kwargs must be a dict, got 3"),
    ("env_kwargs: {gravty: 3}", "unexpected keyword argument 'gravty'"),
    ("frame_stack: a", "frame_stack must be an integer, got 'a'"),
]


@pytest.mark.parametrize(
    ("conf", "sentence"),
    [*CONFIGURATIONS, *((f"CartPole-v1: {{{ENTRY}, {entry}}}", sentence) for entry, sentence in SETTINGS)],
)
def test_a_wrong_configuration_is_named(conf, sentence, tmp_path, capsys):
    (tmp_path / "wrong.yml").write_text(conf)
    name = "finite_difference" if "LinearPolicy" in conf else "reinforce"
    arguments = ["train", "--algo", name, "-conf", str(tmp_path / "wrong.yml"), "-f", str(tmp_path)]
    assert sentence in message_of(capsys, *arguments)


@pytest.mark.parametrize("error", [ValueError("another"), TypeError("f() got an unexpected keyword argument 'x'")])
def test_an_error_that_is_not_of_the_configuration_stays_one(error, tmp_path, monkeypatch):
    monkeypatch.setattr(ExperimentManager, "create_envs", mock.Mock(side_effect=error))
    with pytest.raises(type(error)) as caught:
        train("reinforce", "-f", str(tmp_path))
    assert caught.value is error


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["fly"], "there is no command 'fly', only train, enjoy"),
        (["push_to_hub"], "push_to_hub is not offered"),
        (["train", "--algo", "reinforced"], "there is no --algo reinforced: did you mean reinforce?"),
        (["enjoy", "--algo", "x"], "there is no --algo x, only a2c, "),
        (["train", "--env-kwargs", "gravty:3"], "--env-kwargs: CartPoleEnv.__init__() got an unexpected keyword"),
        (["enjoy", "--algo", "reinforce", "-f", "logs"], "The logs/reinforce folder was not found: pass the folder"),
        (["record_video", "-f", ".", "--exp-id", "-1"], "The ./ppo folder was not found: pass the folder"),
        (["train", "--env", "CartPol-v1"], "--gym-packages PACKAGE): did you mean CartPole-v"),
        (["train", "-params", "baseline:none"], "write a text as"),
        (["train", "-params", "n_steps:1/0"], "the value of 'n_steps:1/0' must be Python (ZeroDivisionError"),
        (["train", "-params", "gamma:0.9", "n_steps=5"], "'n_steps=5' must be KEY:VALUE"),
        (["train", "--trial-id", "1"], "--trial-id needs --storage and --study-name"),
        (["train", "-i", "nowhere.zip"], "--trained-agent nowhere.zip is not the .zip file of a model"),
        (["train", "--gym-packages", "nope_pkg"], "No module named 'nope_pkg': install it"),
        ([*REINFORCE, "-params", "env_wrapper:'nope_pkg.Wrapper'"], "No module named 'nope_pkg': install it"),
        ([*REINFORCE, "--conf-file", "nowhere.yml"], "nowhere.yml cannot be read"),
        # A temperature in the default entry is left out, but not one that was asked for
        ([*REINFORCE, "--env", "Pendulum-v1", "-params", "temperature:0.5"], "temperature=0.5 is for discrete actions"),
        (["enjoy", "--algo", "reinforce"], "The rl-trained-agents/reinforce folder was not found: pass the folder"),
        ([*REINFORCE, "-optimize", "-params", "n_episodes:8"], "-optimize samples n_steps"),
        (["benchmark"], "--log-dir rl-trained-agents/ is not a folder"),
        (["benchmark", "--log-dir", ".", "--no-hub"], "--log-dir . holds no trained models"),
    ],
)
def test_a_wrong_command_is_answered_with_a_sentence(arguments, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert sentence in message_of(capsys, *arguments)


@pytest.mark.parametrize("error", [ConnectionError("no network"), HTTPError("no network")])
def test_a_benchmark_without_network_says_to_pass_no_hub(error, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rl_zoo3.utils, "get_hf_trained_models", mock.Mock(side_effect=error))
    assert "does not answer (no network): pass --no-hub" in message_of(capsys, "benchmark", "--log-dir", str(tmp_path))


def test_plots_of_runs_that_cannot_be_compared_say_what_to_do(monkeypatch, capsys):
    module = importlib.import_module("rl_zoo3.plots.plot_from_file")
    fail = mock.Mock(side_effect=ValueError("min() arg is an empty sequence"))
    monkeypatch.setattr(module, "plot_from_file", fail)
    assert "all_plots keeps only such runs, and with --max-timesteps" in message_of(capsys, "plot_from_file", "-i", "x")


def test_a_missing_tensorboard_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stable_baselines3.common.utils, "SummaryWriter", None)
    arguments = ("train", "--algo", "reinforce", "-f", str(tmp_path), "-n", "100", "-tb", str(tmp_path / "tb"))
    assert "tensorboard is not installed" in message_of(capsys, *arguments)


def test_a_package_of_the_extra_that_is_missing_is_named(monkeypatch, capsys):
    for module in [module for module in sys.modules if module.startswith("rl_zoo3.plots")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "seaborn", None)
    message = message_of(capsys, "plot_train")
    assert "seaborn" in message and "[zoo]" in message
