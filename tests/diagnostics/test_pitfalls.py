"""Tasks made to fall into each pitfall, and healthy runs that give no warning."""

import math
import warnings
from functools import partial

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import PitfallCallback
from sb3_reinforce.diagnostics.pitfalls import PITFALLS, History, Update
from sb3_reinforce.diagnostics.randomness import randomness

BOX = spaces.Box(-1, 1, (2,))


def noise(t, action):
    return float(np.random.normal())


class Jackpot(Corridor):
    """Pays a thousandfold, once, after 40 episodes."""

    def __init__(self):
        super().__init__((3,), self.pay)
        self.paid = 0

    def pay(self, t, action):
        self.paid += 1
        return 1000.0 if self.paid == 120 else 1.0


def fall(env, timesteps, change=None, n_envs=1, **kwargs):
    """The pitfalls found in a run."""
    model = REINFORCE("MlpPolicy", make_vec_env(env, n_envs, seed=0), seed=0, device="cpu", **kwargs)
    if change is not None:
        with th.no_grad():
            change(model.policy)
    callback = PitfallCallback()
    assert callback.found == {}, "also where it is never used, as in the other processes under torchrun"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(timesteps, callback)
    messages = [str(warning.message) for warning in caught]
    assert all(messages.count(sentence) == 1 for sentence in callback.found.values()), "each is reported once"
    return callback.found


rewarded = partial(partial, Corridor)
whole = {"baseline": "none", "n_episodes": 1}
flat_critic = {"critic_learning_rate": 0.0, "change": lambda policy: policy.value_net.weight.mul_(20)}
one_action = {"change": lambda policy: policy.action_net.bias.copy_(th.tensor([9.0, 0.0]))}
# As in a linear policy with large observations
certain = {"change": lambda policy: policy.action_net.bias.copy_(th.tensor([1e9, 0.0]))}
narrow = {"change": lambda policy: policy.log_std.fill_(-5.0)}


TASKS = [
    ("rate_too_large", "Lower learning_rate (now 1)", "CartPole-v1", 500, {"learning_rate": 1.0}),
    ("unscaled_returns", "VecNormalize", rewarded((5,), lambda t, action: 5e3), 64, {}),
    ("too_few_episodes", "n_episodes", rewarded((4,), noise), 400, whole),
    ("too_few_episodes", "or the number of environments", "CartPole-v1", 2000, {"n_envs": 4, "n_steps": 5}),
    ("total_return", "reward_to_go=True", rewarded((4,)), 64, {**whole, "n_episodes": 4, "reward_to_go": False}),
    ("spikes_without_clipping", "max_grad_norm", Jackpot, 300, {**whole, "max_grad_norm": None}),
    ("rate_too_small", "lower n_steps (now 32)", "CartPole-v1", 800, {"learning_rate": 1e-5}),
    ("rate_too_small", "target_kl (now 1e-06)", "CartPole-v1", 800, {"step": "natural", "target_kl": 1e-6}),
    ("useless_critic", "n_critic_updates", rewarded((4,), noise), 4000, flat_critic),
    ("deterministic_too_early", "ent_coef", rewarded((4,)), 640, one_action),
    ("deterministic_too_early", "ent_coef", rewarded((4,)), 640, certain),
    ("deterministic_too_early", "min_std", rewarded((4,), action_space=BOX), 640, narrow),
    ("cut_episodes", "n_episodes", rewarded((3, 7)), 100, {"n_steps": 10, "baseline": "mean"}),
]


@pytest.mark.parametrize(("name", "argument", "env", "timesteps", "kwargs"), TASKS)
def test_a_task_made_for_it_falls_into_the_pitfall(name, argument, env, timesteps, kwargs):
    assert argument in fall(env, timesteps, **kwargs)[name]


def test_every_pitfall_has_a_task():
    assert {case[0] for case in TASKS} == set(PITFALLS)


HEALTHY = dict(kl=0.01, randomness=0.9, grad_norm=1.0, explained_variance=0.5, return_scale=10.0)
HEALTHY |= dict(target_scale=10.0, target_std=5.0, n_episodes=16, n_steps=256, used_fraction=1.0, temperature=1.0)


