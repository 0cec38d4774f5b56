"""Measurements in a model's environments: the model then goes on as if nothing had happened."""

import os
import signal

import numpy as np
import pytest
from callbacks import Record
from environments import Corridor, of_two
from models import Scaled, all_kinds, both, make, plain
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce.diagnostics import compare_estimators, landscape
from sb3_reinforce.sampling.measurement import undisturbed

MEASUREMENTS = {
    "landscape": lambda model: landscape(model, n_points=2, n_episodes=1),
    "compare_estimators": lambda model: compare_estimators(
        model, n_episodes=3, n_estimates=3, n_delta=2, n_resamples=5, estimators=("central", "likelihood_ratio")
    ),
}


def observation(env):
    """What the environments show now."""
    return np.array([single.unwrapped.state for single in env.unwrapped.envs])


@pytest.mark.parametrize("measure", MEASUREMENTS)
@both
def test_the_policy_stays_as_it_was_and_the_observation_is_the_environments(kind, measure):
    env = VecNormalize(make_vec_env("CartPole-v1", 2, env_kwargs={"max_episode_steps": 50}))
    model = make(kind, env, policy_kwargs={"features_extractor_class": Scaled}).learn(20)
    before, count = plain(model.policy.state_dict()), env.obs_rms.count
    MEASUREMENTS[measure](model)
    assert plain(model.policy.state_dict()) == before and env.obs_rms.count == count and env.training
    assert np.allclose(model._last_obs, env.normalize_obs(observation(env)), atol=1e-5)
    assert model._last_episode_starts.all()
    model.learn(40, reset_num_timesteps=False)
    assert plain(model.policy.state_dict()) != before


@both
def test_each_vec_normalize_of_a_stack_keeps_its_statistics(kind):
    inner = VecNormalize(make_vec_env("CartPole-v1", 2), norm_reward=False)
    model = make(kind, VecNormalize(inner, norm_obs=False)).learn(20)
    count = inner.obs_rms.count
    landscape(model, n_points=2, n_episodes=1)
    assert inner.obs_rms.count == count and inner.training
    n_steps = model.num_timesteps
    model.learn(20, reset_num_timesteps=False)
    # With the reset that follows a measurement
    assert inner.obs_rms.count - count >= model.num_timesteps - n_steps


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_whatever_ends_a_measurement_the_next_rollout_begins_with_a_reset(error):
    """In the middle of training too, where a callback measures."""
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_obs=False)

    def fail(model):
        with pytest.raises(error), undisturbed(model):
            env.step(np.zeros(2, dtype=int))
            raise error
        assert env.training
        buffer = model.rollout_buffer
        return buffer.episode_starts[0].all() and np.abs(buffer.observations[0]).max() <= 0.05

    rollouts = Record(fail)
    make("steps", env).learn(64, rollouts)
    assert rollouts.records == [True] * 4


class Interrupted(ActorCriticPolicy):
    """Ctrl-C comes in the middle of a candidate's action."""

    def _predict(self, observation, deterministic=False):
        os.kill(os.getpid(), signal.SIGINT)
        return super()._predict(observation, deterministic)


def test_ctrl_c_leaves_no_candidate_in_the_policy():
    model = A2C(Interrupted, "CartPole-v1", device="cpu")
    before = plain(model.policy.state_dict())
    with pytest.raises(KeyboardInterrupt):
        landscape(model, n_points=2, n_episodes=1)
    assert plain(model.policy.state_dict()) == before and model._last_obs is None


@all_kinds
def test_a_measurement_in_the_middle_of_a_rollout_is_refused(kind):
    def measure(model):
        with undisturbed(model):
            return True

    def refused(model):
        with pytest.raises(ValueError, match=r"model is collecting a rollout.*measure in on_rollout_end"):
            measure(model)

    starts, ends = Record(measure, "rollout_start"), Record(measure, "rollout_end")
    model = make(kind).learn(50, [starts, Record(refused, "step"), ends])
    assert len(starts.records) == len(ends.records) == model._n_updates > 0


def test_sigterm_ends_a_measurement_as_ctrl_c_does():
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with pytest.raises(KeyboardInterrupt), undisturbed(make("steps", Corridor())):
        # By default it would end Python
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_after_a_measurement_episodes_go_on_from_rollout_to_rollout():
    model = make("steps", Corridor((20,)))
    landscape(model, n_points=2, n_episodes=1)
    starts = Record(lambda model: bool(model.rollout_buffer.episode_starts[0]))
    model.learn(16, starts)
    assert starts.records == [True, False]


def test_a_fault_is_named_in_a_measurement_too():
    """A DummyVecEnv would repeat the one number in the whole observation."""
    model = make("steps", of_two(fault="observation", at=3, value=np.zeros(1)))
    with pytest.raises(ValueError, match=r"observation of environment 1 must have shape \(7,\)"):
        landscape(model, n_points=2, n_episodes=1)
