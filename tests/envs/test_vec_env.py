"""A vector environment behind the adapter makes the transitions of a DummyVecEnv, step by step."""

import gymnasium as gym
import numpy as np
import pytest
from environments import Corridor, Random, native
from gymnasium import spaces
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorWrapper
from gymnasium.wrappers import TransformAction, TransformReward
from gymnasium.wrappers.vector import NormalizeReward, RecordEpisodeStatistics
from models import make
from packaging.version import Version
from stable_baselines3 import A2C
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import landscape
from sb3_reinforce.envs.vec_env import GymnasiumVecEnv

N_ENVS = 3


def synced(env_fn, mode="SameStep", vector_env=SyncVectorEnv, **kwargs):
    return GymnasiumVecEnv(vector_env([env_fn] * N_ENVS, autoreset_mode=mode, **kwargs))


def step(env):
    return env.step(np.zeros(N_ENVS, int))


both_modes = pytest.mark.parametrize("mode", ["SameStep", "Disabled"])


class Dicts(gym.ObservationWrapper):
    """Observations in a dict, and infos with its keys, at resets too."""

    n_resets = 0

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Dict({"obs": env.observation_space})

    def observation(self, obs):
        return {"obs": obs}

    def step(self, action):
        obs, reward, terminated, truncated, _ = super().step(action)
        infos = {"height": 3.5, "_own": 2, "goal": {"place": {"x": float(obs["obs"].sum()), "at": np.zeros(2)}}}
        infos["visits"] = {0: 1.5}
        return obs, reward, terminated, truncated, infos | ({"last": True} if terminated else {})

    def reset(self, *, seed=None, options=None):
        obs, info = super().reset(seed=seed, options=options)
        self.n_resets += 1
        return obs, {**info, "n_resets": self.n_resets, **(options or {})}


@both_modes
@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("wrapper", [lambda env: env, Dicts], ids=["array", "dict"])
@pytest.mark.parametrize("copy", [True, False])
def test_every_transition_is_that_of_a_dummy_vec_env_and_stays_as_it_was(mode, truncate, wrapper, copy):
    """Also where the vector environment writes all its observations into one array; seeds and options are used once."""

    def env_fn():
        return wrapper(Corridor((2, 3, 5), reward=lambda t, action: t + 10.0 * action, truncate=truncate))

    ours, theirs = synced(env_fn, mode, copy=copy), DummyVecEnv([env_fn] * N_ENVS)
    for env in (ours, theirs):
        env.seed(7)
        env.set_options({"level": 2})
    returned, rng, n_dones = [], np.random.default_rng(0), 0
    for _ in range(4):
        returned.append((ours.reset(), theirs.reset()))
        assert ours.reset_infos == theirs.reset_infos
    for _ in range(60):
        actions = rng.integers(2, size=N_ENVS)
        returned += zip(ours.step(actions), theirs.step(actions), strict=True)
        n_dones += returned[-2][0].sum()
        assert ours.reset_infos == theirs.reset_infos
    assert n_dones > 30
    for one, other in returned:
        np.testing.assert_equal(one, other)
        assert getattr(one, "dtype", None) == getattr(other, "dtype", None)


def test_every_transition_of_the_native_cart_pole_is_that_of_the_single_one():
    """Started from the same states, over terminations and truncations; a new episode starts where the reset says."""
    ours = native(N_ENVS, max_episode_steps=30)
    obs = ours.reset()
    singles = [gym.make("CartPole-v1").unwrapped for _ in range(N_ENVS)]
    steps, ends, rng = np.zeros(N_ENVS, dtype=int), {True: 0, False: 0}, np.random.default_rng(1)

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
            assert rewards[i] == reward and dones[i] == (terminated or steps[i] >= 30)
            assert infos[i]["TimeLimit.truncated"] == (steps[i] >= 30 and not terminated)
            np.testing.assert_allclose(infos[i].get("terminal_observation", obs[i]), expected, rtol=1e-6)
            if dones[i]:
                ends[terminated] += 1
                assert np.abs(obs[i]).max() <= 0.05
                align(i)
    assert min(ends.values()) > 5


def test_options_must_be_the_same_for_all_copies():
    env = synced(Corridor)
    for options in ({"level": np.array(["first"]), "scale": np.nan}, [{"level": np.zeros(2)} for _ in range(N_ENVS)]):
        env.set_options(options)
        env.reset()
    env.set_options([{"level": np.full(2, 10**6 + i)} for i in range(N_ENVS)])
    with pytest.raises(ValueError, match="set_options"):
        env.reset()


def test_an_environment_that_does_not_return_the_last_observation_is_refused():
    class Forgetful(SyncVectorEnv):
        def step(self, actions):
            *rest, infos = super().step(actions)
            infos.pop("final_obs", None)
            return *rest, infos

    env = synced(lambda: Corridor((1,)), vector_env=Forgetful)
    env.reset()
    with pytest.raises(ValueError, match="final_obs"):
        step(env)


