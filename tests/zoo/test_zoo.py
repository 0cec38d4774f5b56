"""The RL Zoo's commands end to end, for all three algorithms and one of the Zoo's own, and what they say of errors."""

import importlib
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from unittest import mock

import gymnasium as gym
import pytest
import rl_zoo3
import stable_baselines3
import torch as th
import yaml
from matplotlib import pyplot
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize
from zoo_commands import NAMES, RUN, config_of, message_of, train, zoo

from sb3_reinforce.zoo import ALGORITHMS, HYPERPARAMS
from sb3_reinforce.zoo.model_card import write_card


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
    published = yaml.safe_load((own / f"{name}.yml").read_text())
    assert config_of(run) == published.get("CartPole-v1", published.get("default"))
    assert {"CartPole-v1.zip", "best_model.zip", "evaluations.npz"} <= {path.name for path in run.iterdir()}


@pytest.mark.parametrize("name", NAMES)
def test_enjoy(name, folder, capsys):
    others = {"reinforce": ["--load-best", "--load-last-checkpoint"], "finite_difference": ["--load-best"]}
    for which in ((), *((option,) for option in others.get(name, ()))):
        zoo("enjoy", "--algo", name, "-f", "logs", "--exp-id", "1", "--no-render", "-n", "600", *which)
        out = capsys.readouterr().out
        assert "Mean reward: " in out
        assert ("Loading running average" in out) == ("normalize" in config_of(folder / "logs" / name / RUN))


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_model_card_describes_the_last_agent(name, folder):
    card = write_card("logs", name, "CartPole-v1", n_episodes=2)
    assert card == Path("logs", name, "CartPole-v1_2", "README.md")
    _, metadata, text = card.read_text().split("---\n")
    assert yaml.safe_load(metadata)["library_name"] == "stable-baselines3"
    assert f"**{ALGORITHMS[name].__name__}** Agent playing **CartPole-v1**" in text
    assert re.search(r"2 deterministic episodes, after training with seed 1: \*\*\d+\.\d\d ± \d+\.\d\d\*\*", text)
    assert f"enjoy --algo {name} --env CartPole-v1 -f logs --exp-id 2\n" in text and "-n 400 -f logs --seed 1" in text
    settings = text.partition("```yaml\n")[2].partition("```")[0]
    assert yaml.safe_load(settings) == config_of(card.parent)
    env = make_vec_env("CartPole-v1", 10, seed=1001)
    if "normalize" in config_of(card.parent):
        env = VecNormalize.load(str(card.parent / "CartPole-v1" / "vecnormalize.pkl"), env)
        env.training = env.norm_reward = False
    agent = ALGORITHMS[name].load(card.parent / "CartPole-v1.zip", device="cpu")
    assert "**{:.2f} ± {:.2f}**".format(*evaluate_policy(agent, env, 2)) in text


def test_a_model_card_of_an_environment_in_a_namespace(tmp_path, monkeypatch):
    spec = gym.envs.registration.EnvSpec("own/Pole-v0", lambda: gym.make("CartPole-v1"))
    monkeypatch.setitem(gym.registry, "own/Pole-v0", spec)
    train("reinforce", "-n", "64", "-f", str(tmp_path), "--eval-freq", "-1", env="own/Pole-v0")
    card = write_card(str(tmp_path), "reinforce", "own/Pole-v0", n_episodes=2)
    assert card.parent.name == "own-Pole-v0_1" and "--env own/Pole-v0" in card.read_text()


def test_a_model_card_without_an_agent_is_answered_with_a_sentence(tmp_path, monkeypatch, capsys):
    command = ["model_card", "--algo", "reinforce", "--env", "CartPole-v1", "-f", str(tmp_path), "--exp-id", "3"]
    monkeypatch.setattr(sys, "argv", command)
    monkeypatch.delitem(sys.modules, "sb3_reinforce.zoo.model_card")
    with pytest.raises(SystemExit):
        runpy.run_module("sb3_reinforce.zoo.model_card", run_name="__main__")
    assert "folder was not found: pass another folder" in capsys.readouterr().err


