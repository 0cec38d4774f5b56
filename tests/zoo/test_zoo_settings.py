"""Which settings an algorithm gets in the Zoo: published, of a model, of a trial; and what they are turned into."""

import argparse
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest
import rl_zoo3
import torch as th
import yaml
from gymnasium import spaces
from gymnasium.error import DependencyNotInstalled
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from sb3_contrib.common.wrappers import ActionMasker
from zoo_commands import GAME, RUN, config_of, message_of, train, zoo

from sb3_reinforce import ActionMaskObservation
from sb3_reinforce.policies.memories import MEMORIES
from sb3_reinforce.zoo import ALGORITHMS, HYPERPARAMS
from sb3_reinforce.zoo.experiments import make_experiment
from sb3_reinforce.zoo.settings import scheduled_keys

SCHEDULED = {
    "reinforce": {"learning_rate", "critic_learning_rate", "ent_coef", "temperature"},
    "reinforce_lstm": {"learning_rate", "critic_learning_rate", "ent_coef", "temperature"},
    "finite_difference": {"learning_rate", "delta_std"},
}
POLICIES = {"reinforce": "MlpPolicy", "reinforce_lstm": "MlpLstmPolicy", "finite_difference": "MlpPolicy"}
# Settings that go with none of those published for CartPole-v1
OTHER = {
    "reinforce": {"baseline": "leave_one_out", "n_steps": None, "n_episodes": 8, "gae_lambda": 1.0},
    "reinforce_lstm": {"baseline": "none", "n_steps": None, "n_episodes": 4, "gae_lambda": 1.0},
    "finite_difference": {"estimator": "forward", "n_delta": 3, "delta_std": 0.2},
}


def load(run):
    return ALGORITHMS[run.parent.name].load(run / f"{run.name.rpartition('_')[0]}.zip", device="cpu")


def conf(folder, **entries):
    """Arguments that name a configuration with these entries, whose runs go to the same folder."""
    (folder / "conf.yml").write_text(yaml.safe_dump(entries))
    return "-conf", str(folder / "conf.yml"), "-f", str(folder), "--eval-freq", "-1"


@pytest.mark.parametrize(("env", "left_out"), [("CartPole-v1", set()), ("Pendulum-v1", {"temperature"})])
def test_a_default_is_fitted_to_the_spaces(env, left_out, tmp_path):
    default = {"policy": "MlpPolicy", "n_timesteps": 32, "temperature": "lin_1", "normalize": True}
    train("reinforce", *conf(tmp_path, default=default), env=env)
    assert default.keys() - config_of(tmp_path / "reinforce" / f"{env}_1").keys() == left_out


def test_games_of_atari_have_their_entry_or_need_a_conf_file(monkeypatch, capsys):
    monkeypatch.setitem(gym.registry, "Game-v0", GAME)
    experiment = make_experiment(argparse.Namespace(), "reinforce", "Game-v0", "", n_timesteps=64)
    settings, _ = experiment.read_hyperparameters()
    of_a2c = yaml.safe_load((Path(rl_zoo3.__file__).parent / "hyperparams" / "a2c.yml").read_text())["atari"]
    for key in ("env_wrapper", "frame_stack", "n_envs", "policy"):
        assert settings[key] == of_a2c[key]
    message = message_of(capsys, "train", "--algo", "finite_difference", "--env", "Game-v0")
    assert "must have an entry Game-v0 or atari" in message


def make_dicts():
    """CartPole with observations in a dict, of which one cannot be normalized."""
    env = gym.make("CartPole-v1")
    space = spaces.Dict({"obs": env.observation_space, "one": spaces.Discrete(2)})
    return gym.wrappers.TransformObservation(env, lambda obs: {"obs": obs, "one": 1}, space)