def test_a_late_autoreset_is_refused():
    with pytest.raises(ValueError, match=r"autoreset_mode.*SAME_STEP"):
        synced(Corridor, "NextStep")
    with pytest.raises(TypeError, match="VectorEnv"):
        GymnasiumVecEnv(gym.make("CartPole-v1"))


@pytest.mark.parametrize("algorithm", [REINFORCE, A2C])
def test_algorithms_train_on_it(algorithm):
    env = VecNormalize(VecMonitor(native(8)))
    model = algorithm("MlpPolicy", env, n_steps=32, seed=0, device="cpu").learn(1024)
    assert len(model.ep_info_buffer) > 5 and all(info["l"] == info["r"] for info in model.ep_info_buffer)


def test_attributes_and_methods_where_the_environment_can():
    env = synced(Corridor)
    assert env.get_attr("lengths") == [(3,)] * N_ENVS and env.get_attr("lengths", 1) == [(3,)]
    env.set_attr("truncate", True)
    assert env.get_attr("truncate") == [True] * N_ENVS
    env.set_attr("lengths", (4, 7))
    assert env.get_attr("lengths") == [(4, 7)] * N_ENVS and callable(env.get_attr("observe")[0])
    assert len(env.env_method("observe")) == N_ENVS and len(env.env_method("observe", indices=[2])) == 1
    assert env.env_is_wrapped(gym.Wrapper) == [False] * N_ENVS and env.has_attr("lengths")
    wrapped = synced(lambda: gym.wrappers.TimeLimit(Corridor(), 9))
    assert wrapped.env_is_wrapped(gym.wrappers.TimeLimit, indices=[0, 2]) == [True, True]
    for indices in ([0], [0] * N_ENVS):
        with pytest.raises(ValueError, match="indices"):
            env.set_attr("truncate", True, indices=indices)
    assert native(N_ENVS).get_attr("max_episode_steps") == [500] * N_ENVS
    below = CartPoleVectorEnv(N_ENVS)
    below.metadata = below.metadata | {"autoreset_mode": AutoresetMode.SAME_STEP}
    assert GymnasiumVecEnv(VectorWrapper(below)).get_attr("max_episode_steps") == [500] * N_ENVS
    with pytest.raises(NotImplementedError, match="single copies"):
        native(N_ENVS).env_method("render")
    env = synced(Corridor, vector_env=AsyncVectorEnv)
    assert env.env_method("has_wrapper_attr", "lengths") == [True] * N_ENVS
    for indices in ([0], [1, 0, 2], [0, 0, 0]):
        with pytest.raises(NotImplementedError):
            env.env_method("has_wrapper_attr", "lengths", indices=indices)
    assert env.has_attr("lengths") and not env.has_attr("missing") and len(env.reset()) == N_ENVS
    env.close()


@pytest.mark.parametrize("vector_env", [SyncVectorEnv, AsyncVectorEnv])
def test_evaluation_finds_a_monitor(vector_env):
    """Below a wrapper that changes rewards it has those of the task."""
    env = synced(lambda: TransformReward(Monitor(Corridor((3,))), lambda reward: reward + 10), vector_env=vector_env)
    assert env.env_is_wrapped(Monitor) == [True] * N_ENVS and env.env_is_wrapped(TransformAction) == [False] * N_ENVS
    returns, lengths = evaluate_policy(make("steps", env), env, N_ENVS, return_episode_rewards=True)
    assert lengths == [3] * N_ENVS and max(returns) < 10
    env.close()


def test_finite_difference_trains_on_it():
    """With seeded starts where there are single copies to seed; elsewhere an error says what to set."""
    for env, is_seeded in ((synced(Corridor), True), (native(N_ENVS), False)):
        model = FiniteDifference("LinearPolicy", env, n_delta=12, common_random_numbers=is_seeded, seed=0)
        assert model.learn(50)._n_updates > 0
    with pytest.raises(ValueError, match="common_random_numbers=False"):
        FiniteDifference("LinearPolicy", native(N_ENVS), n_delta=12).learn(50)


def test_pictures_in_one_array():
    env = synced(Corridor)
    env.env.render = lambda: np.zeros((N_ENVS, 4, 4, 3))
    assert [picture.shape for picture in env.get_images()] == [(4, 4, 3)] * N_ENVS
    env.env.render = lambda: None
    assert env.get_images() == [None] * N_ENVS


def test_pictures():
    pytest.importorskip("pygame")
    env = synced(lambda: gym.make("CartPole-v1", render_mode="rgb_array"))
    env.reset()
    assert len(env.get_images()) == N_ENVS and env.get_images()[0].ndim == 3 and env.render().ndim == 3
    env.close()


