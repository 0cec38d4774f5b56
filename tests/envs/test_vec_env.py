"""Transitions of a vector environment through the adapter, held against those of a DummyVecEnv step by step."""

import gymnasium as gym
import numpy as np
import pytest
from environments import Corridor
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import landscape
from sb3_reinforce.envs.vec_env import GymnasiumVecEnv

N_ENVS = 3


def native(n_envs=N_ENVS, **kwargs):
    return GymnasiumVecEnv(gym.make_vec("CartPole-v1", n_envs, vectorization_mode="vector_entry_point", **kwargs))


def synced(env_fn, mode, n_envs=N_ENVS):
    return GymnasiumVecEnv(SyncVectorEnv([env_fn] * n_envs, autoreset_mode=mode))


class Dicts(gym.ObservationWrapper):
    """Observations in a dict, with a key of its own in the infos."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"obs": env.observation_space})

    def observation(self, obs):
        return {"obs": obs}

    def step(self, action):
        obs, reward, terminated, truncated, _ = super().step(action)
        infos = {"height": 3.5, "_own": 2, "goal": {"place": {"x": float(obs["obs"].sum()), "at": np.zeros(2)}}}
        return obs, reward, terminated, truncated, infos | ({"last": True} if terminated else {})

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed, options=options)
        return obs, {**info, "started": 1.5, **(options or {})}


def assert_same(one, other):
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("wrapper", [lambda env: env, Dicts], ids=["array", "dict"])
def test_every_transition_is_that_of_a_dummy_vec_env(mode, truncate, wrapper):
    """Over many episodes of different lengths: observations, rewards, dones, terminal observations and infos."""

    def env_fn():
        return wrapper(Corridor((2, 3, 5), reward=lambda t, action: t + 10.0 * action, truncate=truncate))

    ours, theirs = synced(env_fn, mode), DummyVecEnv([env_fn] * N_ENVS)
    for env in (ours, theirs):
        env.seed(7)
    assert_same(ours.reset(), theirs.reset())
    rng, n_dones = np.random.default_rng(0), 0
    for _ in range(60):
        actions = rng.integers(2, size=N_ENVS)
        (obs, rewards, dones, infos), (obs_, rewards_, dones_, infos_) = ours.step(actions), theirs.step(actions)
        assert_same(obs, obs_)
        assert_same(rewards, rewards_)
        assert_same(dones, dones_)
        assert rewards.dtype == rewards_.dtype
        for info, info_ in zip(infos, infos_, strict=True):
            assert_same(info, info_)
        n_dones += dones.sum()
    assert n_dones > 30


def test_every_transition_of_the_native_cart_pole_is_that_of_the_single_one():
    """Started from the same states, over terminations and truncations; a new episode starts where the reset says."""
    ours, theirs = native(max_episode_steps=30), make_vec_env("CartPole-v1", N_ENVS)
    for env in theirs.envs:
        env.unwrapped.reset()
        env.get_wrapper_attr("_max_episode_steps")
    ours.seed(0)
    obs = ours.reset()
    singles = [env.unwrapped for env in theirs.envs]
    steps = np.zeros(N_ENVS, dtype=int)
    ends = {"terminated": 0, "truncated": 0}
    rng = np.random.default_rng(1)

    def align(i):
        singles[i].reset()
        singles[i].state = ours.env.state[:, i].copy()
        steps[i] = 0

    for i in range(N_ENVS):
        align(i)
    for _ in range(400):
        # Balancing one of them lives until the time limit, the others fall
        actions = np.where(np.arange(N_ENVS) == 0, obs[:, 2] + obs[:, 3] > 0, rng.integers(2, size=N_ENVS)).astype(int)
        obs, rewards, dones, infos = ours.step(actions)
        steps += 1
        for i, single in enumerate(singles):
            expected, reward, terminated, _, _ = single.step(actions[i])
            truncated = steps[i] >= 30
            assert dones[i] == (terminated or truncated) and rewards[i] == reward
            assert infos[i]["TimeLimit.truncated"] == (truncated and not terminated)
            last = infos[i]["terminal_observation"] if dones[i] else obs[i]
            np.testing.assert_allclose(last, expected, rtol=1e-6)
            if dones[i]:
                ends["terminated" if terminated else "truncated"] += 1
                assert np.abs(obs[i]).max() <= 0.05
                align(i)
    assert min(ends.values()) > 5


def test_seeds_and_options_are_used_once():
    """As by a DummyVecEnv: the next reset draws on, and its infos are told."""
    ours, theirs = (
        synced(lambda: Dicts(Corridor((2, 3, 5))), "SameStep"),
        DummyVecEnv([lambda: Dicts(Corridor((2, 3, 5)))] * N_ENVS),
    )
    lengths = []
    for env in (ours, theirs):
        env.seed(3)
        env.set_options({"level": 2})
    for _ in range(4):
        assert_same(ours.reset(), theirs.reset())
        assert ours.reset_infos == theirs.reset_infos
        lengths.append(ours.get_attr("length"))
        assert lengths[-1] == theirs.get_attr("length")
    assert len(set(map(tuple, lengths))) > 1 and "level" not in ours.reset_infos[0]
    ours.set_options([{"level": i} for i in range(N_ENVS)])
    with pytest.raises(ValueError, match="set_options"):
        ours.reset()


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_what_was_returned_stays_as_it_was(mode):
    """Also of a vector environment that writes all its observations into one array."""
    shared, own = (
        GymnasiumVecEnv(SyncVectorEnv([lambda: Corridor((2, 3))] * 2, copy=is_copy, autoreset_mode=mode))
        for is_copy in (False, True)
    )
    for env in (shared, own):
        env.seed(0)
    returned = [(shared.reset(), own.reset())]
    for _ in range(20):
        (obs, _, _, infos), (obs_, _, _, infos_) = shared.step(np.zeros(2, int)), own.step(np.zeros(2, int))
        returned += [(obs, obs_)]
        returned += [
            (a["terminal_observation"], b["terminal_observation"])
            for a, b in zip(infos, infos_, strict=True)
            if "terminal_observation" in b
        ]
    assert len(returned) > 30
    for one, other in returned:
        assert_same(one, other)


def test_an_environment_that_does_not_tell_the_last_observation_is_refused():
    class Untold(SyncVectorEnv):
        def step(self, actions):
            *rest, infos = super().step(actions)
            infos.pop("final_obs", None)
            return *rest, infos

    env = GymnasiumVecEnv(Untold([Corridor] * 2, autoreset_mode="SameStep"))
    env.reset()
    with pytest.raises(ValueError, match="final_obs"):
        for _ in range(3):
            env.step(np.zeros(2, int))


def test_a_late_autoreset_is_refused():
    with pytest.raises(ValueError, match=r"autoreset_mode.*SAME_STEP"):
        synced(Corridor, "NextStep")
    with pytest.raises(TypeError, match="VectorEnv"):
        GymnasiumVecEnv(gym.make("CartPole-v1"))


@pytest.mark.parametrize("algorithm", [REINFORCE, PPO, A2C])
def test_algorithms_train_on_it(algorithm):
    env = VecNormalize(VecMonitor(native(8)))
    model = algorithm("MlpPolicy", env, n_steps=32, seed=0, device="cpu").learn(1024)
    assert len(model.ep_info_buffer) > 5 and all(info["l"] == info["r"] for info in model.ep_info_buffer)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_same_seed_gives_the_same_parameters(seed):
    outcomes = [
        REINFORCE("MlpPolicy", native(4), n_steps=16, seed=seed, device="cpu").learn(256).policy.state_dict()
        for _ in range(2)
    ]
    assert all((outcomes[0][name] == outcomes[1][name]).all() for name in outcomes[0])


def test_attributes_and_methods_where_the_environment_can():
    env = synced(Corridor, "SameStep")
    assert env.get_attr("lengths") == [(3,)] * N_ENVS and env.get_attr("lengths", 1) == [(3,)]
    env.set_attr("truncate", True)
    assert env.get_attr("truncate") == [True] * N_ENVS
    env.set_attr("lengths", (4, 7))
    assert env.get_attr("lengths") == [(4, 7)] * N_ENVS and callable(env.get_attr("observe")[0])
    assert len(env.env_method("observe")) == N_ENVS and len(env.env_method("observe", indices=[2])) == 1
    assert env.env_is_wrapped(gym.Wrapper) == [False] * N_ENVS and env.has_attr("lengths")
    with pytest.raises(ValueError, match="indices"):
        env.set_attr("truncate", True, indices=[0])
    assert native().get_attr("max_episode_steps") == [500] * N_ENVS
    with pytest.raises(NotImplementedError, match="single copies"):
        native().env_method("render")


def test_finite_difference_trains_on_it():
    """With seeded starts where there are single copies to seed, and a sentence that says what to set where not."""
    seeded = FiniteDifference("LinearPolicy", synced(Corridor, "SameStep"), n_delta=12, seed=0).learn(50)
    unseeded = FiniteDifference("LinearPolicy", native(), n_delta=12, common_random_numbers=False, seed=0).learn(50)
    assert seeded._n_updates > 0 and unseeded._n_updates > 0
    with pytest.raises(ValueError, match="common_random_numbers=False"):
        FiniteDifference("LinearPolicy", native(), n_delta=12).learn(50)


def test_pictures():
    pytest.importorskip("pygame")
    env = GymnasiumVecEnv(
        SyncVectorEnv([lambda: gym.make("CartPole-v1", render_mode="rgb_array")] * 2, autoreset_mode="SameStep")
    )
    env.reset()
    assert len(env.get_images()) == 2 and env.get_images()[0].ndim == 3 and env.render().ndim == 3
    env.close()


class Malformed(SyncVectorEnv):
    """At its tenth step, something of another form."""

    change = staticmethod(lambda obs, rewards: (obs, rewards))

    def reset(self, **kwargs):
        self.n_steps = 0
        return super().reset(**kwargs)

    def step(self, actions):
        obs, rewards, *rest = super().step(actions)
        self.n_steps += 1
        return *(self.change(obs, rewards) if self.n_steps == 10 else (obs, rewards)), *rest


@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda obs, rewards: (obs[:, :3], rewards), r"observation of environment 0 must have shape \(4,\)"),
        (lambda obs, rewards: (obs.reshape(4, 3), rewards), "observations must be those of 3 environments"),
        (lambda obs, rewards: (obs[:1], rewards), "observations must be those of 3 environments"),
        (lambda obs, rewards: (obs + 1j, rewards), "dtype"),
        (lambda obs, rewards: (obs, rewards[:, None]), "rewards must be 3 numbers"),
        (lambda obs, rewards: (obs, rewards[:1]), "rewards must be 3 numbers"),
        (lambda obs, rewards: (obs, rewards + 1j), "rewards must be 3 numbers"),
    ],
)
def test_malformed_steps_are_named(change, message, wrapper, monkeypatch):
    monkeypatch.setattr(Malformed, "change", staticmethod(change))
    env = Malformed([lambda: gym.make("CartPole-v1")] * N_ENVS, autoreset_mode="SameStep")
    model = REINFORCE("MlpPolicy", wrapper(GymnasiumVecEnv(env)), n_steps=16, device="cpu")
    with pytest.raises(ValueError, match=f"{message}.*step 9 since"):
        model.learn(100)
    monkeypatch.undo()
    assert model.learn(100).num_timesteps >= 100


@pytest.mark.parametrize("form", [list, lambda obs: obs.astype(np.float64)])
def test_forms_that_stand_for_observations_are_taken(form, monkeypatch):
    monkeypatch.setattr(Malformed, "change", staticmethod(lambda obs, rewards: (form(obs), rewards)))
    env = Malformed([lambda: gym.make("CartPole-v1")] * N_ENVS, autoreset_mode="SameStep")
    assert REINFORCE("MlpPolicy", GymnasiumVecEnv(env), n_steps=16, device="cpu").learn(100).num_timesteps >= 100


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_episodes_that_gymnasium_records(mode):
    """Also where one ends while another goes on."""
    vector_env = SyncVectorEnv([lambda: Corridor((2, 3, 5))] * N_ENVS, autoreset_mode=mode)
    env = GymnasiumVecEnv(RecordEpisodeStatistics(vector_env))
    env.seed(0)
    env.reset()
    lengths, recorded = np.zeros(N_ENVS, dtype=int), []
    for _ in range(60):
        _, _, dones, infos = env.step(np.zeros(N_ENVS, int))
        lengths += 1
        recorded += [(infos[i]["episode"]["l"], infos[i]["episode"]["r"], lengths[i]) for i in np.flatnonzero(dones)]
        lengths[dones] = 0
    assert len(recorded) > 30 and all(length == reward == steps for length, reward, steps in recorded)
    assert len(REINFORCE("MlpPolicy", env, n_steps=8, device="cpu").learn(24).ep_info_buffer) >= 3


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_the_infos_of_a_reset_are_those_of_the_last_one(mode):
    """Reset tells how often it was called."""

    class Counting(Corridor):
        n_resets = 0

        def reset(self, *, seed=None, options=None):
            self.n_resets += 1
            return super().reset(seed=seed)[0], {"n": self.n_resets}

    env = synced(lambda: Counting((4,)), mode)
    env.reset()
    assert [info["n"] for info in env.reset_infos] == [1] * N_ENVS
    for _ in range(4):
        env.step(np.zeros(N_ENVS, int))
    assert [info["n"] for info in env.reset_infos] == [2] * N_ENVS


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_copies_in_other_processes_start_from_the_same_seeds(mode):
    """Which a search compares its candidates by."""

    def env_fn():
        return Corridor((2, 3, 5), reward=lambda t, action: t + 10.0 * action)

    thetas, utilities = [], []
    for vector_env in (SyncVectorEnv, AsyncVectorEnv):
        env = GymnasiumVecEnv(vector_env([env_fn] * N_ENVS, autoreset_mode=mode))
        model = FiniteDifference("LinearPolicy", env, n_delta=11, seed=0).learn(60)
        thetas.append(model.theta)
        utilities.append(landscape(model, n_points=3, n_episodes=2).utilities)
        env.close()
    assert thetas[0].equal(thetas[1]) and np.array_equal(*utilities)


def test_methods_of_copies_in_other_processes():
    env = GymnasiumVecEnv(AsyncVectorEnv([lambda: Corridor((4,))] * 2, autoreset_mode="SameStep"))
    assert env.env_method("has_wrapper_attr", "lengths") == [True] * 2
    for indices in ([0], [1, 0], [0, 0]):
        with pytest.raises(NotImplementedError):
            env.env_method("has_wrapper_attr", "lengths", indices=indices)
    env.close()


@pytest.mark.parametrize("mode", ["SameStep", "Disabled"])
def test_environments_of_one_class_with_different_modes(mode, monkeypatch):
    """Gymnasium has had the mode of the last one in what they share."""
    env = SyncVectorEnv([lambda: Corridor((1,))] * 2, autoreset_mode=mode)
    monkeypatch.setitem(env.metadata, "autoreset_mode", AutoresetMode.NEXT_STEP)
    adapter = GymnasiumVecEnv(env)
    adapter.reset()
    # Each step is a whole episode, with no step in between that only resets
    assert [adapter.step(np.zeros(2, int))[2].tolist() for _ in range(3)] == [[True, True]] * 3
