"""Groups of episodes that share their start."""

import runpy
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import At, Record
from environments import Scales, Wrapper
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import TransformObservation
from models import plain
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_reinforce import REINFORCE, FiniteDifference, GymnasiumVecEnv
from sb3_reinforce.diagnostics import compare_estimators, compare_starts, landscape, sample
from sb3_reinforce.estimation import BASELINES
from sb3_reinforce.estimation.weights import training_batch
from sb3_reinforce.recurrent import RecurrentREINFORCE

ENVS = {
    "DummyVecEnv": lambda: make_vec_env("Pendulum-v1", 6, seed=0),
    "VecNormalize": lambda: VecNormalize(make_vec_env("Pendulum-v1", 6)),
    "GymnasiumVecEnv": lambda: GymnasiumVecEnv(
        gym.make_vec("Pendulum-v1", 6, vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP})
    ),
}


def pendulum(n_envs):
    """Episodes of 20 steps: what matters is where they start."""
    return make_vec_env("Pendulum-v1", n_envs, seed=0, env_kwargs={"max_episode_steps": 20})


def first_observations():
    return Record(lambda model: model.rollout_buffer.observations[0])


@pytest.mark.parametrize("name", ENVS)
def test_groups_share_their_starts_and_rollouts_do_not(name):
    env = ENVS[name]()
    model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=3, seed=0)
    starts = first_observations()
    model.learn(2 * 1200, callback=starts)
    env.close()
    for rows in starts.records:
        assert (rows[:3] == rows[0]).all() and (rows[3:] == rows[3]).all()
    assert len({rows[i].tobytes() for rows in starts.records for i in (0, 3)}) == 4


def test_baselines_compare_within_the_group():
    """Returns 10 x ± 1 of one step: the others of the group are those with the same x."""
    model = REINFORCE(
        "MlpPolicy", DummyVecEnv([lambda: Scales(10.0)] * 8), baseline="time_mean", episodes_per_start=4, seed=1
    ).learn(8)
    rollout = model.rollout
    returns = rollout.returns[0].reshape(2, 4)
    assert returns[0, 0] * returns[1, 0] < 0, "another seed: the starts are equal"
    assert (rollout.groups[0].reshape(2, 4) == th.tensor([[0], [1]])).all()
    assert (returns > 0).any(1).eq((returns > 0).all(1)).all()
    mean = returns.mean(1, keepdim=True).expand(2, 4).flatten()
    th.testing.assert_close(BASELINES["time_mean"](rollout)[0], mean)
    th.testing.assert_close(BASELINES["leave_one_out"](rollout)[0], (4 * mean - rollout.returns[0]) / 3)
    assert ((BASELINES["optimal"](rollout)[0].reshape(2, 4) - returns).abs() <= 2.001).all()


def test_advantages_are_normalized_over_all_groups():
    """A standard deviation of each group would bias the gradient."""
    env = DummyVecEnv([lambda: Scales(10.0)] * 8)
    model = REINFORCE(
        "MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, normalize_advantage=True, seed=3
    ).learn(8)
    raw, normalized = (training_batch(model.rollout, model.rollout_buffer, flag).weights for flag in (False, True))
    first, second = raw.reshape(2, 4).std(1)
    assert abs(first - second) > 0.1, "another seed: the groups have one deviation"
    th.testing.assert_close(normalized, (raw - raw.mean()) / raw.std())


@pytest.mark.parametrize("task", [Scales, "FrozenLake-v1"])
def test_the_same_seed_gives_the_same_run_and_a_saved_model_goes_on(task, tmp_path):
    """Also where all episodes have the same first observation."""

    def run():
        env = make_vec_env(task, 8, seed=0)
        return REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=2, seed=0).learn(80)

    first, second = run(), run()
    assert plain(first.policy.state_dict()) == plain(second.policy.state_dict())
    first.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model", env=make_vec_env(task, 8), restore_random_state=True)
    assert loaded.episodes_per_start == 2
    for model in (first, loaded):
        th.manual_seed(1)
        model.env.seed(1)
        model.learn(80, reset_num_timesteps=False)
    assert plain(loaded.policy.state_dict()) == plain(first.policy.state_dict())


def test_dicts_are_compared_key_by_key():
    box = Scales().observation_space
    space = spaces.Dict({"a": box, "b": box})
    in_dicts = partial(TransformObservation, func=lambda obs: {"a": 0 * obs, "b": obs}, observation_space=space)

    def model_of(**kwargs):
        env = DummyVecEnv([lambda: in_dicts(Scales(**kwargs))] * 4)
        return REINFORCE("MultiInputPolicy", env, baseline="leave_one_out", episodes_per_start=2)

    assert model_of().learn(8).num_timesteps == 8
    with pytest.raises(ValueError, match="cannot share their start"):
        model_of(ignores_seed=True).learn(8)