def seen(*updates, n=1, progress=1.0, signal=0.0, n_updates=100, path=10.0, n_moves=100, **kwargs):
    """What ``history`` makes a history of: n times these updates, of a model with these arguments."""
    return updates * n, progress, signal, n_updates, path, n_moves, kwargs


def history(updates, progress, signal, n_updates, path, n_moves, kwargs):
    """Updates that are healthy but for the figures given, whose gradients have a signal-to-noise ratio."""
    model = REINFORCE("MlpPolicy", "CartPole-v1", device="cpu", **kwargs)
    gradients = th.randn(len(updates), 30, generator=th.Generator().manual_seed(0)) + signal**0.5
    made = [Update(gradient=g, **{**HEALTHY, **figures}) for g, figures in zip(gradients, updates, strict=True)]
    return History(model, made, n_updates, progress, path, n_moves, share=1 - progress)


few = {"n_episodes": 4}
episodes = {"n_episodes": 16, "baseline": "mean"}
large = {"return_scale": 1001.0}
spread = {"randomness": 1.0}
peaked = {"randomness": 0.3}
fixed = {"randomness": 0.01}
spike = {"grad_norm": 10.1}
unexplained = {"explained_variance": 0.049, "target_std": 1.1}
late = {"progress": 0.49}
constant_targets = {"explained_variance": -0.1, "target_std": 0.9}
cut = {"n_steps": 32, "baseline": "mean"}
free = {"max_grad_norm": None}


@pytest.mark.parametrize(
    ("name", "falls", "stays"),
    [
        ("rate_too_large", seen({"kl": 0.11}, n=10), seen({"kl": 0.11}, n=9)),
        ("rate_too_large", seen({"kl": 0.11}, n=10), seen({"kl": 0.09}, n=10)),
        ("rate_too_large", seen({}, {"kl": 1.1}), seen({"kl": 1.1}, {})),
        ("rate_too_large", seen({}, {"kl": 1.1}), seen({}, {"kl": 0.9})),
        ("rate_too_large", seen(spread, {"randomness": 0.49}), seen(spread, {"randomness": 0.51})),
        ("rate_too_large", seen(spread, *[peaked] * 9), seen(spread, *[peaked] * 10)),
        ("rate_too_small", seen({}, path=0.15, **late), seen({}, path=0.16, **late)),
        ("rate_too_small", seen({}, path=0.15, **late), seen({}, path=math.nan, **late)),
        ("rate_too_small", seen({}, path=0.1, **late), seen({}, path=0.1, progress=0.5)),
        ("rate_too_small", seen({}, path=0.09, n_moves=10, **late), seen({}, path=0.11, n_moves=10, **late)),
        ("rate_too_small", seen({}, path=0.03, n_moves=10, **late), seen({}, path=0.03, n_moves=9, **late)),
        ("unscaled_returns", seen(large), seen({"return_scale": 999.0})),
        ("unscaled_returns", seen(large), seen(large, normalize_advantage=True)),
        ("unscaled_returns", seen(large, step="natural"), seen(large, step="natural", baseline="mean")),
        ("too_few_episodes", seen(few, n=50, **episodes), seen(few, n=50, signal=0.3, **episodes)),
        ("too_few_episodes", seen({"n_episodes": 7}, n=50, **episodes), seen({"n_episodes": 8}, n=50, **episodes)),
        ("too_few_episodes", seen({"n_steps": 63}, n=50), seen({"n_steps": 64, "n_episodes": 4}, n=50)),
        ("too_few_episodes", seen(few, n=50, **episodes), seen(few, n=49, **episodes)),
        ("spikes_without_clipping", seen(*[{}] * 19, spike, **free), seen(*[{}] * 19, {"grad_norm": 9.9}, **free)),
        ("spikes_without_clipping", seen(*[{}] * 19, spike, **free), seen(*[{}] * 18, spike, **free)),
        ("spikes_without_clipping", seen(*[{}] * 19, spike, **free), seen(*[{}] * 19, spike)),
        ("useless_critic", seen(unexplained, n=25, **late), seen(unexplained, n=25, progress=0.5)),
        ("useless_critic", seen(unexplained, n=25, **late), seen(unexplained, n=24, **late)),
        ("useless_critic", seen(unexplained, n=25, **late), seen(unexplained, n=25, n_updates=99, **late)),
        ("useless_critic", seen(unexplained, n=25, **late), seen({"explained_variance": 0.05}, n=25, **late)),
        ("useless_critic", seen(unexplained, n=25, **late), seen(constant_targets, n=25, **late)),
        ("deterministic_too_early", seen(fixed, progress=0.51), seen(fixed, progress=0.5)),
        ("deterministic_too_early", seen({"randomness": 0.049}), seen({"randomness": 0.051})),
        ("cut_episodes", seen({"used_fraction": 0.89}, **cut), seen({"used_fraction": 0.91}, **cut)),
        ("cut_episodes", seen({"used_fraction": 0.5}, **cut), seen({"used_fraction": 0.5}, n_steps=32)),
    ],
)
def test_a_pitfall_starts_at_its_threshold(name, falls, stays):
    assert PITFALLS[name](history(*falls)) is not None
    assert PITFALLS[name](history(*stays)) is None


