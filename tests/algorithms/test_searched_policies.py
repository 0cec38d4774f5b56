"""A search with other policies, callbacks and functions of the user, and with VecNormalize."""

import copy
import pickle
from functools import partial

import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Random
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from models import OwnPrediction, Scaled, plain
from searches import Line, make
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import FiniteDifference


def test_a_callback_finds_the_center_in_the_policy_and_can_stop_at_any_step():
    model = make(make_vec_env("CartPole-v1", 4))
    theta, thetas = model.theta, Record(lambda model: model.theta, at="step")
    model.learn(10_000, [thetas, At(7)])
    assert len(thetas.records) == 7 and all(th.equal(each, theta) for each in [*thetas.records, model.theta])


@pytest.mark.parametrize("norm_obs", [True, False])
def test_vec_normalize_is_frozen_in_an_update_and_learns_between(norm_obs):
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_obs=norm_obs)
    seen = Record(lambda model: (env.training, env.obs_rms.count if norm_obs else 0), at="step")
    model = make(env).learn(1, seen)
    ((training, count),) = set(seen.records)
    assert training and env.training and model._n_updates == 1
    if norm_obs:
        assert env.obs_rms.count == pytest.approx(count + model.num_timesteps)
        count = env.obs_rms.count
        env.training = False
        model.learn(1)
        assert env.obs_rms.count == count and not env.training


def test_vec_normalize_learns_from_the_original_observations():
    env = VecNormalize(make_vec_env("CartPole-v1", 2, seed=0))
    before = Record(lambda model: copy.deepcopy(env.obs_rms), "rollout_start")
    seen = Record(lambda model: env.get_original_obs(), "step")
    make(env).learn(1, [before, seen])
    (expected,) = before.records
    for obs in seen.records:
        expected.update(obs)
    np.testing.assert_allclose(env.obs_rms.mean, expected.mean, rtol=1e-9)
    np.testing.assert_allclose(env.obs_rms.var, expected.var, rtol=1e-9)


def test_a_search_is_the_same_with_and_without_a_callback():
    found = []
    for callback in (None, lambda *_: True):
        env = VecNormalize(make_vec_env("CartPole-v1", 2, seed=0))
        model = make(env).learn(60, callback)
        moments = env.obs_rms.mean.tolist(), env.obs_rms.var.tolist(), env.obs_rms.count
        lengths = [info["l"] for info in model.ep_info_buffer]
        found.append([model.theta.tolist(), moments, lengths, model.num_timesteps, env.training])
    assert found[0] == found[1]


def test_a_callback_may_stop_the_statistics_of_vec_normalize():
    env = VecNormalize(make_vec_env("CartPole-v1", 2))
    make(env).learn(60, At(3, lambda model: setattr(env, "training", False)))
    assert not env.training and env.obs_rms.count == pytest.approx(2 + 2 * 3, abs=1e-3)


def test_a_stopped_update_leaves_its_observations_in_the_statistics():
    env = VecNormalize(make_vec_env("CartPole-v1", 2))
    model = make(env).learn(1000, At(7))
    assert model._n_updates == 0 and env.obs_rms.count == pytest.approx(2 + model.num_timesteps, abs=1e-3)
    model.set_logger(Logger(None, []))
    callback = At(1)
    callback.init_callback(model)
    assert model.estimate_gradient(callback) is None


def test_a_linear_policy_on_dicts():
    """Where a features extractor puts them in a row."""
    space = spaces.Dict(once=spaces.Box(-1, 1, (1,)), twice=spaces.Box(-2, 2, (1,)))
    doubled = partial(TransformObservation, func=lambda s: {"once": s, "twice": 2 * s}, observation_space=space)
    env = make_vec_env(lambda: doubled(Line()), 2)
    model = make(env, policy_kwargs={"features_extractor_class": CombinedExtractor}).learn(20)
    assert model.n_parameters == 2 and model._n_updates > 0
    with pytest.raises(ValueError, match="use MultiInputPolicy"):
        make(env)


def test_a_features_extractor_of_the_user_is_searched_and_left_as_it_was():
    model = make(Line(), "MlpPolicy", policy_kwargs=dict(features_extractor_class=Scaled), learning_rate=0.0)
    before, n_parameters = plain(model.policy.state_dict()), model.n_parameters
    for _ in range(2):
        model.learn(20)
        assert plain(model.policy.state_dict()) == before
    model.policy.features_extractor.requires_grad_(False)
    assert model.n_parameters == n_parameters - 1


