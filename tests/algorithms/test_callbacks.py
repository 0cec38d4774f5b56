"""Callbacks find, change and stop what they do in A2C, and the logs have its keys."""

import json

import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor
from gymnasium import spaces
from models import KINDS, all_kinds, both_extents, make
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import (
    CheckpointCallback,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import REINFORCE


@both_extents
def test_callbacks_find_the_locals_of_a2c(kind):
    """Also after a time limit, at which A2C has more."""
    env = make_vec_env(lambda: Corridor((4,), truncate=True), 2)
    models = [make(kind, env), A2C("MlpPolicy", env, n_steps=8, device="cpu")]
    ours, theirs = (Record(lambda model, i=i: set(records[i].locals), "step") for i in range(2))
    records = [ours, theirs]
    for model, record in zip(models, records, strict=True):
        model.learn(16, record)
    left_out = {"obs_tensor", "n_rollout_steps", "idx", "done", "terminal_value"}
    assert ours.records[-1] >= theirs.records[-1] - left_out and left_out <= theirs.records[-1]
    (place, *_), obs = zip(*ours.locals["terminal_obs"].items(), strict=True)
    assert place == (3, 0) and all(env.observation_space.contains(each) for each in obs)


def test_the_observation_of_a_step_is_the_models_last_one():
    """The documentation names it in the place of A2C's ``obs_tensor``."""
    model = make("steps", make_vec_env(lambda: Corridor((4,)), 2))
    last = Record(lambda model: model._last_obs.copy(), "step")
    model.learn(16, last)
    assert np.array_equal(last.records, model.rollout_buffer.observations)


def test_idle_environments_of_a_search_end_episodes_too():
    ends = Record(lambda model: [ends.locals[name].sum() for name in ("dones", "finished")], "step")
    env = make_vec_env(lambda: Corridor((4,)), 3)
    make("search", env, n_delta=1, estimator="central").learn(1, ends)
    assert np.sum(ends.records, axis=0).tolist() == [3, 2]


@all_kinds
def test_a_callback_stops_training_at_the_very_step(kind):
    model = make(kind, make_vec_env(lambda: Corridor((4,)), 2))

    def stop(locals_, globals_):
        assert locals_.keys() >= {"self", "new_obs", "rewards", "dones", "infos"}
        assert kind != "search" or "finished" in locals_
        return np.bool_(model.num_timesteps < 42)

    ends = Record(lambda model: None)
    model.learn(1000, callback=[ends, ConvertCallback(stop)])
    assert model.num_timesteps == 42 and model._n_updates == len(ends.records)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps >= 62


@all_kinds
def test_a_callback_that_forgets_to_return_true_is_named(kind):
    model = make(kind, Corridor())
    with pytest.warns(UserWarning, match="A callback returned None, which stops training: return True to go on"):
        model.learn(64, lambda *_: None)
    assert model.num_timesteps == 1


def test_at_the_end_of_a_rollout_a_callback_finds_the_dones_of_its_last_step():
    ends = Record(lambda model: ends.locals["dones"].tolist())
    make("steps", make_vec_env(lambda: Corridor((4,)), 2)).learn(32, ends)
    assert ends.records == [[True, True]] * 2


@all_kinds
def test_callbacks_of_sb3(kind, tmp_path):
    env, eval_env = (VecNormalize(make_vec_env("CartPole-v1", n_envs)) for n_envs in (2, 1))
    stop, every = StopTrainingOnRewardThreshold(reward_threshold=1e9), Record(lambda model: None, at="step")
    callbacks = [
        CheckpointCallback(save_freq=50, save_path=tmp_path, save_vecnormalize=True),
        EvalCallback(eval_env, callback_on_new_best=stop, best_model_save_path=tmp_path, eval_freq=60, verbose=0),
        EveryNTimesteps(80, every),
        LogEveryNTimesteps(70),
    ]
    with pytest.warns(Warning, match="rich is experimental"):
        make(kind, env).learn(300, callback=callbacks, progress_bar=True)
    assert (tmp_path / "best_model.zip").exists() and every.records
    KINDS[kind][0].load(next(tmp_path.glob("rl_model_*steps.zip")))
    assert VecNormalize.load(str(next(tmp_path.glob("*vecnormalize*"))), make_vec_env("CartPole-v1", 2)).training


def logged(model, folder):
    """The last value of each key."""
    model.set_logger(configure(str(folder), ["json"]))
    model.learn(64 * 4, log_interval=1)
    model.logger.close()
    return {
        key: value
        for line in (folder / "progress.json").read_text().splitlines()
        for key, value in json.loads(line).items()
    }


@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1"])
def test_the_log_has_the_keys_of_a2c_and_more(env, tmp_path):
    ours, theirs = (algorithm("MlpPolicy", env, n_steps=64) for algorithm in (REINFORCE, A2C))
    more = {"train/grad_norm", "train/kl", "rollout/complete_fraction"}
    assert logged(ours, tmp_path / "ours").keys() == logged(theirs, tmp_path / "theirs").keys() | more


def test_the_log_of_a_search(tmp_path):
    model = make("search", policy="LinearPolicy", policy_kwargs={}, estimator="regression", n_delta=20)
    log = logged(model, tmp_path)
    train = "n_updates learning_rate delta_std grad_norm r_squared residual_std standard_error"
    rollout = "ep_rew_mean ep_len_mean utility_mean utility_std"
    clock = "iterations fps time_elapsed total_timesteps"
    folders = {"train": train, "rollout": rollout, "time": clock}
    assert log.keys() == {f"{folder}/{key}" for folder, keys in folders.items() for key in keys.split()}
    assert np.isfinite(list(log.values())).all() and log["time/total_timesteps"] == model.num_timesteps


@all_kinds
def test_the_log_interval(kind, tmp_path):
    model = make(kind, Corridor((3,)))
    model.set_logger(configure(str(tmp_path), ["json"]))
    model.learn(60, log_interval=2)
    model.logger.close()
    rows = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert [row["time/iterations"] for row in rows] == list(range(2, model._n_updates + 1, 2)) != []


def test_the_logged_standard_deviation_is_the_mean_over_the_actions():
    env = Corridor(action_space=spaces.Box(-1, 1, (2,)))
    model = make("steps", env, n_steps=6, learning_rate=0.0)
    with th.no_grad():
        model.policy.log_std.copy_(th.tensor([0.5, -1.0]))
    std = model.learn(6).logger.name_to_value["train/std"]
    assert std == pytest.approx((np.exp(0.5) + np.exp(-1.0)) / 2)


@pytest.mark.parametrize("mode", [{"n_steps": 8}, {"n_episodes": 5}])
def test_a_callback_may_read_the_buffer_in_minibatches_or_change_its_advantages(mode):
    """``get`` puts the rows of each environment one after the other; training is the same as without it."""

    def read(model):
        next(model.rollout_buffer.get(batch_size=3))

    def scale(model):
        read(model)
        model.rollout_buffer.advantages *= 0.0

    plain, with_reading, with_scaling = (
        REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 3, seed=0), seed=0, device="cpu", **mode)
        .learn(20, callback=Record(function))
        .policy.action_net.weight
        for function in (lambda model: None, read, scale)
    )
    assert th.equal(plain, with_reading) and not th.equal(plain, with_scaling)


def test_a_callback_may_shape_the_rewards_in_place():
    def shape(locals_, globals_):
        locals_["rewards"] *= 5
        return True

    model = make("steps").learn(8, callback=shape)
    assert (model.rollout_buffer.rewards == 5).all()


@all_kinds
def test_callbacks_of_sb3_stop_the_training(kind):
    """After three episodes of each of two environments, all of four steps."""
    env = make_vec_env(lambda: Corridor((4,)), 2)
    assert make(kind, env).learn(1000, StopTrainingOnMaxEpisodes(3)).num_timesteps == 24