@pytest.mark.parametrize(
    ("name", "case"),
    [
        ("rate_too_large", seen({"kl": 1.5})),
        ("rate_too_small", seen({}, path=0.1, **late)),
        ("deterministic_too_early", seen(fixed)),
    ],
)
def test_the_natural_step_has_its_target_for_a_rate(name, case):
    sentence = PITFALLS[name](history(*case[:-1], {"step": "natural", "target_kl": lambda progress: 2 * progress}))
    assert "target_kl" in sentence and "learning_rate" not in sentence and "n_steps" not in sentence


def test_a_collapse_counts_the_updates_whose_divergence_is_unknown():
    unknown = {"kl": np.nan}
    sentence = PITFALLS["rate_too_large"](history(*seen({**spread, **unknown}, *[{**peaked, **unknown}] * 4)))
    assert "within 5 updates" in sentence


def test_a_spike_does_not_lengthen_the_natural_step():
    case = seen(*[{}] * 20, spike, max_grad_norm=None, step="natural")
    assert PITFALLS["spikes_without_clipping"](history(*case)) is None


def test_of_several_pitfalls_with_one_cause_the_cause_is_reported():
    assert set(fall("CartPole-v1", 4000, learning_rate=1.0)) == {"rate_too_large"}
    assert set(fall(rewarded((4,)), 640, **one_action)) == {"deterministic_too_early"}


def test_a_negative_signal_to_noise_ratio_is_not_a_number_for_a_reader():
    found = history(*seen(few, n=50, **episodes))
    for index, update in enumerate(found.updates):
        update.gradient.fill_((-1) ** index)
    sentence = PITFALLS["too_few_episodes"](found)
    assert "its signal-to-noise ratio is not distinguishable from 0, with" in sentence


def test_the_gradient_is_judged_with_the_weights_of_training():
    """Of returns that hardly differ from 400, normalization leaves the difference."""
    still = {**whole, "n_episodes": 4, "learning_rate": 1e-9, "gamma": 1.0}
    env = rewarded((1,), lambda t, action: 400.0 + action + 0.1 * noise(t, action))
    assert "too_few_episodes" in fall(env, 400, **still)
    assert "too_few_episodes" not in fall(env, 400, normalize_advantage=True, **still)


def test_a_falling_temperature_is_not_blamed_on_the_learning_rate():
    change = {"change": lambda policy: policy.action_net.bias.copy_(th.tensor([0.5, 0.0]))}
    found = fall(rewarded((4,)), 640, learning_rate=0.0, temperature=lambda progress: progress**8, **change)
    assert set(found) == {"deterministic_too_early"}
    assert "temperature (now 0.0" in found["deterministic_too_early"]


def test_small_noise_weights_are_not_a_deterministic_policy():
    """With gSDE the standard deviation of an action is the one of the weights times the norm of the features."""
    gsde = {"use_sde": True, "normalize_advantage": True}
    wide = fall("Pendulum-v1", 1000, policy_kwargs={"log_std_init": -2.5, "net_arch": [256]}, **gsde)
    assert "deterministic_too_early" not in wide
    assert "deterministic_too_early" in fall("Pendulum-v1", 1000, policy_kwargs={"log_std_init": -9.0}, **gsde)


