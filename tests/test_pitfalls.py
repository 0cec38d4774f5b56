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
from sb3_reinforce.diagnostics.pitfalls import PITFALLS


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
    if not isinstance(env, str):
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
        ("rate_too_large", "learning_rate=1.0", "CartPole-v1", 2000, {"learning_rate": 1.0}),
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
    assert callback.found == {}
    assert callback.n_updates == model._n_updates
    return model


def test_nothing_is_said_of_a_healthy_run():
    healthy("CartPole-v1", 15_000)
    healthy("Pendulum-v1", 15_000, normalize=True, gamma=0.9)


@pytest.mark.slow
def test_nothing_is_said_of_long_healthy_runs():
    healthy("CartPole-v1", 60_000)
    healthy("Pendulum-v1", 100_000, normalize=True, gamma=0.9)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:builtin type:DeprecationWarning")
def test_nothing_is_said_of_a_long_healthy_run_of_lunar_lander():
    with warnings.catch_warnings():
        # Box2D is not there, or warns where it is imported, and an error there would not be caught
        warnings.simplefilter("ignore")
        pytest.importorskip("Box2D")
    healthy("LunarLander-v3", 150_000)


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