@pytest.mark.parametrize(("env", "changed"), [("FrozenLake-v1", {}), ("Dicts-v0", {"policy": "MultiInput{}"})])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_published_default_fits_observations_that_cannot_be_normalized(
    name, env, changed, tmp_path, monkeypatch, capsys
):
    spec = gym.envs.registration.EnvSpec("Dicts-v0", make_dicts, max_episode_steps=20)
    monkeypatch.setitem(gym.registry, "Dicts-v0", spec)
    common = ("-f", str(tmp_path), "-n", "100")
    train(name, *common, "--eval-freq", "-1", env=env)
    published = yaml.safe_load((HYPERPARAMS / f"{name}.yml").read_text())["default"]
    assert published.pop("normalize")
    changed = {key: value.format(POLICIES[name].removeprefix("Mlp")) for key, value in changed.items()}
    assert config_of(tmp_path / name / f"{env}_1") == published | changed
    zoo("enjoy", "--algo", name, "--env", env, *common, "--no-render")
    assert "Mean reward: " in capsys.readouterr().out


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_argument_that_may_be_a_schedule_may_fall(name, tmp_path):
    # The last two go with other actions, or with the natural step
    assert scheduled_keys(name) - {"min_std", "target_kl"} == SCHEDULED[name]
    assert name == "finite_difference" or scheduled_keys(name) >= {"min_std", "target_kl"}
    entry = dict.fromkeys(SCHEDULED[name], "lin_5E-1")
    entry |= {"policy": POLICIES[name], "n_timesteps": 64} | ({"n_delta": 2} if "delta_std" in entry else {})
    train(name, *conf(tmp_path, **{"CartPole-v1": entry}))
    model = load(tmp_path / name / RUN)
    for key in SCHEDULED[name]:
        assert [getattr(model, key)(left) for left in (1.0, 0.5, 0.0)] == [0.5, 0.25, 0.0]
    # What is written down can be read again
    assert config_of(tmp_path / name / RUN) == entry


@pytest.mark.parametrize("name", ALGORITHMS)
def test_a_model_goes_on_with_its_own_settings(name, tmp_path):
    params = [f"{key}:{value!r}" for key, value in OTHER[name].items()]
    common = ("-n", "100", "--eval-freq", "-1", "-f", str(tmp_path), "-params")
    train(name, *common, *params, f"policy:{POLICIES[name]!r}", "policy_kwargs:dict(net_arch=[5])")
    before = load(tmp_path / name / RUN)
    # With a rate of 0 what is saved is what was loaded
    train(name, "-i", str(tmp_path / name / RUN / "CartPole-v1.zip"), *common, "learning_rate:0.0")
    after = load(tmp_path / name / "CartPole-v1_2")
    for key, value in OTHER[name].items():
        present = getattr(after, key)
        assert (present(0.0) if callable(present) else present) == value
    before, after = (th.nn.utils.parameters_to_vector(model.policy.parameters()) for model in (before, after))
    assert th.equal(before, after)
    assert config_of(tmp_path / name / "CartPole-v1_2") == config_of(tmp_path / name / RUN) | {"learning_rate": 0.0}


def test_settings_that_the_zoos_own_commands_cannot_read_are_left_out(tmp_path, capsys):
    common = ("-f", str(tmp_path), "-n", "64")
    params = ("stats_window_size:50", "env_kwargs:None", "vec_env_wrapper:None")
    train("reinforce", *common, "--eval-freq", "-1", "-params", *params)
    train("reinforce", *common, "--eval-freq", "-1", "-i", str(tmp_path / "reinforce" / RUN / "CartPole-v1.zip"))
    assert load(tmp_path / "reinforce" / "CartPole-v1_2")._stats_window_size == 50
    zoo("enjoy", "--algo", "reinforce", "--env", "CartPole-v1", *common, "--no-render")
    assert "Mean reward: " in capsys.readouterr().out
    normalize = ("-params", "normalize:'dict(clip_obs=np.inf)'")
    assert "normalize must be Python" in message_of(capsys, "train", "--algo", "reinforce", *common, *normalize)


def test_a_conf_file_goes_before_the_settings_of_a_model(tmp_path):
    arguments = conf(tmp_path, **{"CartPole-v1": {"policy": "MlpPolicy", "n_timesteps": 64, "gamma": 0.5}})
    train("reinforce", "-n", "64", "--eval-freq", "-1", "-f", str(tmp_path))
    train("reinforce", "-i", str(tmp_path / "reinforce" / RUN / "CartPole-v1.zip"), *arguments)
    assert load(tmp_path / "reinforce" / "CartPole-v1_2").gamma == 0.5


