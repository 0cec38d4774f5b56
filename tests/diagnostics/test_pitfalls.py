"""Tasks made to fall into each pitfall, and healthy runs on which nothing is said."""

import warnings

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import PitfallCallback
from sb3_reinforce.diagnostics.pitfalls import PITFALLS, randomness
from sb3_reinforce.diagnostics.updates import Seen, Update


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
    """What was found, in a run on which every warning is a sentence of the callback or of the rollout."""
    env = make_vec_env(env, n_envs, seed=0)
    model = REINFORCE("MlpPolicy", env, seed=0, device="cpu", **kwargs)
    if change is not None:
        with th.no_grad():
            change(model.policy)
    callback = PitfallCallback()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(timesteps, callback)
    said = [str(warning.message) for warning in caught]
    assert all(said.count(sentence) == 1 for sentence in callback.found.values()), "each is said once"
    return callback.found


@pytest.mark.parametrize(
    ("name", "argument", "env", "timesteps", "kwargs"),
    [
        ("rate_too_large", "learning rate, now 1", "CartPole-v1", 2000, {"learning_rate": 1.0}),
        ("unscaled_returns", "VecNormalize", lambda: Corridor((5,), lambda t, action: 5e3), 64, {}),
        ("too_few_episodes", "n_episodes", lambda: Corridor((4,), noise), 400, {"n_episodes": 1, "baseline": "none"}),
        (
            "total_return",
            "reward_to_go=True",
            lambda: Corridor((4,)),
            64,
            {"reward_to_go": False, "baseline": "none", "n_episodes": 4},
        ),
        (
            "spikes_without_clipping",
            "max_grad_norm",
            Jackpot,
            300,
            {"max_grad_norm": None, "baseline": "none", "n_episodes": 1},
        ),
        (
            "useless_critic",
            "n_critic_updates",
            lambda: Corridor((4,), noise),
            8000,
            {"critic_learning_rate": 0.0, "change": lambda policy: policy.value_net.weight.mul_(20)},
        ),
        (
            "deterministic_too_early",
            "ent_coef",
            lambda: Corridor((4,)),
            640,
            {"change": lambda policy: policy.action_net.bias.copy_(th.tensor([9.0, 0.0]))},
        ),
        (
            "deterministic_too_early",
            "min_std",
            lambda: Corridor((4,), action_space=spaces.Box(-1, 1, (2,))),
            640,
            {"change": lambda policy: policy.log_std.fill_(-5.0)},
        ),
        ("cut_episodes", "n_episodes", lambda: Corridor((3, 7)), 100, {"n_steps": 10, "baseline": "mean"}),
    ],
)
def test_a_task_made_for_it_falls_into_the_pitfall(name, argument, env, timesteps, kwargs):
    found = fall(env, timesteps, **kwargs)
    assert name in found
    assert argument in found[name]


def seen(updates=(), n_updates=100, progress=1.0, **kwargs):
    """What a model with these arguments has seen: updates that differ from a healthy one in some figures."""
    model = REINFORCE("MlpPolicy", kwargs.pop("env", "CartPole-v1"), device="cpu", **kwargs)
    model._current_progress_remaining = progress
    generator = th.Generator().manual_seed(0)
    healthy = {
        "kl": 0.01,
        "entropy": 0.6,
        "std": 0.5,
        "grad_norm": 1.0,
        "explained_variance": 0.5,
        "return_scale": 10.0,
        "return_std": 5.0,
        "n_episodes": 16,
        "n_steps": 256,
        "used_fraction": 1.0,
    }
    return Seen(
        model,
        [Update(gradient=th.randn(30, generator=generator), **{**healthy, **figures}) for figures in updates],
        n_updates,
    )


def signal(strength):
    """50 updates of 4 episodes whose gradients have a signal-to-noise ratio."""
    found = seen([{"n_episodes": 4}] * 50, n_episodes=4, baseline="none")
    for update in found.updates:
        update.gradient.add_(strength**0.5)
    return found


@pytest.mark.parametrize(
    ("name", "falls", "stays"),
    [
        ("rate_too_large", lambda: seen([{"kl": 0.2}] * 10), lambda: seen([{"kl": 0.2}] * 9)),
        ("rate_too_large", lambda: seen([{"kl": 0.01}, {"kl": 1.5}]), lambda: seen([{"kl": 1.5}, {"kl": 0.01}])),
        (
            "rate_too_large",
            lambda: seen([{"entropy": 0.69}] + [{"entropy": 0.2}] * 9),
            lambda: seen([{"entropy": 0.69}] + [{"entropy": 0.2}] * 10),
        ),
        (
            "unscaled_returns",
            lambda: seen([{"return_scale": 2e3}]),
            lambda: seen([{"return_scale": 2e3}], normalize_advantage=True),
        ),
        ("too_few_episodes", lambda: signal(0.0), lambda: signal(0.3)),
        ("too_few_episodes", lambda: seen([{"n_steps": 20}] * 50), lambda: seen([{}] * 50)),
        ("too_few_episodes", lambda: seen([{"n_episodes": 4}] * 50), lambda: seen([{"n_episodes": 4}] * 49)),
        (
            "spikes_without_clipping",
            lambda: seen([{}] * 20 + [{"grad_norm": 11.0}], max_grad_norm=None),
            lambda: seen([{}] * 20 + [{"grad_norm": 11.0}], max_grad_norm=0.5),
        ),
        (
            "useless_critic",
            lambda: seen([{"explained_variance": -0.1}] * 50, progress=0.4),
            lambda: seen([{"explained_variance": -0.1}] * 50, progress=0.6),
        ),
        (
            "useless_critic",
            lambda: seen([{"explained_variance": 0.0, "return_std": 1.1}] * 50, progress=0.4),
            lambda: seen([{"explained_variance": 0.0, "return_std": 0.9}] * 50, progress=0.4),
        ),
        (
            "deterministic_too_early",
            lambda: seen([{"entropy": 0.01}], progress=0.6),
            lambda: seen([{"entropy": 0.01}], progress=0.5),
        ),
        (
            "cut_episodes",
            lambda: seen([{"used_fraction": 0.89}], n_steps=32, baseline="mean"),
            lambda: seen([{"used_fraction": 0.91}], n_steps=32, baseline="mean"),
        ),
        (
            "cut_episodes",
            lambda: seen([{"used_fraction": 0.5}], n_steps=32, baseline="mean"),
            lambda: seen([{"used_fraction": 0.5}], n_steps=32, baseline="value"),
        ),
    ],
)
def test_a_pitfall_begins_where_it_is_said_to(name, falls, stays):
    assert PITFALLS[name](falls()) is not None
    assert PITFALLS[name](stays()) is None