def test_what_cannot_share_its_start_is_refused():
    env = DummyVecEnv([lambda: Scales(ignores_seed=True)] * 8)
    with pytest.raises(ValueError, match="cannot share their start"):
        REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, seed=0).learn(8)
    for kwargs in ({"n_episodes": 16}, {"n_steps": 8}, {"episodes_per_start": 3}):
        with pytest.raises(ValueError, match=r"episodes_per_start=. needs one whole episode of each environment"):
            REINFORCE("MlpPolicy", env, **{"baseline": "leave_one_out", "episodes_per_start": 4, **kwargs})
    with pytest.raises(ValueError, match=r"a number of environments that 2 divides, got .* and n_envs=1"):
        REINFORCE("MlpPolicy", Scales(), baseline="leave_one_out", episodes_per_start=2)
    with pytest.raises(ValueError, match="compares the episodes of a start"):
        REINFORCE("MlpPolicy", env, episodes_per_start=4)
    with pytest.raises(ValueError, match="compares the episodes of a start"):
        REINFORCE("MlpPolicy", env, baseline=BASELINES["none"], episodes_per_start=4)


def test_what_a_callback_changes_is_checked():
    def change(locals_, globals_):
        locals_["self"].n_episodes = 16
        return True

    env = DummyVecEnv([Scales] * 8)
    model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, seed=0)
    with pytest.raises(ValueError, match="n_episodes=None or 8"):
        model.learn(64, callback=change)


class NoiseFromZero(gym.Env):
    """All episodes start at 0 and take two steps; the second observation is noise."""

    observation_space = spaces.Box(-10.0, 10.0, (1,))
    action_space = spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        self.t += 1
        return self.np_random.normal(size=1).astype(np.float32), 1.0, self.t == 2, False, {}


def test_vec_normalize_counts_each_first_observation_once():
    env = VecNormalize(DummyVecEnv([lambda: Scales(10.0)] * 4))
    model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=2, seed=0, device="cpu")
    counts = Record(lambda model: env.obs_rms.count, "rollout_start")
    model.learn(12, counts)
    # Of each rollout: four first observations, and four after the one step
    assert np.diff(counts.records) == pytest.approx(8)


def test_pending_seeds_are_used_up():
    """A callback seeds the environments, whose first observations say nothing about their seeds."""
    env = DummyVecEnv([NoiseFromZero] * 4)
    model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=2, seed=0)
    second = Record(lambda model: model.rollout_buffer.observations[1].copy())
    model.learn(16, callback=[Record(lambda model: env.seed(3), "rollout_start"), second])
    assert len(second.records) == 2
    for rows in second.records:
        assert rows[0] == rows[1] != rows[2] == rows[3]


@pytest.mark.parametrize("at", ["step", "rollout_end"])
@pytest.mark.parametrize("n_steps", [None, 20])
def test_a_callback_may_turn_groups_off(n_steps, at):
    """The environments are independent from the next rollout on, also where all episodes ended at once."""

    def change(model):
        if model.episodes_per_start > 1:
            model.episodes_per_start = 1
            model.n_steps = n_steps
            model.n_episodes = None if n_steps else 8

    env = pendulum(8)
    model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, seed=0)
    starts = first_observations()
    model.learn(3 * 160, callback=[Record(change, at), starts])
    assert [len(np.unique(rows, axis=0)) for rows in starts.records[:3]] == [2, 8, 8]


def test_a_callback_may_turn_common_random_numbers_off():
    """The perturbations are too small to act differently, so that equal starts have equal steps."""
    env = pendulum(4)
    model = FiniteDifference("LinearPolicy", env, estimator="forward", n_delta=3, delta_std=1e-12, seed=0)

    def change(model):
        model.common_random_numbers = False

    states = Record(lambda model: np.unique(env.get_attr("state"), axis=0), at="step")
    model.learn(2 * 160, callback=[Record(change), states])
    assert len(states.records[0]) == 1
    assert len(states.records[-2]) == 4


MEASUREMENTS = {
    "landscape": partial(landscape, n_points=2, n_episodes=1),
    "starts": partial(compare_starts, n_starts=4),
    "estimators": partial(compare_estimators, n_episodes=4, n_estimates=3, estimators=("likelihood_ratio",)),
}


@pytest.mark.parametrize("name", MEASUREMENTS)
def test_training_does_not_repeat_its_starts_after_measurements(name):
    """Which seed PyTorch's generator."""
    model = REINFORCE("MlpPolicy", pendulum(4), n_steps=20, seed=0)
    starts = first_observations()
    model.learn(3 * 80, callback=[starts, Record(MEASUREMENTS[name])])
    assert len({rows.tobytes() for rows in starts.records}) == 3


def test_after_a_landscape_the_environments_are_independent_again():
    """Its points have common starts."""
    env = pendulum(4)
    model = REINFORCE("MlpPolicy", env, seed=0)
    landscape(model, n_points=3, n_episodes=2)
    assert len(np.unique(model._last_obs, axis=0)) == 4
    model.max_episode_steps = 10
    with pytest.raises(ValueError, match="max_episode_steps"):
        landscape(model, n_points=3, n_episodes=2)
    assert len(np.unique(env.reset(), axis=0)) == 4