def test_a_model_continues_on_its_task_with_its_policy(folder, tmp_path, capsys):
    command = [*REINFORCE, "-i", f"logs/reinforce/{RUN}/CartPole-v1.zip", "-f", str(tmp_path)]
    assert "Observation spaces do not match" in message_of(capsys, *command, "--env", "Acrobot-v1")
    assert "keeps the model's policy_kwargs: leave it out of -params" in message_of(
        capsys, *command, "-params", "policy_kwargs:dict()"
    )


def test_the_command_of_a_model_card_trains_the_same_agent(tmp_path):
    folder = ("-f", str(tmp_path))
    settings = (
        "learning_rate:0.01",
        "max_grad_norm:float('inf')",
        "policy_kwargs:dict(net_arch=[8],activation_fn=nn.ReLU)",
    )
    train("reinforce", "-n", "64", *folder, "-params", *settings, "--env-kwargs", "sutton_barto_reward:True")
    card = write_card(str(tmp_path), "reinforce", "CartPole-v1", n_episodes=2).read_text()
    command = re.search(r"^python -m sb3_reinforce.zoo (train .*)$", card, re.M)[1]
    zoo(*shlex.split(command))
    first, second = [tmp_path / "reinforce" / f"CartPole-v1_{number}" for number in (1, 2)]
    assert config_of(first) == config_of(second)
    states = [
        ALGORITHMS["reinforce"].load(run / "CartPole-v1.zip", device="cpu").policy.state_dict().values()
        for run in (first, second)
    ]
    assert all(map(th.equal, *states))


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
    monkeypatch.delitem(sys.modules, "own_envs")
    card = write_card(str(tmp_path), name, "Own-v0", n_episodes=2).read_text()
    assert all(re.search(f"zoo {command} .*--gym-packages own_envs", card) for command in ("train", "enjoy"))
    gym.registry.pop("Own-v0")
    assert [path.suffix for path in (tmp_path / "videos").iterdir()] == [".mp4"]


@pytest.mark.slow
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
    names = ("reinforce", "finite_difference")
    for name in names:
        train(name, "-n", "64", "-f", str(tmp_path), "--eval-freq", "-1", "-params", "learning_rate:'lin_5E-1'")
    pyproject = (Path(__file__).parents[2] / "pyproject.toml").read_text()
    console_script = pyproject.partition('sb3-reinforce-zoo = "')[2].partition('"')[0]
    models = [str(tmp_path / name / RUN / "CartPole-v1.zip") for name in names]
    command = [sys.executable, "-W", "ignore", "-c", WITHOUT_ZOO, console_script, *models]
    result = subprocess.run(command, capture_output=True, text=True)
    *rates, sentence = result.stdout.splitlines()[-3:]
    assert rates == ["0.25", "0.25"]
    assert sentence.startswith("sb3_reinforce.zoo needs the RL Zoo")
    assert "pip install 'sb3-reinforce[zoo]'" in sentence and "pip install -e '.[zoo]'" in sentence
    assert result.stderr == f"sb3-reinforce-zoo: error: {sentence}\n" and result.returncode == 2