@pytest.mark.parametrize(
    ("arguments", "length", "written"),
    [
        ((), 5, {}),
        (("--env-kwargs", "max_episode_steps:6"), 6, {}),
        (("-params", "train_env_kwargs:dict(max_episode_steps=6)"), 6, {"train_env_kwargs": {"max_episode_steps": 6}}),
        (
            ("-params", "env_kwargs:dict(max_episode_steps=6)", "train_env_kwargs:None"),
            6,
            {"env_kwargs": {"max_episode_steps": 6}, "train_env_kwargs": None},
        ),
    ],
)
def test_train_env_kwargs_are_for_training_only(arguments, length, written, tmp_path, capsys):
    entry = {"policy": "MlpPolicy", "n_timesteps": 64, "n_steps": 32}
    limit = {"max_episode_steps": 5}
    options = conf(tmp_path, **{"CartPole-v1": entry, "train_env_kwargs": {"CartPole-v1": limit}})
    train("reinforce", *options, "--eval-freq", "32", *arguments)
    run = tmp_path / "reinforce" / RUN
    # A pole does not fall within six steps
    assert {int(line.split(",")[1]) for line in (run / "0.monitor.csv").read_text().splitlines()[2:]} == {length}
    assert np.load(run / "evaluations.npz")["ep_lengths"].min() > 5
    assert config_of(run) == entry | {"train_env_kwargs": limit} | written
    zoo("enjoy", "--algo", "reinforce", "--env", "CartPole-v1", "-f", str(tmp_path), "-n", "50", "--no-render")
    assert min(map(int, re.findall(r"Episode Length (\d+)", capsys.readouterr().out))) > 5


@pytest.mark.parametrize(("arguments", "length"), [((), 5), (("--eval-env-kwargs", "max_episode_steps:6"), 6)])
def test_evaluations_have_the_env_kwargs_of_an_entry_or_their_own(arguments, length, tmp_path):
    entry = {"policy": "MlpPolicy", "n_timesteps": 64, "n_steps": 32, "env_kwargs": {"max_episode_steps": 5}}
    train("reinforce", *conf(tmp_path, **{"CartPole-v1": entry}), "--eval-freq", "32", *arguments)
    assert set(np.load(tmp_path / "reinforce" / RUN / "evaluations.npz")["ep_lengths"].flat) == {length}


def test_an_entry_goes_before_the_section_of_train_env_kwargs(tmp_path):
    entry = {"policy": "MlpPolicy", "n_timesteps": 64, "train_env_kwargs": {"max_episode_steps": 6}}
    section = {"CartPole-v1": {"max_episode_steps": 5}}
    train("reinforce", *conf(tmp_path, **{"CartPole-v1": entry, "train_env_kwargs": section}))
    assert config_of(tmp_path / "reinforce" / RUN) == entry


def test_the_shipped_train_env_kwargs_are_of_tasks_with_settings():
    published = yaml.safe_load((HYPERPARAMS / "reinforce.yml").read_text())
    assert published["train_env_kwargs"].keys() <= published.keys()