class Malformed(SyncVectorEnv):
    """Returns ``change`` of the observations and rewards of its tenth step."""

    change = staticmethod(lambda obs, rewards: (obs, rewards))
    n_steps = 0

    def step(self, actions):
        obs, rewards, *rest = super().step(actions)
        self.n_steps += 1
        return *(self.change(obs, rewards) if self.n_steps == 10 else (obs, rewards)), *rest


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda obs, rewards: (obs[:, :3], rewards), r"observation of environment 0 must have shape \(4,\)"),
        (lambda obs, rewards: (obs.reshape(4, 3), rewards), "must be observations of 3 environments"),
        (lambda obs, rewards: (obs[:1], rewards), "must be observations of 3 environments"),
        (lambda obs, rewards: (obs + 1j, rewards), "dtype"),
        (lambda obs, rewards: (obs, rewards[:, None]), "rewards must be 3 numbers"),
        (lambda obs, rewards: (obs, rewards[:1]), "rewards must be 3 numbers"),
        (lambda obs, rewards: (obs, rewards + 1j), "rewards must be 3 numbers"),
    ],
)
def test_malformed_steps_are_named(change, message):
    env = synced(lambda: gym.make("CartPole-v1"), vector_env=Malformed)
    env.env.change = change
    model = make("steps", VecNormalize(env), n_steps=16)
    with pytest.raises(ValueError, match=rf"{message}.*num_timesteps=27\)"):
        model.learn(100)
    assert model.learn(100).num_timesteps >= 100


class Fractions(SyncVectorEnv):
    """Returns fractions at each reset, or only at those by a mask."""

    def __init__(self, *args, at_first, **kwargs):
        self.at_first = at_first
        super().__init__(*args, **kwargs)

    def reset(self, *, seed=None, options=None):
        # Gymnasium takes the mask out of the options
        is_wrong = self.at_first or bool(options)
        obs, infos = super().reset(seed=seed, options=options)
        return (obs + 0.5 if is_wrong else obs), infos


@pytest.mark.parametrize("at_first", [True, False])
def test_malformed_observations_of_resets_are_named(at_first):
    space = spaces.Box(0, 255, (4,), np.uint8)
    env = synced(lambda: Random(space), "Disabled", Fractions, at_first=at_first)
    with pytest.raises(ValueError, match=r"observation of environment 0 must have .* that fits uint8"):
        make("steps", env).learn(100)


class Noted(SyncVectorEnv):
    """Returns more than its space has."""

    def reset(self, **kwargs):
        obs, infos = super().reset(**kwargs)
        return obs | {"note": 3.0}, infos

    def step(self, actions):
        obs, *rest = super().step(actions)
        return obs | {"note": 3.0}, *rest


@both_modes
def test_what_a_dict_has_besides_its_space_is_left_out(mode):
    space = spaces.Dict({"x": spaces.Box(-1, 1, (2,))})
    env = synced(lambda: Random(space), mode, Noted)
    assert env.reset().keys() == {"x"}
    for _ in range(5):
        obs, _, dones, infos = step(env)
        assert obs.keys() == {"x"}
    assert dones.all() and all(info["terminal_observation"].keys() == {"x"} for info in infos)
    assert REINFORCE("MultiInputPolicy", env, device="cpu").learn(64).num_timesteps >= 64


class Numbers(SyncVectorEnv):
    """Ends episodes by numbers, and resets copies as vectorized environments do, by a mask of an array."""

    def step(self, actions):
        obs, rewards, terminated, truncated, infos = super().step(actions)
        return obs, rewards, terminated.astype(int).tolist(), truncated.astype(int), infos

    def reset(self, *, seed=None, options=None):
        if options is not None:
            # Which copies the mask selects, if it is used as an index
            wanted = np.zeros(self.num_envs, dtype=bool)
            wanted[options["reset_mask"]] = True
            options = {"reset_mask": wanted}
        return super().reset(seed=seed, options=options)