@pytest.mark.parametrize("measure", [sample, compare_starts])
def test_after_groups_the_environments_are_independent_again(measure):
    env = pendulum(8)
    model = REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, seed=0).learn(1)
    found = measure(model, 8)
    if measure is sample:
        assert len(np.unique(found.observations[0], axis=0)) == 8
    assert len(np.unique(env.reset(), axis=0)) == 8


MODELS_THAT_SHARE_STARTS = {
    "groups": lambda env: REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, seed=0),
    "search": lambda env: FiniteDifference("LinearPolicy", env, seed=0),
}


@pytest.mark.parametrize("end", [1, 10])
@pytest.mark.parametrize("name", MODELS_THAT_SHARE_STARTS)
def test_after_training_the_environments_are_independent_again(name, end):
    """Also where a callback stops the training."""
    env = pendulum(4)
    MODELS_THAT_SHARE_STARTS[name](env).learn(1, At(end) if end > 1 else None)
    assert len(np.unique(env.reset(), axis=0)) == 4


class Unseeded(DummyVecEnv):
    def seed(self, seed=None):
        raise NotImplementedError


@pytest.mark.parametrize("name", MODELS_THAT_SHARE_STARTS)
def test_a_vec_env_need_not_be_seeded(name):
    env = Unseeded([lambda: gym.make("Pendulum-v1", max_episode_steps=20)] * 4)
    model = MODELS_THAT_SHARE_STARTS[name](make_vec_env("Pendulum-v1", 4))
    model.set_env(env)
    assert model.learn(1).num_timesteps >= 4 * 20
    assert landscape(model, n_points=2, n_episodes=1).utilities.shape == (2, 2)


class Simulator:
    """Four environments of another library: neither a VecEnv nor with its methods for seeds."""

    num_envs = 4
    render_mode = None
    observation_space = spaces.Box(-1, 1, (3,))
    action_space = spaces.Discrete(2)

    def reset(self):
        self.t = 0
        return np.zeros((4, 3), dtype=np.float32)

    def step_async(self, actions):
        self.actions = actions

    def step_wait(self):
        self.t += 1
        obs = np.full((4, 3), self.t / 10, dtype=np.float32)
        is_over = self.t == 5
        infos = [{"terminal_observation": row} if is_over else {} for row in obs]
        return self.reset() if is_over else obs, self.actions.astype(float), np.full(4, is_over), infos


@pytest.mark.filterwarnings("ignore:The `render_mode` attribute")
def test_below_its_wrappers_an_environment_need_not_be_a_vec_env():
    env = Wrapper(VecMonitor(Simulator()))
    model = REINFORCE("MlpPolicy", env, n_steps=8).learn(64)
    assert model.ep_info_buffer[0]["l"] == 5
    assert len(compare_estimators(model, 4, estimators="likelihood_ratio", n_resamples=2)) == 1
    with pytest.raises(ValueError, match="Simulator does not support it here"):
        FiniteDifference("LinearPolicy", env).learn(64)
    assert FiniteDifference("LinearPolicy", env, common_random_numbers=False).learn(64).num_timesteps >= 64
    assert REINFORCE("MlpPolicy", env, n_episodes=8).learn(64).num_timesteps >= 64


def test_memory_takes_one_episode_of_each_environment():
    model = RecurrentREINFORCE("MlpLstmPolicy", DummyVecEnv([Scales] * 8), baseline="optimal", episodes_per_start=4)
    rollout = model.learn(8).rollout
    assert rollout.groups.tolist() == [[0] * 4 + [1] * 4] and rollout.used.all()


def test_a_model_can_be_loaded_for_other_numbers_of_environments(tmp_path):
    env = DummyVecEnv([Scales] * 8)
    REINFORCE("MlpPolicy", env, baseline="leave_one_out", episodes_per_start=4, seed=0).save(tmp_path / "model")
    assert REINFORCE.load(tmp_path / "model").n_episodes == 8
    loaded = REINFORCE.load(tmp_path / "model", env=DummyVecEnv([Scales]))
    with pytest.raises(ValueError, match="n_episodes=1"):
        loaded.learn(8)
    REINFORCE.load(tmp_path / "model", env=DummyVecEnv([Scales] * 12), n_episodes=12).learn(12)


# The example, which CI runs, asserts something similar for one seed
@pytest.mark.slow
def test_half_of_the_episodes_do_where_starts_differ():
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "14_common_starts.py"))
    better = 0
    for seed in range(5):
        alone = example["cost_by_episodes"](example["make_model"](1, seed))
        grouped = example["cost_by_episodes"](example["make_model"](8, seed))
        # Of the four evaluations the second is after half of the episodes
        better += grouped[1] <= alone[3]
    assert better >= 4