@th.no_grad()
@pytest.mark.parametrize("space", [spaces.Box(-0.1, 0.1, (1,)), spaces.Box(-100, 100, (1,), np.int8)], ids=str)
def test_noise_wider_than_the_actions_is_all_the_randomness_there_is(space):
    policy = REINFORCE("MlpPolicy", Corridor(action_space=space), device="cpu").policy
    found = []
    for std in (10.0 * space.high[0], space.high[0] / 2):
        policy.log_std.fill_(np.log(std))
        found.append(randomness(policy, th.zeros(1, *policy.observation_space.shape), entropy=0.0))
    assert found == pytest.approx([1.0, 0.5])


@th.no_grad()
def test_the_randomness_of_a_single_action_is_not_known():
    policy = REINFORCE("MlpPolicy", Corridor(action_space=spaces.Box(0.5, 0.5, (1,))), device="cpu").policy
    assert math.isnan(randomness(policy, th.zeros(1, *policy.observation_space.shape), entropy=0.0))


@th.no_grad()
def test_a_squashed_policy_is_as_random_on_a_wide_box_as_on_a_narrow_one():
    """It acts on [-1, 1], and only the environment gets actions of the width of the space."""
    squashed = {"use_sde": True, "policy_kwargs": {"squash_output": True, "log_std_init": -2.0}}
    found = []
    for width in (0.01, 1.0, 100.0):
        space = spaces.Box(-width, width, (1,))
        policy = REINFORCE("MlpPolicy", Corridor(action_space=space), seed=0, device="cpu", **squashed).policy
        found.append(randomness(policy, th.ones(1, *policy.observation_space.shape), entropy=0.0))
    assert found == [found[0]] * 3 and 0 < found[0] < 1


@th.no_grad()
@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 5]), spaces.MultiBinary(3)], ids=str)
def test_a_uniform_policy_is_all_random(space):
    policy = REINFORCE("MlpPolicy", Corridor(action_space=space), device="cpu").policy
    policy.action_net.weight.zero_()
    obs = th.zeros(1, *policy.observation_space.shape)
    entropy = float(policy.get_distribution(obs).entropy())
    assert randomness(policy, obs, entropy) == pytest.approx(1.0)
    assert randomness(policy, obs, entropy / 4) == pytest.approx(0.25)


class Own(spaces.Discrete):
    """A custom space."""


def test_a_callback_serves_one_model_after_another():
    callback = PitfallCallback()
    for _ in range(2):
        env = make_vec_env(lambda: Corridor((4,), noise, action_space=Own(2)), 1, seed=0)
        model = REINFORCE("MlpPolicy", env, device="cpu", seed=0, **whole)
        with pytest.warns(UserWarning, match="n_episodes"):
            model.learn(400, callback)
        assert callback.n_updates == 100 and "too_few_episodes" in callback.found


def test_a_schedule_is_reported_by_its_present_value():
    found = fall("CartPole-v1", 500, learning_rate=lambda progress: progress, ent_coef=lambda progress: 0.0)
    assert "Lower learning_rate (now 0." in found["rate_too_large"]
    assert "<function" not in "".join(found.values())


def healthy(env, timesteps, n_envs=8, normalize=False, **kwargs):
    """The pitfalls found in a run, and how many of its updates were not examined."""
    env = make_vec_env(env, n_envs, seed=0)
    if normalize:
        env = VecNormalize(env, gamma=kwargs["gamma"])
    callback = PitfallCallback()
    model = REINFORCE("MlpPolicy", env, seed=0, device="cpu", **kwargs).learn(timesteps, callback)
    return callback.found, callback.n_updates - model.num_timesteps // (32 * n_envs)


@pytest.mark.parametrize(
    ("cartpole", "pendulum"), [(13_000, 8_000), pytest.param(60_000, 100_000, marks=pytest.mark.slow)]
)
def test_nothing_is_said_of_a_healthy_run(cartpole, pendulum):
    assert healthy("CartPole-v1", cartpole) == healthy("CartPole-v1", cartpole, n_envs=4) == ({}, 0)
    assert healthy("Pendulum-v1", pendulum, normalize=True, gamma=0.9) == ({}, 0)