@pytest.mark.parametrize(
    "name", ["reinforce", *(pytest.param(name, marks=pytest.mark.slow) for name in ALGORITHMS if name != "reinforce")]
)
def test_optuna_tunes_and_its_trials_can_be_trained(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    study = ("--storage", "study.log", "--study-name", "study", "--eval-freq", "-1", "-n", "200")
    train(name, "-optimize", "--n-trials", "2", "--n-evaluations", "1", "--no-optim-plots", *study)
    backend = optuna.storages.journal.JournalFileBackend("study.log")
    trials = optuna.load_study(study_name="study", storage=optuna.storages.JournalStorage(backend)).trials
    assert [trial.state.name for trial in trials] == ["COMPLETE", "COMPLETE"]
    for number, trial in enumerate(trials):
        train(name, *study, "--trial-id", str(number))
        config = config_of(Path(f"logs/{name}/CartPole-v1_{number + 2}"))
        assert config["learning_rate"] == trial.params["learning_rate"]
    for options in (("--trial-id", "7"), ("--study-name", "other", "--trial-id", "0")):
        message = message_of(capsys, "train", "--algo", name, *study, *options)
        assert f"no trial {options[-1]} of {name} in a study '{'other' if 'other' in options else 'study'}'" in message


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_sample_makes_a_model_and_can_be_made_again_from_its_trial(name):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=1))
    tried = set()
    published = yaml.safe_load((HYPERPARAMS / f"{name}.yml").read_text())
    for entry, n_actions in (("CartPole-v1", 0), ("MountainCarContinuous-v0", 1)):
        settings = published.get(entry, published["default"])
        fixed = {key: settings[key] for key in ("policy", "estimator", "n_top") if key in settings}
        if name != "finite_difference":
            # Settings that a user may have configured
            fixed |= {"reward_to_go": False, "episodes_per_start": 4}
        for _ in range(20):
            trial = study.ask()
            sample = HYPERPARAMS_SAMPLER[name](trial, n_actions, 8, {})
            assert HYPERPARAMS_CONVERTER[name](trial.params) == sample
            if name != "finite_difference":
                assert sample["policy_kwargs"].get("log_std_init") == trial.params.get("log_std_init")
                assert ("log_std_init" in trial.params) == (n_actions > 0)
                memory = sample["policy_kwargs"].get("memory")
                tried.add((sample["baseline"], sample["step"], sample["n_steps"] is None, memory))
            model = ALGORITHMS[name](env=entry, device="cpu", **{**fixed, **sample})
            assert name == "finite_difference" or model.n_episodes is None or model.n_episodes >= 8
    if name != "finite_difference":
        baselines, steps, are_whole, memories = map(set, zip(*tried, strict=True))
        assert len(baselines) == 4 and steps == {"optimizer", "natural"}
        assert {whole for baseline, _, whole, _ in tried if baseline == "value"} == are_whole == {False, True}
        assert memories == ({*MEMORIES} if name == "reinforce_lstm" else {None})


ENTRIES = [
    # Its first rollout takes half a minute
    pytest.param(name, env, marks=[pytest.mark.slow] if env == "CarRacing-v3" else [])
    for name in ALGORITHMS
    for env in yaml.safe_load((HYPERPARAMS / f"{name}.yml").read_text())
    # test_zoo.py trains CartPole-v1
    if env not in ("CartPole-v1", "atari", "default", "train_env_kwargs")
]


@pytest.mark.parametrize(("name", "env"), ENTRIES)
def test_every_entry_trains(name, env, tmp_path):
    try:
        rl_zoo3.utils.gym.make(env).close()
    except DependencyNotInstalled as error:
        pytest.skip(str(error))
    if env == "CarRacing-v3":
        pytest.importorskip("cv2")
    train(name, "-n", "1", "--eval-freq", "-1", "-f", str(tmp_path), env=env)
    assert (tmp_path / name / f"{env}_1" / f"{env}.zip").exists()


KEPT = [
    ({"policy": "sb3_reinforce.MaskedPolicy"}, "sb3_reinforce.MaskedPolicy"),
    ({"policy": "MaskedPolicy"}, "MaskedPolicy"),
    ({"normalize": "dict(norm_obs=False)"}, "MultiInputPolicy"),
    ({"normalize": "dict(norm_obs_keys=['observation'])"}, "MultiInputPolicy"),
    ({"normalize": "dict(norm_obs_keys=['action_mask'])"}, "MultiInputPolicy"),
    ({"normalize": True}, "MultiInputPolicy"),
]


@pytest.mark.parametrize(("settings", "policy"), KEPT)
def test_a_default_keeps_what_goes_with_masks(settings, policy, tmp_path, monkeypatch):
    def masked():
        return ActionMaskObservation(ActionMasker(gym.make("CartPole-v1"), lambda env: np.ones(2, dtype=bool)))

    monkeypatch.setitem(gym.registry, "Masked-v0", gym.envs.registration.EnvSpec("Masked-v0", masked))
    default = {"policy": "MlpPolicy", "n_timesteps": 32, **settings}
    train("reinforce", *conf(tmp_path, default=default), env="Masked-v0")
    config = config_of(tmp_path / "reinforce" / "Masked-v0_1")
    assert config["policy"] == policy
    is_possible = settings.get("normalize") not in (True, "dict(norm_obs_keys=['action_mask'])")
    assert config.get("normalize") == (settings.get("normalize") if is_possible else None)
