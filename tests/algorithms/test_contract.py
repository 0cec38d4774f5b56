"""What works with A2C works here: spaces, policies, environments, callbacks, logs, saving."""

import copy
import gc
import json
import pickle
import tracemalloc

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor, Random, Reused
from gymnasium import spaces
from models import KINDS, all_kinds, make, moved_by_learning
from stable_baselines3 import A2C
from stable_baselines3.common.buffers import RolloutBuffer
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
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_reinforce import REINFORCE
from sb3_reinforce.common import settings
from sb3_reinforce.envs.vec_env import GymnasiumVecEnv
from sb3_reinforce.recurrent import RecurrentREINFORCE

both_modes = pytest.mark.parametrize("kind", ["steps", "episodes"])


FLAT = spaces.Box(-1, 1, (3,))


IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)


DICT = spaces.Dict({"image": IMAGE, "flat": FLAT, "n": spaces.Discrete(3)})


TWO = spaces.Discrete(2)


SPACES = [
    (spaces.Box(-1, 1, (2, 2), np.float64), TWO, "MlpPolicy"),
    (spaces.Discrete(4), TWO, "MlpPolicy"),
    (spaces.MultiDiscrete([2, 3]), TWO, "MlpPolicy"),
    (spaces.MultiBinary(3), TWO, "MlpPolicy"),
    (IMAGE, TWO, "CnnPolicy"),
    (DICT, TWO, "MultiInputPolicy"),
    (FLAT, spaces.Discrete(3), "MlpPolicy"),
    (FLAT, spaces.Discrete(3, start=-1), "MlpPolicy"),
    (FLAT, spaces.MultiDiscrete([2, 3]), "MlpPolicy"),
    (FLAT, spaces.MultiDiscrete([2, 3], start=[7, -1]), "MlpPolicy"),
    (FLAT, spaces.MultiBinary(3), "MlpPolicy"),
    (FLAT, spaces.Box(-2, 1, (2,)), "MlpPolicy"),
    (FLAT, spaces.Box(-1, 1, (2, 3)), "MlpPolicy"),
    (FLAT, spaces.Box(-1, 1, (2,), np.float64), "MlpPolicy"),
]


def assert_trains(model):
    assert "action_net.weight" in moved_by_learning(model, 60)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@all_kinds
@pytest.mark.parametrize(("observation_space", "action_space", "policy"), SPACES, ids=str)
def test_spaces(observation_space, action_space, policy, kind):
    """In training and in ``predict``; the stored actions of discrete spaces count from 0."""
    env = make_vec_env(lambda: Random(observation_space, action_space), 2, seed=0)
    model = make(kind, env, policy, seed=0)
    assert_trains(model)
    assert kind == "search" or isinstance(action_space, spaces.Box) or model.rollout_buffer.actions.min() == 0
    actions, _ = model.predict(env.reset())
    assert len(actions) == 2 and all(action_space.contains(action) for action in actions)


@pytest.mark.parametrize("squash_output", [False, True])
@pytest.mark.parametrize(("sde_sample_freq", "draws"), [(-1, 1), (4, 3)])
def test_gsde(squash_output, sde_sample_freq, draws, monkeypatch):
    kwargs = {"policy_kwargs": {"net_arch": [8], "squash_output": squash_output}}
    env = make_vec_env("Pendulum-v1", 2)
    model = make("steps", env, use_sde=True, sde_sample_freq=sde_sample_freq, ent_coef=0.01, **kwargs)
    calls, reset_noise = [], model.policy.reset_noise
    monkeypatch.setattr(model.policy, "reset_noise", lambda *args: calls.append(args) or reset_noise(*args))
    assert_trains(model)
    assert calls == [(2,)] * draws * model._n_updates


@all_kinds
@pytest.mark.parametrize("n_envs", [1, 2, 256])
def test_numbers_of_environments(n_envs, kind):
    model = make(kind, make_vec_env(lambda: Corridor((2, 3)), n_envs)).learn(8 * n_envs)
    assert model.num_timesteps >= 8 * n_envs and model._n_updates >= 1


def gymnasium_env():
    return VecMonitor(GymnasiumVecEnv(gym.make_vec("CartPole-v1", 3, vectorization_mode="vector_entry_point")))


def parameters_after_training(kind, env):
    env.seed(5)
    model = make(kind, env, seed=5).learn(300)
    env.close()
    return [*model.policy.parameters(), th.tensor(model.num_timesteps)]


@all_kinds
def test_the_same_seed_gives_the_same_parameters(kind):
    """On each kind of VecEnv, and in subprocesses as in this process."""
    dummy, again, subproc = (
        parameters_after_training(kind, make_vec_env("CartPole-v1", 3, vec_env_cls=vec_env_cls))
        for vec_env_cls in (DummyVecEnv, DummyVecEnv, SubprocVecEnv)
    )
    assert all(map(th.equal, dummy, again)) and all(map(th.equal, dummy, subproc))
    assert all(map(th.equal, *(parameters_after_training(kind, gymnasium_env()) for _ in range(2))))


def memory():
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


