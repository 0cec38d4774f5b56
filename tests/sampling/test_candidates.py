"""Candidates side by side: the same as one by one, from the starts that they should have, and none of them twice."""

from collections import Counter
from itertools import product

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import NumericEnds, Wrapper
from gymnasium import spaces
from models import OwnPrediction, Scaled
from policy_changes import CHANGES
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import (
    ActorCriticCnnPolicy,
    ActorCriticPolicy,
    MultiInputActorCriticPolicy,
)
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_reinforce import FiniteDifference
from sb3_reinforce.common.tensors import stack, take
from sb3_reinforce.envs.starts import start_episodes
from sb3_reinforce.policies import parameters
from sb3_reinforce.policies.evaluation import set_temperature
from sb3_reinforce.policies.linear import LinearPolicy
from sb3_reinforce.sampling.candidate_actors import LoopActor, MatrixActor, make_candidate_actor
from sb3_reinforce.sampling.candidates import evaluate_candidates
from sb3_reinforce.sampling.normalization import unscaled

# Python warns of fork beside threads; other start methods import PyTorch, which takes seconds
pytestmark = pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")

BOX = spaces.Box(-1, 1, (3,))
IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)
ACTIONS = [
    spaces.Box(-0.2, 0.3, (2,)),
    spaces.Discrete(3),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary(4),
]
K = 4


POLICIES = [
    (LinearPolicy, BOX, {}, MatrixActor),
    (ActorCriticPolicy, BOX, {}, MatrixActor),
    (ActorCriticPolicy, BOX, dict(activation_fn=th.nn.GELU), MatrixActor),
    (ActorCriticPolicy, BOX, dict(activation_fn=th.nn.PReLU), LoopActor),
    (ActorCriticPolicy, BOX, dict(activation_fn=lambda: th.nn.Softmax(dim=1)), LoopActor),
    (ActorCriticPolicy, BOX, dict(features_extractor_class=Scaled), LoopActor),
    (ActorCriticPolicy, spaces.Discrete(5), {}, MatrixActor),
    (ActorCriticPolicy, spaces.Box(-1, 1, (2, 3)), dict(share_features_extractor=False), MatrixActor),
    (ActorCriticPolicy, spaces.Box(0, 255, (3,), np.uint8), {}, MatrixActor),
    (ActorCriticPolicy, spaces.Box(-1, 1, (3,), np.float64), {}, MatrixActor),
    (ActorCriticPolicy, IMAGE, {}, MatrixActor),
    (ActorCriticCnnPolicy, IMAGE, {}, LoopActor),
    (MultiInputActorCriticPolicy, spaces.Dict({"a": BOX, "b": spaces.Discrete(2)}), {}, MatrixActor),
    (MultiInputActorCriticPolicy, spaces.Dict({"a": BOX, "b": IMAGE}), {}, LoopActor),
    (OwnPrediction, BOX, {}, LoopActor),
    (ActorCriticPolicy, BOX, dict(use_sde=True, squash_output=True), LoopActor),
]


def sample(space, n):
    space.seed(0)
    return stack([space.sample() for _ in range(n)])


def perturbed(policy, k):
    actor = parameters.searched_parameters(policy)
    theta = parameters.read(actor)
    generator = th.Generator().manual_seed(0)
    return actor, theta + 0.3 * th.randn(k, len(theta), dtype=th.float64, generator=generator)


def check_side_by_side_is_one_by_one(policy, expected=None):
    actor, thetas = perturbed(policy, K)
    obs, before = sample(policy.observation_space, K), {name: p.clone() for name, p in policy.state_dict().items()}
    together = make_candidate_actor(policy, actor, K, deterministic=True)
    assert expected is None or type(together) is expected
    # In two parts, and the first part twice, as environments are refilled
    together.assign([0, 2], thetas[[1, 2]])
    together.assign([0, 1, 3], thetas[[0, 1, 3]])
    batched = together.act(obs)
    assert all(th.equal(value, before[name]) for name, value in policy.state_dict().items())
    for i in range(K):
        parameters.write(actor, thetas[i])
        alone, _ = policy.predict(take(obs, i), deterministic=True)
        np.testing.assert_allclose(batched[i], alone + getattr(policy.action_space, "start", 0), rtol=1e-4, atol=1e-5)
        assert policy.action_space.contains(batched[i].astype(policy.action_space.dtype))


# Each policy with one kind of actions, and each kind of actions with one policy of either actor
CASES = [*product(POLICIES, ACTIONS[:1]), *product((POLICIES[1], POLICIES[5]), ACTIONS[1:])]


@pytest.mark.parametrize(("policy", "actions"), CASES)
def test_side_by_side_is_one_by_one(policy, actions):
    policy_class, obs_space, kwargs, expected = policy
    th.manual_seed(0)
    check_side_by_side_is_one_by_one(policy_class(obs_space, actions, lambda _: 1e-3, **kwargs), expected)


