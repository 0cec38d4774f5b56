"""Episodes of a recurrent policy go on with their memory, and what a memory cannot be is named."""

import cloudpickle
import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor, Random
from gymnasium import spaces
from models import moved_by_learning
from recurrent_models import make_recurrent, set_n_steps
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import landscape
from sb3_reinforce.recurrent import MlpLstmPolicy, RecurrentREINFORCE


def one_step(method):
    """A model whose policy overrides what is called for single steps alone."""
    policy = type("OneStep", (MlpLstmPolicy,), {method: lambda self, *args: getattr(super(), method)(*args)})
    return lambda env: RecurrentREINFORCE(policy, env)


def memory(**policy_kwargs):
    return lambda env: make_recurrent(env=env, policy_kwargs=policy_kwargs)


def predict(*arguments):
    return lambda env: make_recurrent(env=env, double=False).predict(*arguments)


THREE = np.zeros((3, 4), dtype=np.float32)
TWO_STATES = (np.zeros((1, 2, 4)), np.zeros((1, 2, 4)))


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda env: REINFORCE("MlpLstmPolicy", env), "RecurrentREINFORCE"),
        (lambda env: RecurrentREINFORCE("MlpPolicy", env), "policy must be a class or one of .*MlpLstmPolicy"),
        (lambda env: RecurrentREINFORCE(RecurrentActorCriticPolicy, env), "policy must be one of MlpLstmPolicy"),
        (lambda env: RecurrentREINFORCE(ActorCriticPolicy, env), "policy must be one of MlpLstmPolicy"),
        (one_step("get_distribution"), "OneStep overrides get_distribution, .* override sequence_distribution too"),
        (one_step("forward"), "overrides forward, .* override sequence_distribution too"),
        (one_step("evaluate_actions"), "overrides evaluate_actions, .* override sequence_distribution too"),
        (one_step("extract_features"), "overrides extract_features, .* override row_features too"),
        (
            lambda env: RecurrentREINFORCE("MultiInputLstmPolicy", env),
            "policy must be MlpLstmPolicy for observations in",
        ),
        (lambda env: landscape(make_recurrent(env=env, double=False)), "must have no memory, got MlpLstmPolicy"),
        (
            lambda env: landscape(RecurrentPPO("MlpLstmPolicy", env, device="cpu")),
            "must have no memory, got RecurrentActorCriticPolicy",
        ),
        (memory(memory="LSTM"), "memory must be one of 'lstm', 'gru', 'rnn'"),
        (memory(lstm_hidden_size=0), "lstm_hidden_size must be"),
        (memory(lstm_kwargs={"batch_first": True}), "lstm_kwargs must be a dict with some of bias, dropout"),
        (memory(memory=["gru"]), r"memory must be one of 'lstm', 'gru', 'rnn', got \['gru'\]"),
        (memory(memory="gru", lstm_kwargs={"nonlinearity": "relu"}), "lstm_kwargs must be"),
        (predict(THREE, TWO_STATES), r"state must be .* of shape \(1, 3, 4\)"),
        (predict(THREE, None, [True]), "episode_start must have 3 entries, one for each observation, got 1"),
        (predict(THREE[0], None, [True, False]), "episode_start must have 1 entries"),
        (predict((THREE, {})), "observation must not be a tuple"),
    ],
)
def test_what_a_memory_cannot_be_is_said_in_a_sentence(call, sentence):
    with pytest.raises(ValueError, match=sentence):
        call(make_vec_env("CartPole-v1"))


@pytest.mark.parametrize("method", ["get_distribution", "predict_values"])
def test_a_method_for_single_steps_that_is_replaced_later_is_refused(method):
    model = make_recurrent(double=False, n_episodes=2).learn(1)
    setattr(model.policy, method, getattr(model.policy, method))
    with pytest.raises(ValueError, match=f"policy=MlpLstmPolicy overrides {method}, which is called for single steps"):
        model.learn(1)