def test_batches_as_small_as_those_of_a2c_are_found():
    found = fall("CartPole-v1", 2000, n_envs=4, n_steps=5)
    assert "n_steps, or the number of environments" in found["too_few_episodes"]


def test_small_noise_weights_are_not_a_deterministic_policy():
    """With gSDE the standard deviation of the action is that of the weights times the norm of the features."""
    kwargs = {"log_std_init": -2.5, "net_arch": [256]}
    found = fall("Pendulum-v1", 1000, use_sde=True, policy_kwargs=kwargs, normalize_advantage=True)
    assert "deterministic_too_early" not in found
    found = fall("Pendulum-v1", 1000, use_sde=True, policy_kwargs={"log_std_init": -9.0}, normalize_advantage=True)
    assert "deterministic_too_early" in found


def test_noise_wider_than_the_actions_is_all_the_randomness_there_is():
    space = spaces.Box(-0.1, 0.1, (1,))
    assert [randomness(space, update) for update in seen([{"std": 1.0}, {"std": 0.5}]).updates] == [1.0, 1.0]


class Own(spaces.Discrete):
    """A space of the user's."""


def test_a_callback_serves_one_model_after_another():
    callback, env = PitfallCallback(), lambda: Corridor((4,), noise, action_space=Own(2))
    for _ in range(2):
        model = REINFORCE(
            "MlpPolicy", make_vec_env(env, 1, seed=0), n_episodes=1, baseline="none", device="cpu", seed=0
        )
        with pytest.warns(UserWarning, match="n_episodes"):
            model.learn(400, callback)
        assert callback.n_updates == model._n_updates and "too_few_episodes" in callback.found


def test_a_schedule_is_told_by_its_present_value():
    found = fall("CartPole-v1", 500, learning_rate=lambda progress: progress, ent_coef=lambda progress: 0.0)
    assert "learning rate, now 0." in found["rate_too_large"] or "learning rate, now 1" in found["rate_too_large"]
    assert "<function" not in "".join(found.values())


def test_every_pitfall_has_a_task():
    tested = {case[0] for case in test_a_task_made_for_it_falls_into_the_pitfall.pytestmark[0].args[1]}
    assert tested == set(PITFALLS)


def healthy(env, timesteps, normalize=False, **kwargs):
    venv = make_vec_env(env, 8, seed=0)
    model = REINFORCE(
        "MlpPolicy",
        VecNormalize(venv, gamma=kwargs.get("gamma", 0.99)) if normalize else venv,
        seed=0,
        device="cpu",
        gae_lambda=0.95,
        **kwargs,
    )
    callback = PitfallCallback()
    model.learn(timesteps, callback)
    return callback.found, callback.n_updates - model._n_updates


def test_nothing_is_said_of_a_healthy_run():
    """Every update was looked at, and no pitfall found."""
    assert healthy("CartPole-v1", 15_000) == ({}, 0)
    assert healthy("Pendulum-v1", 15_000, normalize=True, gamma=0.9) == ({}, 0)


@pytest.mark.slow
def test_nothing_is_said_of_long_healthy_runs():
    assert healthy("CartPole-v1", 60_000) == ({}, 0)
    assert healthy("Pendulum-v1", 100_000, normalize=True, gamma=0.9) == ({}, 0)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
def test_nothing_is_said_of_a_long_healthy_run_of_lunar_lander():
    with warnings.catch_warnings():
        # Box2D is not there, or warns where it is imported, and an error there would not be caught
        warnings.simplefilter("ignore")
        pytest.importorskip("Box2D")
    assert healthy("LunarLander-v3", 150_000) == ({}, 0)


def test_training_is_the_same_with_it():
    ours, theirs = (
        REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 4, seed=0), seed=0, device="cpu").learn(1024, callback)
        for callback in (PitfallCallback(), None)
    )
    for with_it, without in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        assert th.equal(with_it, without)


def test_other_models_are_refused():
    with pytest.raises(TypeError, match="must be a REINFORCE"):
        A2C("MlpPolicy", "CartPole-v1", device="cpu").learn(10, PitfallCallback())