@pytest.mark.parametrize("change", CHANGES)
def test_what_a_user_changes_in_a_policy_changes_its_candidates(change):
    th.manual_seed(0)
    policy = ActorCriticPolicy(BOX, spaces.Discrete(7), lambda _: 1e-3, net_arch=[16])
    CHANGES[change](policy)
    check_side_by_side_is_one_by_one(policy)


def test_an_error_in_prediction_leaves_the_policy_as_it_was():
    policy = OwnPrediction(BOX, spaces.Discrete(3), lambda _: 1e-3)
    actor, thetas = perturbed(policy, K)
    before = parameters.read(actor)
    together = make_candidate_actor(policy, actor, K, deterministic=True)
    together.assign(range(K), thetas)
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        together.act(np.zeros((K, 5), dtype=np.float32))
    assert th.equal(parameters.read(actor), before)


@pytest.mark.parametrize("temperature", [1, 3])
@pytest.mark.parametrize("actions", ACTIONS, ids=str)
def test_stochastic_candidates_sample_the_policy(actions, temperature):
    n = 4000
    policy = ActorCriticPolicy(BOX, actions, lambda _: 1e-3)
    if not isinstance(actions, spaces.Box):
        set_temperature(policy, temperature)
    actor, thetas = perturbed(policy, 1)
    together = make_candidate_actor(policy, actor, n, deterministic=False)
    together.assign(range(n), thetas.expand(n, -1))
    obs = sample(BOX, 1).repeat(n, axis=0)
    drawn = together.act(obs).reshape(n, -1).astype(float)
    parameters.write(actor, thetas[0])
    expected = policy.predict(obs, deterministic=False)[0].reshape(n, -1) + np.array(getattr(actions, "start", 0))
    assert (drawn.std(0) > 0).all()
    error = (drawn.var(0) / n + expected.var(0) / n) ** 0.5
    assert (np.abs(drawn.mean(0) - expected.mean(0)) < 5 * error).all()


