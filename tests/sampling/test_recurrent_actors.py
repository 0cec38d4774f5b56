"""The NumPy LSTM is sb3-contrib's policy: the same states, the same actions for the same seed."""

import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Corridor
from gymnasium import spaces
from recurrent_models import make_recurrent
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce.sampling.recurrent_actors import LstmActor, RecurrentPolicyActor, make_recurrent_actor

ACTIONS = [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3), spaces.Box(-1, 1, (2,))]


def recorded(actor):
    """Actions, log π and states over random observations and starts of episodes."""
    rng = np.random.default_rng(0)
    th.manual_seed(1)
    obs = rng.normal(size=(200, 3, 5)).astype(np.float32)
    starts = rng.random((200, 3)) < 0.1
    actions, states, log_probs = [], [], []
    for t in range(200):
        actor.starts = lambda t=t: starts[t]
        action, _, log_prob = actor.act(obs[t])
        actions.append(action)
        log_probs.append(log_prob)
        states.append(actor.state())
    if log_probs[0] is None:
        log_probs = actor.log_prob(np.array(actions).reshape(200, 3, -1))
    return obs, starts, np.array(actions), th.stack(states), np.ravel(log_probs)


def corridor(space):
    return make_vec_env(lambda: Corridor((5, 3), lambda t, action: float(np.sum(action)), space), 3, seed=0)


@pytest.mark.parametrize(
    ("space", "activation_fn"), [*((space, th.nn.Tanh) for space in ACTIONS), (ACTIONS[0], th.nn.ReLU)]
)
def test_both_actors_act_alike(space, activation_fn):
    policy = make_recurrent(env=corridor(space), double=False, policy_kwargs={"activation_fn": activation_fn}).policy
    state = th.randn(3, 2, 1, 4)
    fast = make_recurrent_actor(policy, state, None, True)
    general = RecurrentPolicyActor(policy, state, None, True)
    assert isinstance(fast, LstmActor)
    (_, _, *fast), (_, _, *general) = recorded(fast), recorded(general)
    for ours, theirs in zip(fast, general, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-5)
    assert np.ptp(fast[0]) > 0


def test_states_are_those_of_predict():
    policy = make_recurrent(env=corridor(ACTIONS[0]), double=False).policy
    obs, starts, _, states, _ = recorded(make_recurrent_actor(policy, th.zeros(3, 2, 1, 4), None, True))
    state = None
    for t in range(len(obs)):
        _, state = policy.predict(obs[t], state, starts[t])
        np.testing.assert_allclose(states[t].permute(1, 2, 0, 3), state, atol=1e-5)


@pytest.mark.parametrize(
    "network",
    [
        {"n_lstm_layers": 2},
        {"memory": "gru"},
        {"lstm_kwargs": {"bias": False}},
        {"activation_fn": th.nn.ELU},
    ],
    ids=str,
)
def test_other_networks_act_by_themselves(network):
    policy = make_recurrent(env=corridor(ACTIONS[0]), double=False, policy_kwargs=network).policy
    actor = make_recurrent_actor(policy, policy.zero_state(3)[:, 0], None, False)
    assert type(actor) is RecurrentPolicyActor


class OwnLstm(th.nn.LSTM):
    """A class of the user."""


# For single steps and for whole sequences
METHODS = ("get_distribution", "sequence_distribution")


@pytest.mark.parametrize(
    "change",
    [
        lambda policy: policy.lstm_actor.register_forward_hook(lambda module, inputs, outputs: None),
        lambda policy: policy.mlp_extractor.policy_net.register_forward_hook(lambda module, inputs, outputs: outputs),
        lambda policy: setattr(policy.lstm_actor, "forward", policy.lstm_actor.forward),
        lambda policy: setattr(policy, "lstm_actor", OwnLstm(5, 4)),
        lambda policy: vars(policy).update({name: getattr(policy, name) for name in METHODS}),
    ],
    ids=["hook of the LSTM", "hook of the MLP", "method of the LSTM", "another LSTM", "methods of the policy"],
)
def test_a_change_during_a_rollout_counts_at_once(change):
    model = make_recurrent(env=corridor(ACTIONS[0]), double=False, n_steps=20)
    changing = At(5, lambda model: change(model.policy) and None)
    kinds = Record(lambda model: type(model._actor), at="step")
    model.learn(60, callback=[kinds, changing])
    assert set(kinds.records[:5]) == {LstmActor} and set(kinds.records[5:]) == {RecurrentPolicyActor}


def test_new_memory_of_a_weight_counts_at_once():
    model = make_recurrent(env=corridor(ACTIONS[0]), double=False, n_steps=20)
    weight = model.policy.lstm_actor.weight_ih_l0
    actors = Record(lambda model: model._actor, at="step")
    model.learn(60, [actors, At(5, lambda model: setattr(weight, "data", weight.data.clone()))])
    assert len(set(actors.records)) == 2 and type(actors.records[5]) is LstmActor


@pytest.mark.parametrize("n_steps", [8, None])
def test_a_run_does_not_depend_on_the_path(n_steps):
    ends = []
    for hook in (False, True):
        model = make_recurrent(env=corridor(ACTIONS[0]), double=False, n_steps=n_steps, learning_rate=1e-2)
        if hook:
            model.policy.lstm_actor.register_forward_hook(lambda module, inputs, outputs: None)
        model.learn(200)
        ends.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    th.testing.assert_close(*ends, rtol=1e-3, atol=1e-4)