def test_a_training_counts_from_its_first_change_of_the_policy(monkeypatch):
    """Neither updates in which only the critic learns count, nor those of earlier calls of learn."""
    found = []
    record = {"record": lambda history: found.append((history.n_moves, round(history.share, 9)))}
    monkeypatch.setattr("sb3_reinforce.diagnostics.callbacks.PITFALLS", record)
    env = make_vec_env("CartPole-v1", 2, seed=0)
    model = REINFORCE("MlpPolicy", env, n_steps=16, learning_rate=0.0, critic_learning_rate=2e-3, device="cpu")
    callback = PitfallCallback()
    model.learn(4 * 32, callback)
    assert [n_moves for n_moves, _ in found] == [0] * 4
    model.learning_rate = 2e-3
    for each in (callback, callback, PitfallCallback()):
        found.clear()
        model.learn(4 * 32, each, reset_num_timesteps=False)
        assert found == [(1, 0.25), (2, 0.5), (3, 0.75), (4, 1.0)]


@pytest.mark.slow
def test_a_critic_that_large_returns_overwhelm_is_reported():
    """The defaults on Pendulum, whose returns nothing scales."""
    with pytest.warns(UserWarning, match="almost none of the variance of the returns.*VecNormalize"):
        assert healthy("Pendulum-v1", 40_000)[0].keys() == {"useless_critic"}


def test_one_environment_leaves_mostly_noise():
    with pytest.warns(UserWarning, match="The gradient is mostly noise"):
        assert healthy("CartPole-v1", 3_300, n_envs=1)[0].keys() == {"too_few_episodes"}


@pytest.mark.filterwarnings("ignore:Every action is weighted by the total return")
@pytest.mark.parametrize("reward_to_go", [True, False])
def test_the_critic_is_judged_by_what_it_is_fitted_to(reward_to_go):
    env = Corridor((5,), lambda t, action: 1.0)
    model = REINFORCE("MlpPolicy", env, n_episodes=1, gamma=1.0, gae_lambda=1.0, reward_to_go=reward_to_go)
    callback = PitfallCallback()
    model.learn(5, callback)
    (update,) = callback.updates
    assert update.target_std == pytest.approx(np.std([5, 4, 3, 2, 1]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
def test_nothing_is_said_of_a_long_healthy_run_of_lunar_lander():
    with warnings.catch_warnings():
        # Box2D is not there, or warns where it is imported, and an error there would not be caught
        warnings.simplefilter("ignore")
        pytest.importorskip("Box2D")
    # With the default four passes and γ = 0.99 the critic of some seeds explains hardly anything for most of the run
    assert healthy("LunarLander-v3", 150_000, gamma=0.999, n_critic_updates=10, batch_size=64) == ({}, 0)


@pytest.mark.parametrize("rollout", [{"n_steps": 300}, {"n_episodes": 3, "baseline": "none"}])
def test_the_gradient_is_the_updates(rollout):
    """Its signal-to-noise ratio would be smaller for a part of a long rollout."""
    env = make_vec_env(lambda: Corridor((200,), lambda t, action: float(action)), 2, seed=0)
    kwargs = {"policy_kwargs": {"net_arch": [4]}, "seed": 0, "device": "cpu", **rollout}
    model = REINFORCE("MlpPolicy", env, learning_rate=0.0, max_grad_norm=None, **kwargs)
    callback = PitfallCallback()
    model.learn(1, callback)
    assert float(callback.gradient.norm()) == pytest.approx(model.logger.name_to_value["train/grad_norm"], rel=1e-4)


def test_the_randomness_of_an_unknown_distribution_is_not_known(monkeypatch):
    policy = REINFORCE("MlpPolicy", "Pendulum-v1", device="cpu").policy
    obs = th.zeros(4, 3)
    distribution = policy.get_distribution(obs)
    distribution.distribution = th.distributions.Laplace(th.zeros(4, 1), th.ones(4, 1))
    monkeypatch.setattr(policy, "get_distribution", lambda obs: distribution)
    assert math.isnan(randomness(policy, obs, 1.0))


def test_an_update_that_failed_does_not_count(monkeypatch):
    """With a logger that the next call of ``learn`` keeps."""
    model, callback = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=32, device="cpu"), PitfallCallback()
    model.set_logger(Logger(None, []))
    monkeypatch.setattr(model, "train", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        model.learn(32, callback)
    monkeypatch.undo()
    model.learn(64, callback)
    assert math.isfinite(callback.path)
