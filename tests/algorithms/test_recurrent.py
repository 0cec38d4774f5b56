"""RecurrentREINFORCE: exact gradients through whole episodes, V where they are cut, states that are carried on."""

from functools import partial
from itertools import product

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import Record
from enumeration import GAMMA, assert_equal, complete, expectation
from environments import Corridor, Random
from gymnasium import spaces
from models import plain
from recurrent_models import SPACES, by_steps, make_recurrent, set_n_steps
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.common.tensors import flatten, stack, take
from sb3_reinforce.diagnostics import check_gradient, compare_baselines
from sb3_reinforce.policies.evaluation import log_prob_of
from sb3_reinforce.recurrent import RecurrentREINFORCE

# float32 holds them exactly
REWARDS = np.random.default_rng(0).integers(-8, 8, (2, 2, 2)) / 4
FIRST_REWARDS = np.random.default_rng(1).integers(-8, 8, (2, 2)) / 4


class Cue(gym.Env):
    """A cue is seen in the first of two steps, and what the second action is worth depends on it."""

    observation_space = spaces.Box(0, 1, (3,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(0), {}

    @staticmethod
    def observe(cue):
        return np.eye(3, dtype=np.float32)[2 if cue is None else cue]


def log_p(policy, cue, actions):
    """log p(τ), with π by sb3-contrib's own methods."""
    obs = np.stack([Cue.observe(cue), Cue.observe(None)])[:, None]
    logits, _ = by_steps(policy, obs, np.array([[False], [True]]), policy.zero_state(1))
    return np.log(0.5) + logits.log_softmax(1)[range(2), list(actions)].sum()


def rewards_of(cue, actions):
    return FIRST_REWARDS[cue, actions[0]], REWARDS[cue, actions[0], actions[1]]


def estimate(model, batch):
    """ĝ, as ``train`` steps along it, for episodes side by side."""
    buffer = RolloutBuffer(2, model.observation_space, model.action_space, "cpu", n_envs=len(batch))
    for i, (cue, actions) in enumerate(batch):
        buffer.observations[:, i] = np.stack([Cue.observe(cue), Cue.observe(None)])
        buffer.actions[:, i, 0] = actions
        buffer.rewards[:, i] = rewards_of(cue, actions)
    dones = np.array([[False] * len(batch), [True] * len(batch)])
    buffer.full = True
    model.rollout_buffer = buffer
    model.rollout, buffer.advantages, buffer.returns = complete(model, buffer, dones)
    before = th.nn.utils.parameters_to_vector(model.policy.parameters()).detach().clone()
    model.train()
    step = th.nn.utils.parameters_to_vector(model.policy.parameters()).detach() - before
    th.nn.utils.vector_to_parameters(before, model.policy.parameters())
    return step


@pytest.mark.parametrize("baseline", ["none", "leave_one_out"])
@pytest.mark.parametrize("network", [{}, {"n_lstm_layers": 2}, {"memory": "gru"}], ids=str)
def test_the_expected_gradient_is_that_of_the_return(network, baseline):
    """By enumeration of all pairs of episodes of a task whose second observation says nothing."""
    model = make_recurrent(
        env=Cue(),
        n_episodes=2,
        gamma=GAMMA,
        discount_scores=True,
        normalize_by="episodes",
        baseline=baseline,
        learning_rate=1.0,
        max_grad_norm=None,
        policy_kwargs={"optimizer_class": th.optim.SGD, "lstm_hidden_size": 2, "net_arch": [], **network},
    )
    model._setup_learn(1)
    model._current_progress_remaining = 1.0
    episodes = list(product((0, 1), product((0, 1), repeat=2)))
    log_ps = [log_p(model.policy, *episode) for episode in episodes]
    returns = [np.dot(rewards_of(*episode), (1, GAMMA)) for episode in episodes]
    expected_return = sum(log_p.exp() * g for log_p, g in zip(log_ps, returns, strict=True))
    gradients = th.autograd.grad(
        expected_return, list(model.policy.parameters()), materialize_grads=True, allow_unused=True
    )
    expected = th.nn.utils.parameters_to_vector(gradients)
    assert expected.norm() > 0.01
    assert_equal(expectation(partial(estimate, model), episodes, log_ps, 2), expected)


class Ends(Record):
    """The last observation of each episode, by its last step (counted from the start of training) and environment."""

    def __init__(self):
        super().__init__(lambda model: None, at="step")
        self.found = {}

    def _on_step(self) -> bool:
        for env, info in enumerate(self.locals["infos"]):
            if self.locals["dones"][env]:
                obs = info["terminal_observation"] if info["TimeLimit.truncated"] else None
                self.found[self.n_calls - 1, env] = obs
        return True


@th.no_grad()
def outputs_of(policy, episode):
    """The logits and V after a list of observations, by sb3-contrib's own methods."""
    if isinstance(episode[0], dict):
        # A rollout buffer holds a Discrete observation as an array, and the environment returns a number
        episode = [{key: np.ravel(part) for key, part in obs.items()} for obs in episode]
    obs = stack(episode)
    obs = {key: part[:, None] for key, part in obs.items()} if isinstance(obs, dict) else obs[:, None]
    logits, values = by_steps(policy, obs, np.zeros((len(episode), 1), dtype=bool), policy.zero_state(1))
    return logits[-1], float(values[-1])


def test_with_gsde_the_sequences_of_training_have_the_log_probabilities_of_the_steps():
    env = make_vec_env("Pendulum-v1", 2, seed=0)
    log_probs = Record(lambda model: model.rollout_buffer.log_probs.ravel())
    model = make_recurrent(env=env, double=False, n_steps=8, learning_rate=0.0, use_sde=True).learn(16, log_probs)
    trained_on = log_prob_of(model.policy, flatten(model.rollout.inputs), flatten(model.rollout.actions))
    np.testing.assert_allclose(trained_on.detach(), log_probs.records[0], rtol=1e-4)


def copy_of(buffer):
    return buffer.episode_starts.copy(), buffer.log_probs.copy()


@pytest.mark.parametrize(
    ("name", "truncate", "n_steps"),
    [
        *product(["MlpLstmPolicy"], [False, True], [4, None, "rollout_start", "rollout_end"]),
        # Time limits have a further observation of their space
        *product(["CnnLstmPolicy", "MultiInputLstmPolicy"], [True], [4, None]),
    ],
)
def test_outputs_are_those_of_one_step_at_a_time(n_steps, truncate, name):
    """Also after time limits, where a rollout cuts an episode, and where a callback ends rollouts of whole episodes."""
    switch = Record(set_n_steps, at=n_steps) if isinstance(n_steps, str) else Record(lambda model: None)
    n_steps = None if isinstance(n_steps, str) else n_steps
    env = make_vec_env(lambda: Random(SPACES[name], lengths=(2, 5, 9), truncate=truncate), 2, seed=0)
    model = make_recurrent(name, env, n_steps=n_steps, n_episodes=None if n_steps else 4, learning_rate=0.0)
    records = Record(lambda model: (model.rollout, model._last_obs, copy_of(model.rollout_buffer)))
    ends = Ends()
    model.learn(36, [records, ends, switch])
    first = 0
    running = [[], []]
    for rollout, last_obs, (starts, log_probs) in records.records:
        # The actor's steps and the sequences of training have one log π
        actions = rollout.actions.flatten().long()
        trained_on = log_prob_of(model.policy, flatten(rollout.inputs), actions)
        np.testing.assert_allclose(trained_on.detach(), log_probs.ravel(), atol=1e-6)
        for t, env in product(range(len(rollout.dones)), range(2)):
            if starts[t, env]:
                running[env] = []
            running[env].append(take(rollout.observations, (t, env)))
            logits, value = outputs_of(model.policy, running[env])
            assert float(rollout.values[t, env]) == pytest.approx(value, abs=1e-6)
            assert log_probs[t, env] == pytest.approx(float(logits[int(rollout.actions[t, env])]), abs=1e-6)
            is_last = bool(rollout.dones[t, env])
            if is_last:
                following = ends.found[first + t, env]
            else:
                after = take(rollout.observations, t + 1) if t + 1 < len(rollout.dones) else last_obs
                following = take(after, env)
            expected = 0.0 if following is None else outputs_of(model.policy, [*running[env], following])[1]
            if rollout.used[t, env]:
                assert float(rollout.next_values[t, env]) == pytest.approx(expected, abs=1e-6)
        first += len(rollout.dones)


def test_the_critics_minibatches_are_whole_sequences():
    model = make_recurrent(n_steps=40, batch_size=10, double=False)
    values = model.policy.sequence_values
    asked = []
    model.policy.sequence_values = lambda rows: asked.append(rows["sequence"]) or values(rows)
    whole = th.bincount(model.learn(80).rollout.episodes.flatten())
    parts = [each for each in asked if len(each) < 80]
    assert len(parts) > 4
    assert all(th.equal(th.bincount(each, minlength=len(whole))[each], whole[each]) for each in parts)


@pytest.mark.parametrize("n_steps", [8, None])
def test_saving_and_going_on_is_never_having_stopped(n_steps, tmp_path):
    ends = []
    for stops in (False, True):
        env = make_vec_env("CartPole-v1", 2, seed=5)
        model = make_recurrent(env=env, double=False, n_steps=n_steps).learn(100)
        if stops:
            model.save(tmp_path / "model")
            model = RecurrentREINFORCE.load(tmp_path / "model", env, device="cpu", restore_random_state=True)
        env.seed(7)
        model.set_env(env)
        model.learn(100, reset_num_timesteps=False)
        ends.append(plain(model.get_parameters()))
    assert ends[0] == ends[1]


@pytest.mark.parametrize("name", SPACES)
def test_a_loaded_model_evaluates_alike(name, tmp_path):
    env = make_vec_env(lambda: Random(SPACES[name], lengths=(3, 5)), 2, seed=0)
    model = make_recurrent(name, env, n_episodes=4, double=False, policy_kwargs={"n_lstm_layers": 2}).learn(20)
    model.save(tmp_path / "model")
    loaded = RecurrentREINFORCE.load(tmp_path / "model", env)
    results = []
    for each in (model, loaded):
        env.seed(3)
        results.append(evaluate_policy(each, env, 4, return_episode_rewards=True))
    assert results[0] == results[1]


@pytest.mark.parametrize("network", [{}, {"n_lstm_layers": 2}, {"memory": "gru"}], ids=str)
def test_the_lab_takes_it(network):
    env = make_vec_env(lambda: Corridor((3, 5), lambda t, action: float(t * action)), 2, seed=0)
    model = make_recurrent(env=env, double=False, n_episodes=4, policy_kwargs=network)
    table = check_gradient(model)
    assert table.passed, str(table)
    assert len(compare_baselines(model, n_episodes=4, n_resamples=50)) >= 5


def test_cudnn_is_not_asked_for_gradients_in_evaluation_mode(monkeypatch):
    """Which it cannot compute; where there is no dropout, the memory is in training mode all the time."""
    passes = []
    forward = th.nn.LSTM.forward

    def recorded(self, *inputs):
        is_differentiated = th.is_grad_enabled() and not self.training
        passes.append((is_differentiated, th.backends.cudnn.enabled))
        return forward(self, *inputs)

    monkeypatch.setattr(th.nn.LSTM, "forward", recorded)
    network = {"lstm_kwargs": {"dropout": 0.5}, "n_lstm_layers": 2}
    model = make_recurrent(double=False, n_episodes=4, baseline="optimal", policy_kwargs=network).learn(20)
    compare_baselines(model, n_episodes=4, n_resamples=2)
    assert (True, False) in passes and (True, True) not in passes


@pytest.mark.parametrize("dropout", [0.0, 0.5])
def test_a_memory_without_dropout_stays_in_training_mode(dropout):
    """Where cuDNN has a backward pass; with dropout the mode matters."""
    network = {"n_lstm_layers": 2, "lstm_kwargs": {"dropout": dropout}}
    policy = make_recurrent(env="CartPole-v1", double=False, policy_kwargs=network).policy
    policy.set_training_mode(False)
    assert policy.lstm_actor.training == policy.lstm_critic.training == (dropout == 0)
    assert not policy.mlp_extractor.training


@pytest.mark.parametrize(
    ("algorithm", "policy"),
    [(REINFORCE, "MlpPolicy"), (RecurrentREINFORCE, "MlpLstmPolicy"), (FiniteDifference, "LinearPolicy")],
)
def test_the_log_has_the_name_of_the_class_or_the_given_one(algorithm, policy, tmp_path):
    own = type("Own", (algorithm,), {})
    given = []

    def keep_name(locals_, globals_):
        given.append(locals_["tb_log_name"])
        return False

    for each, kwargs in ((algorithm, {}), (own, {}), (own, {"tb_log_name": "mine"})):
        each(policy, "CartPole-v1", tensorboard_log=tmp_path, device="cpu").learn(1, keep_name, **kwargs)
    names = [algorithm.__name__, "Own", "mine"]
    assert sorted({*given}) == sorted(names)
    assert {path.parent.name for path in tmp_path.glob("*/events*")} == {f"{name}_1" for name in names}