class Counting(gym.Env):
    """Ends after as many steps as its first action says; its observation is a random number and a 1."""

    observation_space, action_space = spaces.Box(-1, 1, (2,)), spaces.Box(0, 1, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.draw = 0, self.np_random.uniform(-1, 1)
        return np.array([self.draw, 1], dtype=np.float32), {}

    def step(self, action):
        self.steps += 1
        # Dynamics that draw random numbers, so that how long an episode is changes what follows
        self.np_random.uniform()
        length = 1 + round(float(action[0]) * 10)
        return np.array([self.draw, 1], dtype=np.float32), 1.0, self.steps >= length, False, {}


def evaluate(env, lengths, seeds=None, n_episodes=1, max_episode_steps=100):
    """The returns and steps of linear policies, of which candidate i ends its episodes after ``lengths[i]`` steps."""
    policy = LinearPolicy(env.observation_space, Counting.action_space, lambda _: 1e-3)
    actor = make_candidate_actor(policy, parameters.searched_parameters(policy), env.num_envs, True)
    # The last observation is 1
    thetas = th.zeros(len(lengths), *env.observation_space.shape).double()
    thetas[:, -1] = (th.tensor(lengths) - 1) / 10
    steps = []
    return evaluate_candidates(actor, env, thetas, seeds, n_episodes, max_episode_steps, steps.append), steps


@pytest.mark.parametrize("seeded", [True, False])
@pytest.mark.parametrize("n_envs", [1, 3, 8])
def test_every_candidate_has_exactly_its_episodes(n_envs, seeded):
    lengths, n_episodes = [1, 9, 2, 5, 1], 2
    seeds = np.arange(10).reshape(5, 2) if seeded else None
    returns, steps = evaluate(make_vec_env(Counting, n_envs), lengths, seeds, n_episodes)
    np.testing.assert_array_equal(returns, np.repeat(np.array(lengths)[:, None], 2, axis=1))
    ended = Counter(step.infos[i]["episode"]["l"] for step in steps for i in np.flatnonzero(step.finished))
    assert ended == Counter(lengths * n_episodes)


def test_a_queue_without_rounds_leaves_no_environment_idle_while_it_lasts():
    _, steps = evaluate(make_vec_env(Counting, 3), [9] + [3] * 6)
    # 27 steps of candidates in three environments
    assert len(steps) == 9


WRAPPERS = {
    "DummyVecEnv": lambda: DummyVecEnv([Counting] * 3),
    "SubprocVecEnv": lambda: SubprocVecEnv([Counting] * 3, start_method="fork"),
    "VecNormalize": lambda: VecNormalize(DummyVecEnv([Counting] * 3), training=False),
    "VecFrameStack": lambda: VecFrameStack(DummyVecEnv([Counting] * 3), 2),
}


@pytest.mark.parametrize("name", WRAPPERS)
def test_equal_seeds_are_equal_starts_in_every_environment_and_at_every_time(name):
    env = WRAPPERS[name]()
    first = start_episodes(env, np.array([11, 11, 12]))
    for _ in range(5):
        env.step(np.zeros((3, 1), dtype=np.float32))
    second = start_episodes(env, np.array([12, 11, 13]))
    env.close()
    assert np.array_equal(first[0], first[1]) and np.array_equal(first[0], second[1])
    assert np.array_equal(first[2], second[0])
    assert len({row.tobytes() for row in (first[0], first[2], second[2])}) == 3


@pytest.mark.parametrize("name", WRAPPERS)
def test_pending_seeds_do_not_keep_candidates_from_sharing_a_start(name):
    env = WRAPPERS[name]()
    env.seed(0)
    _, steps = evaluate(env, [3] * 6, np.full((6, 1), 11))
    env.close()
    first, second = steps[0].new_obs, steps[3].new_obs
    assert np.array_equal(first, second) and (first == first[0]).all()


class OwnGenerator(Counting):
    """Draws from a generator that its seed does not reach."""

    np_random = np.random.default_rng(0)


def test_environments_that_do_not_start_alike_from_equal_seeds_are_named():
    seeds = np.array([[7], [7], [8]])
    # With one environment in two rounds
    for n_envs in (1, 3):
        with pytest.warns(UserWarning, match="Common random numbers do not reduce the noise"):
            evaluate(DummyVecEnv([OwnGenerator] * n_envs), [2] * 3, seeds)
    # No two have the same seed
    evaluate(DummyVecEnv([OwnGenerator] * 2), [2] * 2, seeds[1:])
    evaluate(DummyVecEnv([OwnGenerator] * 3), [2] * 3)


def test_large_finite_numbers_are_no_error():
    class Large(Counting):
        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, 1e30, *rest

    assert evaluate(make_vec_env(Large, 1), [2])[0][0, 0] == pytest.approx(2e30)


@pytest.mark.parametrize("seeded", [True, False])
def test_an_episode_that_does_not_end_is_named(seeded):
    seeds = np.zeros((3, 1), dtype=int) if seeded else None
    env = make_vec_env(Counting, 2)
    with pytest.raises(ValueError, match="An episode has not ended after max_episode_steps=8 steps"):
        evaluate(env, [2, 3, 9], seeds, max_episode_steps=8)
    evaluate(env, [2, 3, 9], seeds, max_episode_steps=9)


class Shifted(Wrapper):
    """Changes rewards."""

    def step_wait(self):
        obs, rewards, dones, infos = super().step_wait()
        return obs, rewards - 2.0, dones, infos


class Monitored(VecMonitor):
    """A subclass with the steps of a wrapper that leaves rewards alone."""


def halved(env):
    """A VecNormalize that makes 0.5 of a reward of 1."""
    return VecNormalize(env, training=False, norm_obs=False, clip_reward=0.5)


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [
        (lambda env: NumericEnds(env), 1.0),
        (lambda env: Shifted(env), -1.0),
        (lambda env: VecFrameStack(halved(Shifted(env)), 2), -1.0),
        (lambda env: halved(halved(Shifted(env))), -1.0),
        (lambda env: Shifted(halved(env)), -1.0),
        (lambda env: Monitored(halved(Shifted(env))), -1.0),
    ],
)
def test_the_rewards_are_those_of_all_wrappers_without_any_scaling_by_vec_normalize(wrap, expected):
    """One step of reward 1."""
    assert evaluate(wrap(DummyVecEnv([Counting])), [1])[0][0, 0] == pytest.approx(expected)


class WithIndices(Wrapper):
    """Passes the indices on to the environments, as Isaac Lab's VecEnv does."""

    def env_method(self, name, *args, **kwargs):
        return [getattr(env, name)(*args, **kwargs) for env in self.venv.envs]


def test_environments_that_do_not_know_indices_cannot_be_seeded():
    model = FiniteDifference("LinearPolicy", WithIndices(make_vec_env("CartPole-v1", 2)), device="cpu")
    with pytest.raises(ValueError, match="Episodes can start from given seeds only where"):
        model.learn(1)


class WrongSeed(Counting):
    """Fails where it is reset with a seed."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            raise TypeError("a mistake in reset")
        return super().reset(seed=seed)


def test_an_error_of_a_seeded_reset_is_the_users_own():
    model = FiniteDifference("LinearPolicy", DummyVecEnv([WrongSeed]), device="cpu")
    with pytest.raises(TypeError, match="a mistake in reset"):
        model.learn(1)


def test_vec_normalize_scales_rewards_again_after_a_step_that_fails():
    env = halved(DummyVecEnv([Counting]))
    with pytest.raises(KeyboardInterrupt), unscaled(env):
        assert not env.norm_reward
        raise KeyboardInterrupt
    assert env.norm_reward


@pytest.mark.parametrize("deterministic", [True, False])
def test_candidates_that_need_no_noise_of_gsde_draw_none(deterministic):
    policy = ActorCriticPolicy(BOX, spaces.Box(-1, 1, (2,)), lambda _: 1e-3, use_sde=True)
    together = make_candidate_actor(policy, parameters.searched_parameters(policy), 2, deterministic)
    generator = th.get_rng_state()
    together.act(np.ones((2, 3), dtype=np.float32))
    assert th.equal(th.get_rng_state(), generator) == deterministic
