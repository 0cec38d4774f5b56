"""It learns: a small version in a few seconds, and the README's claim on all its seeds."""

import pytest
from environments import native
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import IdentityEnv, IdentityEnvBox, IdentityEnvMultiBinary, IdentityEnvMultiDiscrete
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecMonitor

from sb3_reinforce import REINFORCE

# What the other pairs would have in common with these, test_gradient states exactly
CASES = [
    (IdentityEnv, "value"),
    pytest.param(IdentityEnvMultiDiscrete, "leave_one_out", marks=pytest.mark.slow),
    pytest.param(IdentityEnvMultiBinary, "value", marks=pytest.mark.slow),
    (IdentityEnvBox, "leave_one_out"),
]


@pytest.mark.parametrize(("env_class", "baseline"), CASES)
def test_to_repeat_the_observation(env_class, baseline):
    """Nearly all of the 100 rewards of an episode, from each action space, with a critic or without."""
    box = env_class is IdentityEnvBox
    env = make_vec_env(env_class, 8, env_kwargs={"eps": 0.5} if box else {"dim": 3})
    mode = {"n_steps": 8} if baseline == "value" else {"n_episodes": 8}
    model = REINFORCE(
        "MlpPolicy", env, baseline=baseline, gamma=0.4, learning_rate=5e-3, seed=0, normalize_advantage=True, **mode,
        policy_kwargs={"log_std_init": -0.5} if box else {}, device="cpu",
    ).learn(8_000 if baseline == "value" else 16_000)  # fmt: skip
    mean, _ = evaluate_policy(model, env, n_eval_episodes=16)
    assert mean >= 90


def stop_at_490(eval_env, eval_freq):
    """Stop once 20 episodes score 490."""
    stop = StopTrainingOnRewardThreshold(reward_threshold=490, verbose=0)
    return EvalCallback(eval_env, callback_on_new_best=stop, n_eval_episodes=20, eval_freq=eval_freq, verbose=0)


def score(model, seed):
    return evaluate_policy(model, make_vec_env("CartPole-v1", 5, seed=2000 + seed), n_eval_episodes=100)[0]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_cart_pole_is_solved(seed):
    model = REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 8, seed=seed), gae_lambda=0.95, seed=seed, device="cpu")
    model.learn(150_000, callback=stop_at_490(make_vec_env("CartPole-v1", 5, seed=1000 + seed), 4000 // 8))
    assert model.num_timesteps <= 150_000 and score(model, seed) >= 475


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_cart_pole_is_solved_on_a_native_vector_environment(seed):
    env, eval_env = (VecMonitor(native(n_envs)) for n_envs in (256, 5))
    model = REINFORCE("MlpPolicy", env, n_steps=8, gae_lambda=0.95, seed=seed, device="cpu", batch_size=512)
    assert score(model.learn(1_000_000, callback=stop_at_490(eval_env, 40)), seed) >= 475
