"""What works with A2C works here: spaces, policies, environments, buffers, saving."""

import copy
import gc
import pickle
import weakref
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor, Random, Reused, native
from gymnasium import spaces
from models import KINDS, Scaled, all_kinds, both_extents, make, moved_by_learning
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor

from sb3_reinforce import REINFORCE, reinforce
from sb3_reinforce.common import settings
from sb3_reinforce.diagnostics import GradientQualityCallback, PitfallCallback, compare_baselines, landscape
from sb3_reinforce.estimation import weights
from sb3_reinforce.recurrent import RecurrentREINFORCE

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


def make_for_spaces(kind, env, policy):
    """A small model of a kind, or with a memory."""
    if kind != "recurrent":
        return make(kind, env, policy, seed=0)
    small = {"lstm_hidden_size": 4, "net_arch": [4]}
    policy = policy.replace("Policy", "LstmPolicy")
    return RecurrentREINFORCE(policy, env, n_episodes=2, policy_kwargs=small, seed=0, device="cpu")


@pytest.mark.parametrize("kind", [*KINDS, "recurrent"])
@pytest.mark.parametrize(("observation_space", "action_space", "policy"), SPACES, ids=str)
def test_spaces(kind, observation_space, action_space, policy):
    """In training and in ``predict``; the stored actions of discrete spaces count from 0."""
    env = make_vec_env(lambda: Random(observation_space, action_space), 2, seed=0)
    model = make_for_spaces(kind, env, policy)
    assert_trains(model)
    assert kind == "search" or isinstance(action_space, spaces.Box) or model.rollout_buffer.actions.min() == 0
    actions, _ = model.predict(env.reset())
    assert len(actions) == 2 and all(action_space.contains(action) for action in actions)
    # As in A2C, an array also for one observation
    action, _ = model.predict(observation_space.sample())
    assert isinstance(action, np.ndarray) or np.any(getattr(action_space, "start", 0))


@pytest.mark.parametrize("squash_output", [False, True])
@pytest.mark.parametrize(("sde_sample_freq", "steps"), [(-1, [0]), (4, [0, 0, 4])])
def test_gsde(squash_output, sde_sample_freq, steps, monkeypatch):
    kwargs = {"policy_kwargs": {"net_arch": [8], "squash_output": squash_output}}
    env = make_vec_env("Pendulum-v1", 2)
    model = make("steps", env, use_sde=True, sde_sample_freq=sde_sample_freq, ent_coef=0.01, **kwargs)
    drawn, reset_noise = [], model.policy.reset_noise

    def draw(n_envs):
        assert n_envs == 2
        drawn.append(model.num_timesteps // 2 % model.n_steps)
        reset_noise(n_envs)

    monkeypatch.setattr(model.policy, "reset_noise", draw)
    assert_trains(model)
    assert drawn == steps * model._n_updates


@all_kinds
@pytest.mark.parametrize("n_envs", [1, 2, 256])
def test_numbers_of_environments(n_envs, kind):
    model = make(kind, make_vec_env(lambda: Corridor((2, 3)), n_envs)).learn(8 * n_envs)
    assert model.num_timesteps >= 8 * n_envs and model._n_updates >= 1


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
    assert all(map(th.equal, *(parameters_after_training(kind, VecMonitor(native(3))) for _ in range(2))))


@all_kinds
def test_memory_does_not_grow_with_updates_or_episodes(kind, monkeypatch):
    """Of all rollouts, or estimates of a search, at most the last one is kept, and the training data of none."""
    made = []

    def kept(function):
        def call(*args, **kwargs):
            result = function(*args, **kwargs)
            made.append([weakref.ref(part) for part in (result if isinstance(result, tuple) else (result,))])
            return result

        return call

    # Without a Monitor, which keeps three numbers of every episode
    model = make(kind, DummyVecEnv([lambda: Corridor((2, 6))] * 2))
    if kind == "search":
        monkeypatch.setattr(model, "estimate_gradient", kept(model.estimate_gradient))
    else:
        monkeypatch.setattr(reinforce, "training_batch", kept(reinforce.training_batch))
        monkeypatch.setattr(weights, "Rollout", kept(weights.Rollout))
    model.learn(400)
    gc.collect()
    assert len(made) > 20
    assert sum(ref() is not None for refs in made for ref in refs) <= 1


def test_a_policy_may_be_compiled():
    model = make("steps")
    model.policy = th.compile(model.policy, backend="eager")
    assert any("action_net" in name for name in moved_by_learning(model, 16))


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


@pytest.mark.parametrize(("n_envs", "n_processes", "n_episodes"), [(1, 1, 16), (20, 1, 20), (10, 2, 20)])
def test_by_default_each_environment_has_an_episode(n_envs, n_processes, n_episodes, monkeypatch):
    monkeypatch.setattr(settings, "rank_and_size", lambda: (0, n_processes))
    env = make_vec_env("CartPole-v1", n_envs)
    assert REINFORCE("MlpPolicy", env, baseline="none", device="cpu").n_episodes == n_episodes
    recurrent = RecurrentREINFORCE("MlpLstmPolicy", env, device="cpu")
    assert (recurrent.n_steps, recurrent.n_episodes) == (None, n_episodes)


@both_extents
def test_a_vec_env_may_reuse_its_arrays(kind):
    outcomes = []
    for wrapper in (lambda env: env, Reused):
        env = wrapper(make_vec_env(lambda: Corridor((2, 3, 5), truncate=True), 2, seed=0))
        outcomes.append(make(kind, env, seed=0).learn(100).policy.parameters())
    assert all(map(th.equal, *outcomes))


def test_rollout_buffer_classes():
    model = make("steps", rollout_buffer_class=RolloutBuffer, rollout_buffer_kwargs={})
    assert type(model.rollout_buffer) is RolloutBuffer
    for name in ("add", "get", "compute_returns_and_advantage"):
        own = type("Own", (RolloutBuffer,), {name: lambda self, *args, **kwargs: None})
        with pytest.warns(UserWarning, match=f"Own overrides {name},"):
            make("steps", rollout_buffer_class=own)
    with pytest.raises(TypeError, match="wrong_keyword"):
        make("steps", rollout_buffer_kwargs={"wrong_keyword": 1})


def test_the_policy_can_be_pickled_and_copied():
    kwargs = {"net_arch": [4], "features_extractor_class": Scaled}
    policy = make("steps", temperature=0.5, policy_kwargs=kwargs).learn(16).policy
    obs = th.randn(5, 4)
    for other in (copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert all(map(th.equal, policy.parameters(), other.parameters()))
        # With the temperature
        assert th.equal(*(each.get_distribution(obs).distribution.logits for each in (policy, other)))


@pytest.mark.parametrize(
    ("env", "callback"), [("CartPole-v1", PitfallCallback), ("Pendulum-v1", partial(GradientQualityCallback, 1))]
)
def test_the_policy_can_be_copied_where_a_callback_has_measured(env, callback):
    def can_be_copied(model):
        return all(map(th.equal, copy.deepcopy(model.policy).parameters(), model.policy.parameters()))

    copies = Record(can_be_copied)
    model = make("episodes", gym.make(env, max_episode_steps=20), baseline="optimal")
    model.learn(1, [callback(), copies])
    assert copies.records == [True]
    for measure in (compare_baselines, partial(landscape, n_points=2)):
        measure(model, n_episodes=3)
        assert can_be_copied(model)