class TwoLayers(MlpLstmPolicy):
    """A critic with another output."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        width = self.mlp_extractor.latent_dim_vf
        self.value_net = th.nn.Sequential(th.nn.Linear(width, 3), th.nn.Tanh(), th.nn.Linear(3, 1))


@pytest.mark.parametrize("baseline", ["value", "none"])
def test_a_user_may_build_another_critic(baseline):
    moved = moved_by_learning(RecurrentREINFORCE(TwoLayers, "CartPole-v1", baseline=baseline, seed=0, device="cpu"), 1)
    assert "lstm_actor.weight_hh_l0" in moved and ("value_net.2.weight" in moved) == (baseline == "value")


@pytest.mark.parametrize("at", ["rollout_start", "step", "rollout_end"])
def test_episodes_go_on_after_a_callback_has_set_n_steps(at):
    """The first rollout of fixed length begins with a reset, and no other one."""
    env = make_vec_env(lambda: Corridor((3, 40)), 2, seed=0)
    model = RecurrentREINFORCE("MlpLstmPolicy", env, n_episodes=2, seed=0, device="cpu")
    starts = Record(lambda model: model.rollout_buffer.episode_starts[0].tolist())
    model.learn(100, callback=[starts, Record(set_n_steps, at=at)])
    assert all(starts.records[1])
    assert not any(map(all, starts.records[2:]))


def test_episodes_go_on_after_an_error_at_the_start_of_a_rollout():
    def fail(model):
        if model.num_timesteps > 0:
            model.n_steps, model.n_episodes = None, -1

    env = make_vec_env(lambda: Corridor((40,)), 2, seed=0)
    model = RecurrentREINFORCE("MlpLstmPolicy", env, n_steps=4, seed=0, device="cpu")
    with pytest.raises(ValueError, match="n_episodes"):
        model.learn(100, Record(fail, at="rollout_start"))
    model.n_steps, model.n_episodes = 4, None
    model.learn(8, reset_num_timesteps=False)
    assert not model.rollout_buffer.episode_starts[0].any()


def test_episodes_go_on_with_their_memory_after_an_error_at_the_end_of_a_rollout():
    env = make_vec_env(lambda: Corridor((40,)), 2, seed=0)
    model = RecurrentREINFORCE("MlpLstmPolicy", env, n_steps=5, learning_rate=0.0, seed=0, device="cpu")

    def fail(model):
        if model.num_timesteps == 30:
            raise RuntimeError("at the end of the third rollout")

    with pytest.raises(RuntimeError, match="third rollout"):
        model.learn(100, Record(fail))
    # The state after the fifteen steps is the one that a single rollout of fifteen ends with
    env = make_vec_env(lambda: Corridor((40,)), 2, seed=0)
    whole = RecurrentREINFORCE("MlpLstmPolicy", env, n_steps=15, learning_rate=0.0, seed=0, device="cpu").learn(30)
    th.testing.assert_close(model._next_state[:, 0], whole._next_state[:, 0])
    assert model.learn(10, reset_num_timesteps=False).num_timesteps == 40


def test_episodes_whose_memory_is_lost_by_an_interruption_are_reset():
    model = RecurrentREINFORCE("MlpLstmPolicy", Corridor((40,)), n_steps=5, seed=0, device="cpu").learn(10)
    state_after = model.policy.state_after

    def interrupt(rows):
        model.policy.state_after = state_after
        raise KeyboardInterrupt

    model.policy.state_after = interrupt
    with pytest.raises(KeyboardInterrupt):
        model.learn(20, reset_num_timesteps=False)
    starts = Record(lambda model: model.rollout_buffer.episode_starts[0].all())
    model.learn(10, starts, reset_num_timesteps=False)
    assert starts.records == [True, False]


def test_a_trained_model_can_be_pickled():
    model = make_recurrent(env=make_vec_env("CartPole-v1", 2), double=False, n_steps=8).learn(32)
    copy = cloudpickle.loads(cloudpickle.dumps(model))
    assert np.array_equal(copy._next_state, model._next_state)


@pytest.mark.parametrize("space", [spaces.MultiDiscrete([2, 3]), spaces.Dict({"n": spaces.MultiDiscrete([2, 3])})])
def test_observations_may_be_several_numbers(space):
    """The size of their features is an integer of NumPy."""
    policy = "MultiInputLstmPolicy" if isinstance(space, spaces.Dict) else "MlpLstmPolicy"
    model = RecurrentREINFORCE(policy, Random(space, spaces.Discrete(2)), n_steps=16, seed=0, device="cpu")
    assert "lstm_actor.weight_ih_l0" in moved_by_learning(model, 32)


def test_one_environment_alone_needs_no_arrays_of_flags():
    """As with RecurrentPPO."""
    model = make_recurrent(env="CartPole-v1", double=False)
    obs = np.ones(4, dtype=np.float32)
    _, state = model.predict(obs)
    expected = model.predict(obs, state, np.array([True]), deterministic=True)
    for flag, given in ((True, state), ([True], list(state)), (np.ones((1, 1)), state)):
        np.testing.assert_equal(model.predict(obs, given, flag, deterministic=True), expected)
