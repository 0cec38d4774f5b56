"""What is collected: quotas, cuts, time limits, the buffer, the counts."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.estimation.baselines import BASELINES
from sb3_reinforce.sampling.collection import Extent

CUTS = "ignore:Episodes that n_steps cuts"


class Keep(BaseCallback):
    """Keeps a copy of what a function of the model says at the end of each rollout."""

    def __init__(self, function):
        super().__init__()
        self.function, self.kept = function, []

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.kept.append(self.function(self.model))


def make_model(env, n_envs=1, **kwargs):
    return REINFORCE("MlpPolicy", make_vec_env(env, n_envs, seed=0), seed=0, device="cpu", **kwargs)


@pytest.mark.parametrize(("n_episodes", "n_envs"), [(1, 1), (7, 3), (3, 7), (8, 4)])
def test_the_quotas_sum_to_n_episodes_and_differ_by_at_most_one(n_episodes, n_envs):
    quota = Extent.whole_episodes(n_episodes, n_envs, 10).quota
    assert quota.sum() == n_episodes and np.ptp(quota) <= 1


def test_lengths_of_used_episodes_are_drawn_without_bias():
    """Lengths of 1 and 100: "the first to finish" would use far more short ones than half."""
    env = make_vec_env(lambda: Corridor((1, 100)), 4, seed=0)
    model = REINFORCE("MlpPolicy", env, n_episodes=6, baseline="none", seed=0, device="cpu", learning_rate=0.0)
    keep = Keep(lambda model: model.rollout.used.sum().item())
    model.learn(80_000, callback=keep)
    n_episodes = 6 * len(keep.kept)
    mean, std = 50.5, 49.5
    assert n_episodes > 500
    assert abs(sum(keep.kept) / n_episodes - mean) < 3 * std / np.sqrt(n_episodes)


def test_logged_episodes_are_those_that_are_used():
    """What an environment does beyond its quota would fill the statistics with short episodes."""
    env = make_vec_env(lambda: Corridor((1, 100)), 4, seed=0)
    model = REINFORCE("MlpPolicy", env, n_episodes=4, baseline="none", seed=0, device="cpu")
    model.learn(1)
    assert len(model.ep_info_buffer) == 4


@pytest.mark.parametrize("n_envs", [1, 3])
def test_whole_episodes_count_every_step_and_start_anew(n_envs):
    model = make_model(lambda: Corridor((2, 9)), n_envs, n_episodes=5, baseline="none")
    keep = Keep(lambda model: (model.rollout_buffer.size(), model.rollout.timesteps[0].tolist()))
    model.learn(300, callback=keep)
    assert model.num_timesteps == n_envs * sum(size for size, _ in keep.kept)
    assert all(first == [0] * n_envs for _, first in keep.kept)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_fixed_rollouts_count_exactly(n_envs):
    model = make_model("CartPole-v1", n_envs, n_steps=16).learn(16 * n_envs * 3)
    assert model.num_timesteps == 16 * n_envs * 3 and model._n_updates == 3


@pytest.mark.filterwarnings(CUTS)
def test_fractions_are_logged():
    model = make_model(lambda: Corridor((4,)), 1, n_steps=10, baseline="none").learn(10)
    assert model.logger.name_to_value["rollout/complete_fraction"] == 0.8
    model = make_model(lambda: Corridor((4,)), 3, n_episodes=4, baseline="none").learn(10)
    assert model.logger.name_to_value["rollout/used_fraction"] == pytest.approx(16 / 24)


def test_a_cut_episode_without_a_critic_is_left_out_with_a_warning():
    model = make_model(lambda: Corridor((4,)), 1, n_steps=10, baseline="none")
    with pytest.warns(UserWarning, match="n_episodes"):
        model.learn(10)
    assert model.rollout.used.flatten().tolist() == [True] * 8 + [False] * 2
    assert model.rollout_buffer.advantages[8:].tolist() == [[0], [0]]


def test_no_finished_episode_without_a_critic_is_an_error_that_says_so():
    model = make_model(lambda: Corridor((100,)), 2, n_steps=10, baseline="mean")
    before = [parameter.clone() for parameter in model.policy.parameters()]
    with pytest.raises(ValueError, match="No episode ended within n_steps=10"):
        model.learn(10)
    assert all(map(th.equal, before, model.policy.parameters()))


def set_value_network(model, value):
    parameters = model.get_parameters()
    for name, parameter in parameters["policy"].items():
        if "value" in name:
            parameter.fill_(value)
    model.set_parameters(parameters)


@pytest.mark.filterwarnings(CUTS)
@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("mode", [{"n_steps": 20}, {"n_episodes": 4}])
@pytest.mark.parametrize("baseline", [name for name in BASELINES if name != "value"])
def test_without_a_critic_the_value_network_changes_nothing(baseline, mode, truncate):
    """An untrained network must not get into a return, neither at a cut nor at a time limit."""
    outcomes = []
    for value in (0.0, 1e6):
        model = make_model(lambda: Corridor((3, 8), truncate=truncate), 2, baseline=baseline, **mode)
        set_value_network(model, value)
        keep = Keep(lambda model: (model.rollout_buffer.returns.copy(), model.rollout_buffer.advantages.copy()))
        model.learn(100, callback=keep)
        actor = [parameter.clone() for parameter in model.policy.mlp_extractor.policy_net.parameters()]
        outcomes.append((keep.kept, actor))
    (kept, actor), (kept_too, actor_too) = outcomes
    np.testing.assert_array_equal(kept[0], kept_too[0])
    assert all(map(th.equal, actor, actor_too))


@pytest.mark.parametrize("method", ["predict_values", "forward_critic"])
@pytest.mark.parametrize("baseline", [name for name in BASELINES if name != "value"])
def test_without_a_critic_the_value_network_is_never_evaluated(baseline, method, monkeypatch):
    model = make_model("CartPole-v1", 2, baseline=baseline, n_episodes=4)
    owner = model.policy if method == "predict_values" else model.policy.mlp_extractor
    monkeypatch.setattr(owner, method, None)
    model.learn(200)
    assert model._n_updates > 0


def constant_critic(model, value):
    with th.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.fill_(value)


@pytest.mark.parametrize("mode", [{"n_steps": 6}, {"n_episodes": 2}])
@pytest.mark.parametrize("truncate", [False, True])
def test_the_critic_stands_in_at_a_time_limit_and_never_after_a_terminal_step(truncate, mode):
    """Rewards 0 and V = 10: the return is 0 where the episode terminates, γ^k · 10 where it is cut in k steps."""
    model = make_model(lambda: Corridor((3,), reward=lambda t, action: 0.0, truncate=truncate), gamma=0.5, **mode)
    constant_critic(model, 10.0)
    model.learn(6)
    expected = [10 * 0.5**k for k in (3, 2, 1, 3, 2, 1)] if truncate else [0.0] * 6
    np.testing.assert_allclose(model.rollout_buffer.returns.ravel(), expected)


def test_the_critic_stands_in_where_n_steps_cuts():
    model = make_model(lambda: Corridor((100,), reward=lambda t, action: 0.0), 2, gamma=0.5, n_steps=3)
    constant_critic(model, 8.0)
    model.learn(6)
    np.testing.assert_allclose(model.rollout_buffer.returns, [[1, 1], [2, 2], [4, 4]])


def test_a_step_that_terminates_at_the_time_limit_is_terminal():
    """Terminated and truncated at once: the state is terminal, so nothing is to be added."""

    class Both(Corridor):
        def step(self, action):
            obs, reward, terminated, _, info = super().step(action)
            return obs, reward, terminated, terminated, info

    model = make_model(lambda: Both((3,), reward=lambda t, action: 0.0), n_steps=3)
    constant_critic(model, 10.0)
    model.learn(3)
    assert model.rollout_buffer.returns.ravel().tolist() == [0, 0, 0]


def test_the_buffer_is_that_of_a2c():
    """Also its values and log-probabilities, which are computed after the rollout, and not at each step."""
    model = make_model("CartPole-v1", 3, n_steps=12)
    seen = []

    def check(model):
        buffer = model.rollout_buffer
        seen.append(buffer.full and buffer.size() == 12)
        obs = th.as_tensor(buffer.observations).flatten(0, 1)
        actions = th.as_tensor(buffer.actions).flatten().long()
        with th.no_grad():
            values, log_prob, _ = model.policy.evaluate_actions(obs, actions)
        np.testing.assert_allclose(buffer.values.ravel(), values.ravel(), rtol=1e-5)
        np.testing.assert_allclose(buffer.log_probs.ravel(), log_prob, rtol=1e-5)
        np.testing.assert_allclose(buffer.advantages, buffer.returns - buffer.values, atol=1e-4)
        assert buffer.rewards.shape == buffer.episode_starts.shape == (12, 3)
        assert next(buffer.get(batch_size=5)).observations.shape == (5, 4)

    model.learn(36, callback=Keep(check))
    assert seen == [True]


@pytest.mark.parametrize("baseline", ["none", "value"])
@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ELU])
@pytest.mark.parametrize("own_callback", [None, lambda *_: True])
def test_one_actor_pass_a_step_and_values_once_per_rollout(baseline, activation_fn, own_callback, monkeypatch):
    """
    The laid-out actor asks the policy nothing; the general one takes one pass more, for all log-probabilities, where a
    callback can read them.
    """
    policy_kwargs = {"activation_fn": activation_fn}
    model = make_model("CartPole-v1", 2, n_episodes=4, baseline=baseline, policy_kwargs=policy_kwargs)
    calls = {"get_distribution": 0, "predict_values": 0}
    for name in calls:
        original = getattr(ActorCriticPolicy, name)

        def counted(*args, name=name, original=original):
            calls[name] += 1
            return original(*args)

        monkeypatch.setattr(ActorCriticPolicy, name, counted)
    _, callback = model._setup_learn(1, own_callback)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, None)
    passes = model.rollout_buffer.size() + (own_callback is not None)
    assert calls["get_distribution"] == (0 if activation_fn is th.nn.Tanh else passes)
    assert model.rollout_buffer.log_probs.any() == (own_callback is not None)
    assert calls["predict_values"] <= (3 if baseline == "value" else 0)


class OwnForward(ActorCriticPolicy):
    """Says in its own way what to do, and what it is worth."""

    def forward(self, obs, deterministic=False):
        actions, values, log_prob = super().forward(obs, deterministic)
        return th.ones_like(actions), th.full_like(values, 3.0), log_prob


def test_a_policy_that_overrides_forward_is_honoured():
    model = REINFORCE(OwnForward, "CartPole-v1", n_steps=8, device="cpu").learn(8)
    assert (model.rollout_buffer.actions == 1).all() and (model.rollout_buffer.values == 3).all()


@pytest.mark.parametrize("space", [spaces.Discrete(3, start=5), spaces.MultiDiscrete([2, 3], start=[7, -1])])
def test_actions_count_from_the_start_of_the_space(space):
    """In training and in ``predict``; inside, the policy counts from 0."""

    class Strict(Corridor):
        def step(self, action):
            assert self.action_space.contains(
                np.asarray(action, dtype=space.dtype).reshape(space.shape) if space.shape else action
            )
            return super().step(action)

    model = make_model(lambda: Strict((4,), action_space=space), 2, n_steps=8).learn(32)
    assert model.rollout_buffer.actions.min() == 0
    actions, _ = model.predict(np.zeros((50, 4), dtype=np.float32))
    assert all(space.contains(action) for action in actions)


def test_a_box_action_is_stored_as_drawn_and_clipped_for_the_environment():
    sent = []

    class Recorder(gym.ActionWrapper):
        def action(self, action):
            sent.append(action)
            return action

    model = make_model(lambda: Recorder(gym.make("Pendulum-v1")), n_steps=64, policy_kwargs={"log_std_init": 2.0})
    model.learn(64)
    stored = model.rollout_buffer.actions.ravel()
    assert np.abs(stored).max() > 2
    np.testing.assert_allclose(np.ravel(sent), np.clip(stored, -2, 2))
