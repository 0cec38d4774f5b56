"""A recurrent policy on padded sequences is sb3-contrib's, one step at a time."""

from itertools import product

import numpy as np
import pytest
import torch as th
from recurrent_models import EXACT, SPACES, by_steps, make_recurrent
from stable_baselines3.common.utils import obs_as_tensor

from sb3_reinforce.common.tensors import flatten, map_parts, stack, take
from sb3_reinforce.policies import sequences
from sb3_reinforce.policies.sequences import episode_numbers, rows_of, sequence_minibatches

# Ragged episodes: one of a single step, one that ends with the rollout, and some that it cuts
DONES = np.array([[0, 0, 1], [1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1]], dtype=bool)
NETWORKS = [
    {},
    {"n_lstm_layers": 2},
    {"memory": "gru"},
    {"memory": "rnn", "n_lstm_layers": 2},
    {"enable_critic_lstm": False},
    {"enable_critic_lstm": False, "shared_lstm": True},
    {"lstm_kwargs": {"bias": False}},
]


def observations(space):
    space.seed(0)
    samples = stack([space.sample() for _ in range(DONES.size)])
    return map_parts(lambda part: part.reshape(*DONES.shape, *part.shape[1:]), samples)


def policy_and_rows(name, network, carried):
    policy = make_recurrent(name, policy_kwargs=network).policy
    obs = observations(SPACES[name])
    state = policy.zero_state(DONES.shape[1])
    if carried:
        state.normal_()
    if network.get("memory", "lstm") != "lstm":
        state[:, :, 1] = state[:, :, 0]
    if network.get("shared_lstm"):
        state[:, 1] = state[:, 0]
    rows = flatten(rows_of(obs_as_tensor(obs, "cpu"), th.as_tensor(DONES), state if carried else None))
    return policy, obs, state, rows


@pytest.mark.parametrize("limit", [2**24, 1], ids=["at once", "in pieces"])
@pytest.mark.parametrize(
    ("name", "network", "carried"),
    [*product(["MlpLstmPolicy"], NETWORKS, [False, True]), *product(list(SPACES)[1:], NETWORKS[:2], [False, True])],
    ids=str,
)
def test_sequences_are_steps(name, network, carried, limit, monkeypatch):
    """Outputs and gradients, also when long episodes are computed in pieces."""
    monkeypatch.setattr(sequences, "FLOATS", limit)
    policy, obs, state, rows = policy_and_rows(name, network, carried)
    own = (policy.sequence_distribution(rows).distribution.logits, policy.sequence_values(rows))
    stepped = by_steps(policy, obs, DONES, state)
    parameters = list(policy.parameters())
    for outputs, expected in zip(own, stepped, strict=True):
        th.testing.assert_close(outputs, expected, **EXACT)
        weights = th.randn_like(outputs)
        gradients, expected_gradients = (
            th.autograd.grad((weights * each).sum(), parameters, materialize_grads=True, allow_unused=True)
            for each in (outputs, expected)
        )
        th.testing.assert_close(gradients, expected_gradients, **EXACT)


@pytest.mark.parametrize("network", NETWORKS[:4], ids=str)
def test_the_critics_state_after_a_rollout(network):
    policy, obs, state, rows = policy_and_rows("MlpLstmPolicy", network, carried=True)
    last = take(rows, rows["sequence"] == episode_numbers(th.as_tensor(DONES))[-1].repeat(len(DONES)))
    after = policy.state_after(last)
    # From there on, further steps are those of a longer rollout
    more = np.concatenate([obs, obs])
    dones = np.concatenate([DONES[:-1], np.zeros_like(DONES[:1]), np.zeros_like(DONES)])
    going_on = state.clone()
    going_on[:, 1] = after
    _, values = by_steps(policy, more, dones, state)
    _, following = by_steps(policy, obs, np.zeros_like(DONES), going_on)
    th.testing.assert_close(following, values[DONES.size :], **EXACT)


def test_minibatches_have_a_new_order():
    orders = {tuple(th.cat(list(sequence_minibatches(th.arange(40), 1))).tolist()) for _ in range(3)}
    assert len(orders | {tuple(range(40))}) == 4


@pytest.mark.parametrize("size", [1, 4, 7, 100])
def test_minibatches_are_whole_sequences(size):
    sequence = th.as_tensor(episode_numbers(th.as_tensor(DONES)).flatten())
    lengths = th.bincount(sequence)
    batches = list(sequence_minibatches(sequence, size))
    assert sorted(th.cat(batches).tolist()) == list(range(len(sequence)))
    for rows in batches:
        numbers = sequence[rows]
        assert th.equal(th.bincount(numbers, minlength=len(lengths))[numbers], lengths[numbers])
        assert len(rows) < size + int(lengths.max())


def test_a_saved_policy_is_loaded_with_its_memory(tmp_path):
    policy = make_recurrent(double=False, policy_kwargs={"n_lstm_layers": 2, "memory": "gru"}).policy
    policy.save(tmp_path / "policy")
    loaded = type(policy).load(tmp_path / "policy", device="cpu")
    obs = np.ones((2, 3), dtype=np.float32)
    state = None
    for _ in range(3):
        action, next_state = policy.predict(obs, state, deterministic=True)
        other, state = loaded.predict(obs, state, deterministic=True)
        np.testing.assert_array_equal(state, next_state)
        np.testing.assert_array_equal(action, other)


@pytest.mark.parametrize("memory", ["lstm", "gru", "rnn"])
def test_gates_start_orthogonal(memory):
    model = make_recurrent(double=False, policy_kwargs={"memory": memory})
    policy = type(model.policy)(**model.policy._get_constructor_parameters())
    for gate in policy.lstm_actor.weight_hh_l0.split(4):
        th.testing.assert_close(gate @ gate.T, th.eye(4), atol=1e-5, rtol=0)
    for gate in policy.lstm_actor.weight_ih_l0.split(4):
        th.testing.assert_close(gate.T @ gate, th.eye(gate.shape[1]), atol=1e-5, rtol=0)
    assert not policy.lstm_actor.bias_hh_l0.any() and not policy.lstm_actor.bias_ih_l0.any()
    # As PyTorch does: uniform in ±1/√n
    model = make_recurrent(double=False, policy_kwargs={"memory": memory, "ortho_init": False})
    weight = type(model.policy)(**model.policy._get_constructor_parameters()).lstm_actor.weight_hh_l0
    assert weight.abs().max() <= 0.5 and weight.split(4)[0].norm() < 1.9


def test_optimizers_have_the_users_arguments():
    """Also the policy's, which is made again with its memories."""
    kwargs = {"optimizer_class": th.optim.SGD, "optimizer_kwargs": {"momentum": 0.5}}
    model = make_recurrent(policy_kwargs=kwargs)
    for optimizer in (model.policy.optimizer, model.critic_optimizer):
        assert optimizer.defaults["momentum"] == 0.5


@pytest.mark.parametrize("with_lstm", [True, False])
def test_the_critics_part_starts_orthogonal_too(with_lstm):
    model = make_recurrent(double=False, policy_kwargs={"enable_critic_lstm": with_lstm})
    policy = type(model.policy)(**model.policy._get_constructor_parameters())
    weight = policy.lstm_critic.weight_ih_l0[:4] if with_lstm else policy.critic.weight
    th.testing.assert_close(weight.T @ weight, th.eye(weight.shape[1]), atol=1e-5, rtol=0)


def test_minibatches_of_equal_sequences_are_as_large_as_asked_for():
    sequence = th.arange(6).repeat_interleave(2)
    assert [len(rows) for rows in sequence_minibatches(sequence, 4)] == [4] * 3