def test_episodes_may_end_by_numbers():
    plain, numbers = [
        synced(lambda: Corridor((2, 3, 5)), "Disabled", vector_env) for vector_env in (SyncVectorEnv, Numbers)
    ]
    for env in (plain, numbers):
        env.seed(0)
        env.reset()
    for _ in range(30):
        for ours, theirs in zip(step(numbers)[:3], step(plain)[:3], strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("form", [list, lambda obs: obs.astype(np.float64)])
def test_other_forms_of_observations_are_accepted(form):
    env = synced(lambda: gym.make("CartPole-v1"), vector_env=Malformed)
    env.env.change = lambda obs, rewards: (form(obs), rewards)
    assert make("steps", env).learn(100).num_timesteps >= 100


@pytest.mark.parametrize(
    ("space", "added", "message"),
    [
        (spaces.Box(0, 255, (4,), np.uint8), 0.5, "must have .* that fits uint8"),
        (spaces.MultiDiscrete([2, 3]), 9, "must be in MultiDiscrete"),
    ],
)
def test_each_row_of_other_numbers_is_checked(space, added, message):
    env = synced(lambda: Random(space), vector_env=Malformed)
    env.env.change = lambda obs, rewards: (obs.astype(np.float32), rewards)
    assert make("steps", env).learn(100).num_timesteps >= 100
    env.env.n_steps, env.env.change = 0, lambda obs, rewards: (obs + np.array([[0], [added], [0]]), rewards)
    with pytest.raises(ValueError, match=f"observation of environment 1 {message}"):
        make("steps", env).learn(100)


@pytest.mark.skipif(Version(gym.__version__) < Version("1.4"), reason="Gymnasium counts a step too few")
def test_episodes_that_gymnasium_records():
    """Also where one ends while another goes on."""
    modes = (AutoresetMode.SAME_STEP, AutoresetMode.DISABLED)
    recorders = [
        RecordEpisodeStatistics(SyncVectorEnv([lambda: Corridor((2, 3, 5))] * N_ENVS, autoreset_mode=mode))
        for mode in modes
    ]
    with pytest.raises(ValueError, match="wrap the GymnasiumVecEnv in VecMonitor"):
        GymnasiumVecEnv(recorders[1])
    env = GymnasiumVecEnv(recorders[0])
    env.seed(0)
    env.reset()
    lengths, recorded = np.zeros(N_ENVS, dtype=int), []
    for _ in range(60):
        _, _, dones, infos = step(env)
        lengths += 1
        recorded += [(infos[i]["episode"]["l"], infos[i]["episode"]["r"], lengths[i]) for i in np.flatnonzero(dones)]
        lengths[dones] = 0
    assert len(recorded) > 30 and all(length == reward == steps for length, reward, steps in recorded)
    assert len(make("steps", env).learn(24).ep_info_buffer) >= 3


@both_modes
def test_copies_in_other_processes_start_from_the_same_seeds(mode):
    """By which a search compares its candidates."""

    def env_fn():
        return Corridor((2, 3, 5), reward=lambda t, action: t + 10.0 * action)

    thetas, utilities = [], []
    for vector_env in (SyncVectorEnv, AsyncVectorEnv):
        env = synced(env_fn, mode, vector_env)
        model = FiniteDifference("LinearPolicy", env, n_delta=11, seed=0).learn(60)
        thetas.append(model.theta)
        utilities.append(landscape(model, n_points=3, n_episodes=2).utilities)
        env.close()
    assert thetas[0].equal(thetas[1]) and np.array_equal(*utilities)


@both_modes
def test_environments_of_one_class_with_different_modes(mode, monkeypatch):
    """Their class shares one metadata, which Gymnasium has let the last of them write its mode to."""
    env = SyncVectorEnv([lambda: Corridor((1,))] * N_ENVS, autoreset_mode=mode)
    monkeypatch.setitem(env.metadata, "autoreset_mode", AutoresetMode.NEXT_STEP)
    adapter = GymnasiumVecEnv(env)
    adapter.reset()
    # Each step is a whole episode, with no step in between that only resets
    assert all(step(adapter)[2].all() for _ in range(3))


def test_only_gymnasiums_own_cart_pole_is_reset_within_the_step():
    own = type("Own", (CartPoleVectorEnv,), {})
    for env in (own(N_ENVS), VectorWrapper(CartPoleVectorEnv(N_ENVS))):
        with pytest.raises(ValueError, match=r"autoreset_mode.*SAME_STEP"):
            GymnasiumVecEnv(env)


@pytest.mark.parametrize("wrapper", [lambda env: env, VectorWrapper])
def test_a_wrapper_that_forgets_the_episodes_that_go_on_is_refused(wrapper):
    env = SyncVectorEnv([lambda: Corridor((2, 3, 5))] * N_ENVS, autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(ValueError, match="wrap the GymnasiumVecEnv in VecNormalize"):
        GymnasiumVecEnv(wrapper(NormalizeReward(env)))


def test_a_malformed_last_observation_is_named():
    class Cut(SyncVectorEnv):
        def step(self, actions):
            *rest, infos = super().step(actions)
            if "final_obs" in infos:
                infos["final_obs"][1] = infos["final_obs"][1][:1]
            return *rest, infos

    env = synced(lambda: Corridor((2,), truncate=True), vector_env=Cut)
    with pytest.raises(ValueError, match=r"observation of environment 1 must have shape \(2,\)"):
        make("steps", env).learn(16)