REINFORCE = ["train", "--algo", "reinforce"]
PENDULUM = [*REINFORCE, "--env", "Pendulum-v1", "--conf-file", "default.yml"]
ENTRY = "policy: MlpPolicy, n_timesteps: 100"
CONFIGURATIONS = [
    ("[1, 2]", "wrong.yml must be a dict, got [1, 2]"),
    ("text", "wrong.yml must be a dict, got 'text'"),
    ("", "must have an entry CartPole-v1 or default"),
    ("CartPole-v1: {", "cannot be read: "),
    ("Acrobot-v1: {policy: MlpPolicy}", "must have an entry CartPole-v1 or default"),
    ("CartPole-v1:", "must hold policy"),
    ("CartPole-v1: 5", "wrong.yml must be a dict, got 5"),
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
    ("learning_rate: null", "learning_rate must be a number or a schedule, got None"),
    ("n_step: 5", "did you mean 'n_steps'"),
    ("seed: 5", "reinforce has no setting seed: a setting must be one of 'baseline', "),
    ("n_epochs: 5", "reinforce has no setting n_epochs: it takes one policy step per rollout"),
    ("baseline: mean, gae_lambda: 0.9", "reward_to_go=True (settings that -params does not give are from "),
    ("gamma: 3", "gamma must be in [0, 1], got 3"),
    ("gamma: x", "gamma must be a number, got 'x' of type str"),
    ("policy_kwargs: 'dict('", "must be Python that the Zoo can evaluate, but 'dict(' raises SyntaxError"),
    ("policy_kwargs: [1]", "policy_kwargs must be a dict"),
    ("policy_kwargs: {net: [5]}", "unexpected keyword argument 'net'"),
    ("policy: LinearPolicy, policy_kwargs: {net_arch: [5]}", "has no hidden layers"),
    ("normalize: nn.Norm", "but 'nn.Norm' raises AttributeError"),
    ("env_kwargs: 3", "env_kwargs must be a dict, got 3"),
    ("env_kwargs: {gravty: 3}", "creator for CartPole-v1 with kwargs ({'gravty': 3}) (settings that"),
    ("train_env_kwargs: 3", "train_env_kwargs must be a dict, got 3"),
    ("train_env_kwargs: {gravty: 3}", "unexpected keyword argument 'gravty'"),
    ("monitor_kwargs: {gravty: 3}", "unexpected keyword argument 'gravty'"),
    ("policy: sb3_reinforce.MaskdPolicy", "policy must be the path of a class, got 'sb3_reinforce.MaskdPolicy'"),
    ("env_wrapper: Nope", "env_wrapper must be the path of a class, got 'Nope'"),
    ("vec_env_wrapper: [3]", "vec_env_wrapper must be the path of a class, got 3"),
    ("callback: sb3_reinforce.Nope", "callback must be the path of a class, got 'sb3_reinforce.Nope'"),
    ("env_wrapper: [{gymnasium.wrappers.RescaleAction: {low: 1}}]", "unexpected keyword argument 'low'"),
    ("env_wrapper: [{gymnasium.wrappers.FlattenObservation: }]", "in env_wrapper must be a dict, got None"),
    ("env_wrapper: [null]", "env_wrapper must be the path of a class, got None"),
    ("env_wrapper: gymnasium.wrappers.TimeLimit", "TimeLimit in env_wrapper: missing a required argument: 'max_ep"),
    ("callback: [stable_baselines3.common.callbacks.CheckpointCallback]", "missing a required argument: 'save_freq'"),
    ("env_wrapper: ..x", "env_wrapper must be the path of a class, got '..x'"),
    ("normalize: 1", "normalize must be True, False or a dict, got 1"),
    ("normalize: {norm_ob: true}", "unexpected keyword argument 'norm_ob'"),
    ("normalize: {norm_obs_keys: [x]}", "`norm_obs_keys` param is applicable only with"),
    ("use_sde: true", "use_sde=True is for Box action spaces"),
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


FALLING = "hyperparams = {'CartPole-v1': {'policy': 'MlpPolicy', 'n_timesteps': 100, 'learning_rate': f}}"


@pytest.mark.parametrize(
    ("conf", "sentence"),
    [
        ("settings = {}", "must define a dict named hyperparams"),
        (f"def f(left): return 0.1 * left\n{FALLING}", "learning_rate cannot be read again from the config.yml"),
        (f"f = lambda left: 0.1 * left\n{FALLING}", "learning_rate cannot be read again from the config.yml"),
    ],
)
def test_what_could_not_be_read_again_is_refused(conf, sentence, tmp_path, capsys):
    (tmp_path / "wrong.py").write_text(conf)
    assert sentence in message_of(capsys, *REINFORCE, "-conf", str(tmp_path / "wrong.py"), "-f", str(tmp_path))


@pytest.mark.parametrize(
    "error",
    [
        ValueError("another"),
        ValueError("Action 7 is invalid"),
        AssertionError(),
        TypeError("f() got an unexpected keyword argument 'x'"),
    ],
)
def test_an_error_that_is_not_of_the_configuration_stays_one(error, tmp_path, monkeypatch):
    monkeypatch.setattr(ExperimentManager, "create_envs", mock.Mock(side_effect=error))
    with pytest.raises(type(error)) as caught:
        train("reinforce", "-f", str(tmp_path))
    assert caught.value is error


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["fly"], "the command must be one of 'train', 'enjoy'"),
        (["push_to_hub"], "push_to_hub is not offered"),
        (["train", "--algo", "reinforced"], "got 'reinforced': did you mean 'reinforce'?"),
        (["enjoy", "--algo", "x"], "--algo must be one of 'a2c', "),
        (["train", "--env-kwargs", "gravty:3"], "--env-kwargs: CartPoleEnv.__init__() got an unexpected keyword"),
        (["train", "--eval-env-kwargs", "max_episode_steps:0"], "--eval-env-kwargs: Expect the `max_episode_steps`"),
        (["enjoy", "--algo", "reinforce", "-f", "logs"], "The logs/reinforce folder was not found: pass the folder"),
        (["record_video", "-f", ".", "--exp-id", "-1"], "The ./ppo folder was not found: pass the folder"),
        (["train", "--env", "CartPol-v1"], "--gym-packages PACKAGE): did you mean CartPole-v"),
        (["train", "-params", "baseline:none"], "write a text as"),
        (["train", "-params", "n_steps:1/0"], "the value of 'n_steps:1/0' must be Python (ZeroDivisionError"),
        (["train", "-params", "gamma:0.9", "n_steps=5"], "'n_steps=5' must be KEY:VALUE"),
        (["train", "--trial-id", "1"], "--trial-id needs --storage and --study-name"),
        (["train", "--study-name", "x"], "--storage and --study-name need -optimize or --trial-id"),
        (["train", "-i", "a.zip", "-optimize"], "--trained-agent cannot be tuned"),
        (["train", "-i", "nowhere.zip"], "--trained-agent nowhere.zip is not the .zip file of a model"),
        (["train", "--gym-packages", "nope_pkg"], "No module named 'nope_pkg': install it"),
        ([*REINFORCE, "-params", "env_wrapper:'nope_pkg.Wrapper'"], "No module named 'nope_pkg': install it"),
        ([*REINFORCE, "--env", "FrozenLake-v1", "-params", "env_wrapper:'Nope'"], "env_wrapper must be the path"),
        ([*REINFORCE, "--env", "Blackjack-v1"], "observation_space must be Box, Discrete, MultiDiscrete, "),
        ([*REINFORCE, "--env", "FrozenLake-v1", "-params", "normalize:True"], "VecNormalize only supports"),
        ([*REINFORCE, "--device", "gpu9"], "device must be 'auto' or a device that PyTorch knows, got 'gpu9'"),
        ([*REINFORCE, "--conf-file", "nowhere.yml"], "nowhere.yml cannot be read"),
        ([*REINFORCE, "--conf-file", "broken.py"], "broken.py cannot be read: '{' was never closed"),
        # A temperature in the default entry is left out, but not one that was asked for
        ([*PENDULUM, "-params", "temperature:0.5"], "temperature=0.5 is for discrete actions"),
        (["enjoy", "--algo", "reinforce"], "The rl-trained-agents/reinforce folder was not found: pass the folder"),
        (["plot_from_file", "-i", "none.pkl"], "No such file or directory: 'none.pkl'"),
    ],
)
def test_a_wrong_command_is_answered_with_a_sentence(arguments, sentence, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("broken.py").write_text("hyperparams = {")
    Path("default.yml").write_text("default: {policy: MlpPolicy, n_timesteps: 100, temperature: 0.3}")
    assert sentence in message_of(capsys, *arguments)


def test_plots_of_runs_that_cannot_be_compared_say_what_to_do(monkeypatch, capsys):
    module = importlib.import_module("rl_zoo3.plots.plot_from_file")
    fail = mock.Mock(side_effect=ValueError("min() arg is an empty sequence"))
    monkeypatch.setattr(module, "plot_from_file", fail)
    assert "all_plots drops runs that are shorter" in message_of(capsys, "plot_from_file", "-i", "x")


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