class Log(FlattenExtractor):
    """Is not defined at 0."""

    def forward(self, observations):
        return super().forward(observations).log()


def test_a_features_extractor_is_asked_within_the_space():
    model = make(Random(spaces.Box(0.5, 2, (3,))), "MlpPolicy", policy_kwargs={"features_extractor_class": Log})
    assert model.learn(10)._n_updates == 1


def test_what_a_callback_freezes_is_searched_for_the_last_time():
    model = make(Line(), "MlpPolicy")
    hidden = [plain(model.policy.mlp_extractor.state_dict())]
    for _ in range(2):
        model.learn(6, Record(lambda model: model.policy.mlp_extractor.requires_grad_(False)))
        hidden.append(plain(model.policy.mlp_extractor.state_dict()))
    assert model._n_updates == 2 and hidden[0] != hidden[1] == hidden[2]


def test_a_model_can_be_copied_when_new_and_pickled_after_learning():
    model = make(Line())
    same = copy.deepcopy(model)
    assert th.equal(model.learn(60).theta, same.learn(60).theta)
    again = pickle.loads(pickle.dumps(model))
    assert th.equal(model.learn(60).theta, again.learn(60).theta)


def test_a_model_that_a_callback_saves_is_not_collecting(tmp_path):
    seen = Record(lambda model: model.save(tmp_path / "model") or model.is_collecting, at="step")
    model = make(Line()).learn(1, seen)
    assert all(seen.records)
    assert not model.is_collecting and not FiniteDifference.load(tmp_path / "model").is_collecting


def test_a_policy_with_code_of_its_own_gives_the_same_and_says_that_it_is_slower(capsys):
    thetas = []
    for policy, verbose in (("MlpPolicy", 0), (OwnPrediction, 1)):
        model = make(make_vec_env("CartPole-v1", 2), policy, n_delta=2, verbose=verbose)
        thetas.append(model.learn(100, log_interval=None).theta)
    assert "OwnPrediction is not a plain MLP" in capsys.readouterr().out
    th.testing.assert_close(*thetas)


def test_a_perturbation_and_an_estimator_of_the_user():
    def estimator(utility, theta, deltas):
        # Two calls: rows that are compared meet the same episodes
        plus, minus = utility(theta + deltas), utility(theta - deltas)
        return (plus - minus) @ deltas / (2 * (deltas**2).sum())

    ones = lambda k, n, generator: th.ones(k, n)  # noqa: E731
    model = make(Line(), estimator=estimator, perturbation=ones, learning_rate=0.1).learn(1000)
    assert float(model.theta) == pytest.approx(3, abs=0.3)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        (dict(estimator=lambda u, t, d: t[:1]), r"estimator must return a tensor of shape \(8,\), got .*\(1,\)"),
        (dict(estimator=lambda u, t, d: 3.0), r"estimator must return a tensor of shape \(8,\), got 3.0"),
        (dict(estimator=lambda u, t, d: t * np.nan), "estimator must return finite numbers"),
        (dict(estimator=lambda u, t, d: t), "estimator must call the utility at least once"),
        (dict(estimator=lambda u, t, d: u(t)), r"estimator must call the utility with a finite tensor of .*\(8,\)"),
        (dict(estimator=lambda u, t, d: u(d / 0)), "estimator must call the utility with a finite tensor"),
        (dict(perturbation=lambda k, n, g: th.ones(n, k)), r"perturbation must return a tensor of shape \(3, 8\)"),
        (dict(perturbation=lambda k, n, g: th.full((k, n), th.inf)), "perturbation must return finite numbers"),
        (dict(perturbation=lambda k, n, g: th.zeros(k, n)), "no usable direction"),
        (dict(estimator="regression", n_delta=9, perturbation=lambda k, n, g: th.ones(k, n)), "no usable direction"),
        (dict(max_episode_steps=3), "has not ended after max_episode_steps=3 steps"),
    ],
)
def test_what_a_user_returns_wrongly_is_named_and_theta_stays(kwargs, match):
    model = make(**kwargs)
    theta = model.theta
    with pytest.raises(ValueError, match=match):
        model.learn(100)
    assert th.equal(model.theta, theta) and model._n_updates == 0