@all_kinds
def test_memory_does_not_grow_with_updates_or_episodes(kind):
    # Without a Monitor, which keeps three numbers of every episode
    model = make(kind, DummyVecEnv([lambda: Corridor((2, 6))] * 2))
    callback = Record(lambda model: memory() if model._n_updates % 50 == 0 else None)
    tracemalloc.start()
    model.learn({"steps": 3200, "episodes": 2800, "search": 4000}[kind], callback)
    tracemalloc.stop()
    sizes = list(filter(None, callback.records))
    assert len(sizes) >= 4
    # A rollout that was kept would be kilobytes an update; the caches of NumPy and PyTorch fill up at a hundredth
    assert sizes[-1] - sizes[1] < 250 * 50 * (len(sizes) - 2), sizes


def test_a_policy_may_be_compiled():
    model = make("steps")
    model.policy = th.compile(model.policy, backend="eager")
    assert any("action_net" in name for name in moved_by_learning(model, 16))


LOCALS = {"self", "new_obs", "rewards", "dones", "infos"}


LOCALS_OF_A2C = {
    *(LOCALS | {"env", "rollout_buffer", "total_timesteps", "tb_log_name"}),
    *("actions", "clipped_actions", "values", "log_probs", "n_steps"),
}


@all_kinds
def test_a_callback_stops_training_at_the_very_step(kind):
    model = make(kind, make_vec_env(lambda: Corridor((4,)), 2))

    def stop(locals_, globals_):
        assert locals_.keys() >= (LOCALS | {"finished"} if kind == "search" else LOCALS_OF_A2C)
        return np.bool_(model.num_timesteps < 42)

    ends = Record(lambda model: None)
    model.learn(1000, callback=[ends, ConvertCallback(stop)])
    assert model.num_timesteps == 42 and model._n_updates == len(ends.records)
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps >= 62


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
        StopTrainingOnMaxEpisodes(40),
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


def test_tensorboard(tmp_path):
    make("steps", tensorboard_log=tmp_path).learn(32, log_interval=100)
    assert list((tmp_path / "REINFORCE_1").glob("events*"))


@all_kinds
def test_load_with_another_number_of_environments(kind, tmp_path):
    make(kind, make_vec_env("CartPole-v1", 2)).learn(100).save(tmp_path / "model")
    model = KINDS[kind][0].load(tmp_path / "model", env=make_vec_env("CartPole-v1", 5)).learn(100)
    assert model.n_envs == 5 and (kind == "search" or model.rollout_buffer.rewards.shape[1] == 5)


def test_the_callers_policy_kwargs_are_not_written_to():
    policy_kwargs = {"net_arch": [8]}
    model = make("steps", policy_kwargs=policy_kwargs).learn(32)
    model.policy_kwargs["net_arch"] = None
    assert policy_kwargs == {"net_arch": [8]}


@pytest.mark.parametrize("force_reset", [True, False])
def test_set_env_resets_on_request(force_reset):
    model = make("steps", Corridor((7,))).learn(8)
    model.set_env(model.env, force_reset)
    rollout = model.learn(8, reset_num_timesteps=False).rollout
    assert rollout.timesteps[0].tolist() == [0 if force_reset else 1]


@pytest.mark.parametrize(("space", "policy"), [(FLAT, "MlpPolicy"), (IMAGE, "CnnPolicy"), (DICT, "MultiInputPolicy")])
def test_the_critics_passes_leave_the_actor_and_a_shared_extractor_alone(space, policy):
    """One policy step per rollout: at policy rate 0 nothing that the actor depends on moves, and the critic does."""
    model = REINFORCE(policy, Random(space), n_steps=10, learning_rate=0.0, critic_learning_rate=1e-3)
    names = {name for name, _ in model.policy.named_parameters()}
    assert moved_by_learning(model, 20) == {name for name in names if "value_net" in name}


@pytest.mark.parametrize(("n_envs", "n_processes", "n_episodes"), [(1, 1, 16), (20, 1, 20), (10, 2, 20)])
def test_by_default_each_environment_has_an_episode(n_envs, n_processes, n_episodes, monkeypatch):
    monkeypatch.setattr(settings, "rank_and_size", lambda: (0, n_processes))
    env = make_vec_env("CartPole-v1", n_envs)
    assert REINFORCE("MlpPolicy", env, baseline="none", device="cpu").n_episodes == n_episodes
    recurrent = RecurrentREINFORCE("MlpLstmPolicy", env, device="cpu")
    assert (recurrent.n_steps, recurrent.n_episodes) == (None, n_episodes)


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


@both_modes
def test_a_vec_env_may_reuse_its_arrays(kind):
    outcomes = []
    for wrapper in (lambda env: env, Reused):
        env = wrapper(make_vec_env(lambda: Corridor((2, 3, 5), truncate=True), 2, seed=0))
        outcomes.append(make(kind, env, seed=0).learn(100).policy.parameters())
    assert all(map(th.equal, *outcomes))


class OwnAdd(RolloutBuffer):
    def add(self, *args, **kwargs):
        return super().add(*args, **kwargs)


def test_rollout_buffer_classes():
    model = make("steps", rollout_buffer_class=RolloutBuffer, rollout_buffer_kwargs={})
    assert type(model.rollout_buffer) is RolloutBuffer
    with pytest.warns(UserWarning, match=r"OwnAdd overrides add"):
        make("steps", rollout_buffer_class=OwnAdd)
    with pytest.raises(TypeError, match="wrong_keyword"):
        make("steps", rollout_buffer_kwargs={"wrong_keyword": 1})


def test_the_policy_can_be_pickled_and_copied():
    policy = make("steps", temperature=0.5).policy
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert all(map(th.equal, policy.parameters(), other.parameters()))
