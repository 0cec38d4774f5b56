"""What is collected: quotas, cuts, time limits, the buffer."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor, Faulty, Reused, Wrapper
from gymnasium.wrappers import TimeLimit
from models import all_kinds, make
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_reinforce import REINFORCE
from sb3_reinforce.common.spaces import as_policy_actions

CUTS = "ignore:Episodes that n_steps cuts"


def make_model(env, n_envs=1, **kwargs):
    return REINFORCE("MlpPolicy", make_vec_env(env, n_envs, seed=0), seed=0, device="cpu", **kwargs)


@pytest.mark.parametrize(("n_episodes", "n_envs"), [(1, 1), (7, 3), (3, 7), (8, 4)])
def test_episodes_are_shared_out_evenly_and_begin_with_the_rollout(n_episodes, n_envs):
    model = make_model(lambda: Corridor((2, 9)), n_envs, n_episodes=n_episodes, baseline="none")
    rollouts = Record(lambda model: model.rollout)
    model.learn(100, callback=rollouts)
    for rollout in rollouts.records:
        quota = (rollout.used & rollout.dones).sum(0)
        assert quota.sum() == n_episodes and quota.max() - quota.min() <= 1
        assert rollout.timesteps[0].tolist() == [0] * n_envs


def test_environments_that_have_all_ended_an_episode_are_not_reset_again():
    env = Faulty()
    make("episodes", env).learn(28)
    # By learn, and after each of four episodes
    assert env.n_resets == 5


def test_vec_normalize_learns_the_same_scale_where_dones_are_numbers():
    scales = []
    for wrap in (lambda env: env, Reused):
        env = VecNormalize(wrap(make_vec_env(lambda: Corridor((2, 3)), 3, seed=0)), norm_obs=False)
        make("steps", env).learn(48)
        scales.append(float(env.ret_rms.var))
    assert scales[0] == scales[1]


class Succeeds(Corridor):
    """Says at the end of an episode that it succeeded."""

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, {"is_success": True} if terminated else info


@all_kinds
def test_successes_are_those_of_the_episodes_that_count(kind):
    """The first environment ends its episodes too early to say anything, at other steps than the second one."""
    envs = [lambda: Monitor(TimeLimit(Succeeds((9,)), 2)), lambda: Monitor(Succeeds((9,)))]
    model = make(kind, DummyVecEnv(envs)).learn(80)
    lengths = [episode["l"] for episode in model.ep_info_buffer]
    assert list(model.ep_success_buffer) == [True] * lengths.count(9) != []


def test_a_monitor_that_refuses_early_resets_is_enough_for_fixed_rollouts():
    envs = [partial(Monitor, gym.make("CartPole-v1"), allow_early_resets=False) for _ in range(2)]
    assert REINFORCE("MlpPolicy", DummyVecEnv(envs), n_steps=16, device="cpu").learn(32).num_timesteps == 32


def test_lengths_of_used_episodes_are_drawn_without_bias():
    """Lengths of 1 and 100: "the first to finish" would use far more short ones than half."""
    model = make_model(lambda: Corridor((1, 100)), 4, n_episodes=6, baseline="none", learning_rate=0.0)
    n_used = Record(lambda model: model.rollout.used.sum().item())
    model.learn(40_000, callback=n_used)
    n_episodes = 6 * len(n_used.records)
    mean, std = 50.5, 49.5
    assert n_episodes > 300
    assert abs(sum(n_used.records) / n_episodes - mean) < 3 * std / np.sqrt(n_episodes)


def test_a_cut_episode_without_a_critic_is_left_out_with_a_warning():
    model = make_model(lambda: Corridor((4,)), 1, n_steps=10, baseline="none")
    with pytest.warns(UserWarning, match="n_episodes"):
        model.learn(10)
    assert model.rollout.used.flatten().tolist() == [True] * 8 + [False] * 2
    assert model.rollout_buffer.advantages[8:].tolist() == [[0], [0]]
    assert model.rollout_buffer.returns[8:].tolist() == [[0], [0]]
    assert model.logger.name_to_value["rollout/complete_fraction"] == 0.8


def test_a_denominator_of_episodes_is_for_whole_episodes():
    model = make_model(lambda: Corridor((4,)), 1, n_steps=8, normalize_by="episodes")
    with pytest.warns(UserWarning, match="set n_episodes"):
        model.learn(8)
    assert model.rollout.denominator == 8


def test_the_fraction_of_complete_steps_is_logged_with_a_critic_too():
    model = make_model(lambda: Corridor((4,)), 1, n_steps=10).learn(10)
    assert model.rollout.used.all() and model.logger.name_to_value["rollout/complete_fraction"] == 0.8


def test_there_is_no_rollout_while_one_is_collected():
    rollouts = Record(lambda model: model.rollout, "step")
    assert make_model(lambda: Corridor((4,)), 1, n_steps=4).learn(8, rollouts).rollout is not None
    assert rollouts.records == [None] * 8


def test_the_fraction_of_used_steps_is_logged():
    model = make_model(lambda: Corridor((4,)), 3, n_episodes=4, baseline="none").learn(10)
    assert model.logger.name_to_value["rollout/used_fraction"] == pytest.approx(16 / 24)


def test_no_finished_episode_without_a_critic_is_an_error_that_says_so():
    model = make_model(lambda: Corridor((100,)), 2, n_steps=10, baseline="mean")
    before = [parameter.clone() for parameter in model.policy.parameters()]
    with pytest.raises(ValueError, match="No episode ended within n_steps=10"):
        model.learn(10)
    assert all(map(th.equal, before, model.policy.parameters()))


@pytest.mark.filterwarnings(CUTS)
@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("mode", [{"n_steps": 20}, {"n_episodes": 4}])
@pytest.mark.parametrize("baseline", ["none", "leave_one_out", "optimal"])
def test_without_a_critic_the_value_network_changes_nothing(baseline, mode, truncate):
    """An untrained network must not get into a return, neither at a cut nor at a time limit."""
    outcomes = []
    for value in (0.0, 1e6):
        model = make_model(lambda: Corridor((3, 8), truncate=truncate), 2, baseline=baseline, **mode)
        with th.no_grad():
            for name, parameter in model.policy.named_parameters():
                if "value" in name:
                    parameter.fill_(value)
        buffer = model.learn(100).rollout_buffer
        actor = model.policy.mlp_extractor.policy_net.parameters()
        outcomes.append([th.as_tensor(buffer.returns), th.as_tensor(buffer.advantages), *actor])
    assert all(map(th.equal, *outcomes))


class BothAtOnce(Corridor):
    """Terminates at its time limit."""

    def step(self, action):
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward, terminated, terminated, info


@pytest.mark.parametrize(
    ("env", "mode", "expected"),
    [
        (partial(Corridor, truncate=True), {"n_steps": 6}, [1, 2, 4, 1, 2, 4]),
        (partial(Corridor, truncate=True), {"n_episodes": 2}, [1, 2, 4, 1, 2, 4]),
        (Corridor, {"n_steps": 6}, [0] * 6),
        (Corridor, {"n_episodes": 2}, [0] * 6),
        (BothAtOnce, {"n_steps": 3}, [0] * 3),
        (partial(Corridor, (100,)), {"n_steps": 3}, [1, 2, 4]),
    ],
)
def test_the_critic_stands_in_at_a_cut_and_a_time_limit_and_never_after_a_terminal_step(env, mode, expected):
    """Episodes of 3 or 100 steps, rewards 0 and V = 8: the return is 8 γ^k if the episode is cut in k steps."""
    model = make_model(lambda: env(reward=lambda t, action: 0.0), gamma=0.5, **mode)
    with th.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.fill_(8.0)
    model.learn(len(expected))
    np.testing.assert_allclose(model.rollout_buffer.returns.ravel(), expected)


class WithoutTerminalObservation(Wrapper):
    """Says that a time limit ended an episode, but not with which observation."""

    def step_wait(self):
        obs, rewards, dones, infos = super().step_wait()
        for info in infos:
            info.pop("terminal_observation", None)
        return obs, rewards, dones, infos


def test_a_time_limit_without_an_observation_is_an_end_as_in_a2c():
    env = WithoutTerminalObservation(make_vec_env(lambda: Corridor(truncate=True, reward=lambda t, action: 0.0), 1))
    model = make("steps", env, n_steps=3)
    with th.no_grad():
        model.policy.value_net.weight.zero_()
        model.policy.value_net.bias.fill_(8.0)
    model.learn(3)
    assert not model.rollout_buffer.returns.any()


def test_the_buffer_is_that_of_a2c():
    """Also its values and log-probabilities, which are computed after the rollout, and not at each step."""

    def check(model):
        buffer = model.rollout_buffer
        obs = th.as_tensor(buffer.observations).flatten(0, 1)
        actions = th.as_tensor(buffer.actions).flatten().long()
        with th.no_grad():
            values, log_prob, _ = model.policy.evaluate_actions(obs, actions)
        np.testing.assert_allclose(buffer.values.ravel(), values.ravel(), rtol=1e-5)
        np.testing.assert_allclose(buffer.log_probs.ravel(), log_prob, rtol=1e-5)
        np.testing.assert_allclose(buffer.advantages, buffer.returns - buffer.values, atol=1e-4)
        assert buffer.full and buffer.size() == 12 and buffer.rewards.shape == buffer.episode_starts.shape == (12, 3)
        assert next(buffer.get(batch_size=5)).observations.shape == (5, 4)

    make_model("CartPole-v1", 3, n_steps=12).learn(36, callback=Record(check))


@pytest.mark.parametrize("task", ["CartPole-v1", "Pendulum-v1"])
@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ELU])
def test_log_probs_are_those_of_the_policy_that_acted(activation_fn, task):
    """Also where a callback changes its parameters in place during the rollout."""

    def change(model):
        buffer, step = model.rollout_buffer, len(log_probs)
        actions = as_policy_actions(th.as_tensor(buffer.actions[step]), model.action_space)
        with th.no_grad():
            log_probs.append(model.policy.get_distribution(th.as_tensor(buffer.observations[step])).log_prob(actions))
            model.policy.action_net.weight.normal_()
            if task == "Pendulum-v1":
                model.policy.log_std.normal_()

    log_probs = []
    model = make_model(task, 2, n_steps=8, policy_kwargs={"activation_fn": activation_fn})
    model.learn(16, Record(change, "step"))
    np.testing.assert_allclose(model.rollout_buffer.log_probs, th.stack(log_probs), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("baseline", "expected"), [("value", [3, 2, 1] * 2), ("none", [3] * 6)])
def test_the_critic_is_fitted_to_returns_to_go_also_with_the_total_return(baseline, expected):
    arguments = {"gamma": 1.0, "n_steps": 6, "baseline": baseline, "reward_to_go": False}
    model = make_model(lambda: Corridor((3,)), **arguments).learn(6)
    assert model.rollout_buffer.returns.ravel().tolist() == expected


def test_the_total_return_of_an_episode_that_spans_rollouts():
    """Rewards are powers of ten, and V is 0; after set_env another episode begins."""
    env = make_vec_env(lambda: Corridor((10,), lambda t, action: 10.0**t), 1)
    model = REINFORCE("MlpPolicy", env, n_steps=3, reward_to_go=False, gamma=1.0, learning_rate=0.0, device="cpu")
    with th.no_grad():
        model.policy.value_net.weight.zero_()
    returns = Record(lambda model: model.rollout.returns[:, 0].tolist())
    model.learn(9, returns)
    model.set_env(env)
    model.learn(3, returns, reset_num_timesteps=False)
    assert returns.records == [[each] * 3 for each in (111.0, 111_111.0, 111_111_111.0, 111.0)]


@pytest.mark.parametrize("baseline", ["none", "value"])
@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ELU])
@pytest.mark.parametrize("callback", [None, lambda *_: True])
def test_one_actor_pass_a_step_and_values_once_per_rollout(baseline, activation_fn, callback, monkeypatch):
    """The NumPy actor needs no pass of the policy; log-probabilities are computed where a callback can read them."""
    kwargs = {"baseline": baseline, "policy_kwargs": {"activation_fn": activation_fn}}
    model = make_model("CartPole-v1", 2, n_episodes=4, **kwargs)
    calls = []
    for name in ("get_distribution", "predict_values"):
        method = partial(getattr(ActorCriticPolicy, name), model.policy)
        counted = lambda *args, name=name, method=method: calls.append(name) or method(*args)  # noqa: E731
        monkeypatch.setattr(ActorCriticPolicy, name, staticmethod(counted))
    monkeypatch.setattr(model, "train", lambda: None)
    model.learn(1, callback)
    assert calls.count("get_distribution") == (0 if activation_fn is th.nn.Tanh else model.rollout_buffer.size())
    assert model.rollout_buffer.log_probs.any() == (callback is not None)
    # For all steps, and for the observations after the last one
    assert calls.count("predict_values") == 2 * (baseline == "value")


class Ones(ActorCriticPolicy):
    def forward(self, obs, deterministic=False):
        actions, values, log_prob = super().forward(obs, deterministic)
        return th.ones_like(actions), th.full_like(values, 3.0), log_prob


def test_a_policy_that_overrides_forward_is_honored():
    model = REINFORCE(Ones, "CartPole-v1", n_steps=8, device="cpu").learn(8)
    assert (model.rollout_buffer.actions == 1).all() and (model.rollout_buffer.values == 3).all()


@pytest.mark.parametrize(
    ("squash_output", "to_env"), [(False, lambda action: np.clip(action, -2, 2)), (True, lambda action: 2 * action)]
)
def test_a_box_action_is_stored_as_drawn_and_clipped_or_unscaled_for_the_environment(squash_output, to_env):
    sent = []

    class Sent(gym.ActionWrapper):
        def action(self, action):
            sent.append(action)
            return action

    policy_kwargs = {"log_std_init": 2.0, "squash_output": squash_output}
    env = lambda: Sent(gym.make("Pendulum-v1"))  # noqa: E731
    model = make_model(env, n_steps=64, use_sde=squash_output, policy_kwargs=policy_kwargs).learn(64)
    stored = model.rollout_buffer.actions.ravel()
    assert squash_output or np.abs(stored).max() > 2
    np.testing.assert_allclose(np.ravel(sent), to_env(stored), atol=1e-6)


class Integers(gym.Env):
    observation_space = gym.spaces.Box(0, 100, (2,), np.uint8)
    action_space = gym.spaces.Box(0, 3, (1,), np.int64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.integers(100, size=2, dtype=np.uint8), {}

    def step(self, action):
        return self.np_random.integers(100, size=2, dtype=np.uint8), 0.0, False, False, {}


class Halves(Integers):
    observation_space = gym.spaces.Box(0, 100, (2,), np.float16)
    action_space = gym.spaces.Box(0, 3, (1,), np.float16)


@pytest.mark.parametrize("dictionary", [False, True])
@pytest.mark.parametrize("env_class", [Integers, Halves])
def test_training_sees_the_fractions_that_the_policy_saw_and_drew(env_class, dictionary):
    """VecNormalize returns float32 for a Box of integers or float16, and the Gaussian policy draws it."""
    space = gym.spaces.Dict({"a": env_class.observation_space})
    in_dicts = partial(gym.wrappers.TransformObservation, func=lambda obs: {"a": obs}, observation_space=space)
    env = make_vec_env(lambda: in_dicts(env_class()) if dictionary else env_class(), 2, seed=0)
    policy = "MultiInputPolicy" if dictionary else "MlpPolicy"
    model = REINFORCE(policy, VecNormalize(env), learning_rate=0.0, n_steps=8, seed=0, device="cpu")
    model.learn(16, lambda *_: True)
    rollout = model.rollout
    observations = rollout.observations["a"] if dictionary else rollout.observations
    assert (observations % 1 > 0).any() and (rollout.actions % 1 > 0).any()
    assert observations.dtype == rollout.actions.dtype == th.float32
    flat = observations.flatten(0, 1)
    _, log_prob, _ = model.policy.evaluate_actions({"a": flat} if dictionary else flat, rollout.actions.flatten(0, 1))
    np.testing.assert_allclose(log_prob.detach(), model.rollout_buffer.log_probs.flatten(), rtol=1e-5, atol=1e-5)


def test_a_later_episode_has_its_full_length_where_another_environment_has_finished():
    env = DummyVecEnv([lambda: Corridor((8,)), lambda: TimeLimit(Corridor((8,)), 2)])
    model = make("episodes", env, n_episodes=3, max_episode_steps=8).learn(1)
    assert model.rollout.dones.shape == (16, 2)


def test_the_mean_return_is_that_of_the_episodes_that_count():
    """Short episodes that are played while a long one is waited for would be most of the window."""
    env = DummyVecEnv([lambda: Monitor(TimeLimit(Corridor((9,)), 2)), lambda: Monitor(Corridor((9,)))])
    model = make("episodes", env).learn(1)
    assert sorted(info["l"] for info in model.ep_info_buffer) == [2, 9]
