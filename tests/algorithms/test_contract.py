"""What works with A2C works here: spaces, policies, environments, callbacks, logs, saving."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3 import A2C
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_reinforce import REINFORCE

MODES = [{"n_steps": 8}, {"n_episodes": 3, "baseline": "leave_one_out"}]
TINY = {"net_arch": [8]}


class AnySpace(gym.Env):
    """Samples of any observation space, episodes of 5 steps."""

    def __init__(self, observation_space, action_space=None):
        self.observation_space = observation_space
        self.action_space = action_space or spaces.Discrete(2)
        self.t = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.t += 1
        return self.observation_space.sample(), self.np_random.random(), False, self.t == 5, {}


IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
OBSERVATIONS = {
    "flat": (spaces.Box(-1, 1, (3,)), "MlpPolicy"),
    "float64": (spaces.Box(-1, 1, (2, 2), np.float64), "MlpPolicy"),
    "discrete": (spaces.Discrete(4), "MlpPolicy"),
    "multi_discrete": (spaces.MultiDiscrete([2, 3]), "MlpPolicy"),
    "multi_binary": (spaces.MultiBinary(3), "MlpPolicy"),
    "image": (IMAGE, "CnnPolicy"),
    "dict": (
        spaces.Dict({"image": IMAGE, "flat": spaces.Box(-1, 1, (3,)), "n": spaces.Discrete(3)}),
        "MultiInputPolicy",
    ),
}
ACTIONS = {
    "discrete": spaces.Discrete(3),
    "start": spaces.Discrete(3, start=-1),
    "multi_discrete": spaces.MultiDiscrete([2, 3]),
    "multi_binary": spaces.MultiBinary(3),
    "box": spaces.Box(-2, 1, (2,)),
    "box_2d": spaces.Box(-1, 1, (2, 3)),
    "box_float64": spaces.Box(-1, 1, (2,), np.float64),
}


def assert_trains(model):
    before = model.policy.action_net.weight.clone()
    model.learn(60)
    assert not th.equal(before, model.policy.action_net.weight)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("name", OBSERVATIONS)
def test_observation_spaces(name, mode):
    space, policy = OBSERVATIONS[name]
    env = make_vec_env(lambda: AnySpace(space), 2, seed=0)
    model = REINFORCE(
        policy, env, baseline=mode.get("baseline", "value"), **{k: v for k, v in mode.items() if k != "baseline"}
    )
    model.learn(30)
    actions, _ = model.predict(env.reset())
    assert model._n_updates > 0 and len(actions) == 2


@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("name", ACTIONS)
def test_action_spaces(name, mode):
    env = make_vec_env(lambda: AnySpace(spaces.Box(-1, 1, (3,)), ACTIONS[name]), 2, seed=0)
    model = REINFORCE("MlpPolicy", env, seed=0, policy_kwargs=TINY, ent_coef=0.01, **mode)
    assert_trains(model)
    action, _ = model.predict(np.zeros(3, dtype=np.float32))
    assert ACTIONS[name].contains(action)


@pytest.mark.parametrize("squash_output", [False, True])
@pytest.mark.parametrize("sde_sample_freq", [-1, 4])
def test_gsde(squash_output, sde_sample_freq):
    model = REINFORCE(
        "MlpPolicy",
        make_vec_env("Pendulum-v1", 2),
        use_sde=True,
        sde_sample_freq=sde_sample_freq,
        n_steps=8,
        ent_coef=0.01,
        policy_kwargs={"squash_output": squash_output, **TINY},
    )
    assert_trains(model)


@pytest.mark.parametrize("n_envs", [1, 2, 256])
def test_numbers_of_environments(n_envs):
    for mode in ({"n_steps": 2}, {"n_episodes": n_envs + 1, "baseline": "mean"}):
        model = REINFORCE("MlpPolicy", make_vec_env(lambda: Corridor((2, 3)), n_envs), **mode).learn(4 * n_envs)
        assert model.num_timesteps >= 4 * n_envs


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_subprocesses_make_the_same_parameters(mode):
    """The same seed gives bit-identical parameters, on each kind of VecEnv."""
    outcomes = []
    for vec_env_cls in (DummyVecEnv, DummyVecEnv, SubprocVecEnv):
        env = make_vec_env("CartPole-v1", 2, seed=5, vec_env_cls=vec_env_cls)
        model = REINFORCE("MlpPolicy", env, seed=5, device="cpu", **mode).learn(200)
        outcomes.append([parameter.clone() for parameter in model.policy.parameters()])
        env.close()
    assert all(map(th.equal, outcomes[0], outcomes[1])) and all(map(th.equal, outcomes[0], outcomes[2]))


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_wrappers_of_vec_envs(mode):
    env = VecFrameStack(VecNormalize(make_vec_env("Pendulum-v1", 2)), 3)
    model = REINFORCE("MlpPolicy", env, policy_kwargs=TINY, **mode).learn(450)
    assert model._n_updates > 0 and model.get_vec_normalize_env().ret_rms.count > 400


def test_a_policy_may_be_compiled():
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=8, policy_kwargs=TINY)
    model.policy = th.compile(model.policy, backend="eager")
    before = model.get_parameters()["policy"]["action_net.weight"].clone()
    model.learn(16)
    assert not th.equal(before, model.get_parameters()["policy"]["action_net.weight"])


class NeverTwice(BaseCallback):
    """Stops at a given step, and keeps what it saw."""

    def __init__(self, at):
        super().__init__()
        self.at, self.rollout_ends = at, 0

    def _on_rollout_end(self):
        self.rollout_ends += 1

    def _on_step(self):
        of_steps = {
            "new_obs",
            "rewards",
            "dones",
            "infos",
            "actions",
            "clipped_actions",
            "values",
            "log_probs",
            "n_steps",
        }
        assert self.locals.keys() >= of_steps | {"env", "rollout_buffer", "self", "total_timesteps", "tb_log_name"}
        return np.bool_(self.n_calls < self.at)


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_a_callback_stops_training_at_the_very_step(mode):
    model = REINFORCE("MlpPolicy", make_vec_env(lambda: Corridor((4,)), 2), **mode)
    callback = NeverTwice(at=21)
    model.learn(1000, callback=callback)
    assert model.num_timesteps == 42
    assert model._n_updates == callback.rollout_ends
    model.learn(20, reset_num_timesteps=False)
    assert model.num_timesteps >= 62


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_callbacks_of_sb3(mode, tmp_path):
    pytest.importorskip("rich")
    env, eval_env = make_vec_env("CartPole-v1", 2), make_vec_env("CartPole-v1", 1)
    stop = StopTrainingOnRewardThreshold(reward_threshold=1e9)
    callbacks = [
        CheckpointCallback(save_freq=50, save_path=tmp_path),
        EvalCallback(eval_env, callback_on_new_best=stop, best_model_save_path=tmp_path, eval_freq=60, verbose=0),
        EveryNTimesteps(80, NeverTwice(10**9)),
        LogEveryNTimesteps(70),
        StopTrainingOnMaxEpisodes(40),
    ]
    model = REINFORCE("MlpPolicy", env, **mode)
    with pytest.warns(Warning, match="rich is experimental"):
        model.learn(300, callback=callbacks, progress_bar=True)
    assert (tmp_path / "best_model.zip").exists() and list(tmp_path.glob("rl_model_*"))


class Recorder(HumanOutputFormat):
    """Keeps the keys of what is logged."""

    def __init__(self):
        self.keys = set()

    def write(self, key_values, key_excluded, step=0):
        self.keys |= set(key_values)

    def close(self):
        pass


def logged_keys(algorithm, env, **kwargs):
    recorder = Recorder()
    model = algorithm("MlpPolicy", env, n_steps=64, **kwargs)
    model.set_logger(Logger(None, [recorder]))
    model.learn(64 * 4, log_interval=1)
    return recorder.keys


@pytest.mark.parametrize("env", ["CartPole-v1", "Pendulum-v1"])
def test_the_log_has_the_keys_of_a2c_and_more(env):
    theirs = logged_keys(A2C, env)
    more = {"train/grad_norm", "rollout/complete_fraction"}
    assert logged_keys(REINFORCE, env) == theirs | more


def test_tensorboard(tmp_path):
    pytest.importorskip("tensorboard")
    REINFORCE("MlpPolicy", "CartPole-v1", tensorboard_log=tmp_path, n_steps=8).learn(32, log_interval=1)
    assert list((tmp_path / "REINFORCE_1").glob("events*"))


@pytest.mark.parametrize("log_interval", [1, 100, None])
def test_log_intervals(log_interval):
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=8).learn(32, log_interval=log_interval)
    assert model.num_timesteps == 32


@pytest.mark.parametrize("mode", MODES, ids=str)
@pytest.mark.parametrize("env_id", ["CartPole-v1", "Pendulum-v1"])
def test_saving_and_going_on_is_never_having_stopped(env_id, mode, tmp_path):
    """Where the environment is reset alike: bit-identical parameters, optimizers and counters."""
    schedules = dict(learning_rate=LinearSchedule(1e-3, 0, 1), ent_coef=LinearSchedule(0.01, 0, 1))

    def environment():
        return make_vec_env(env_id, 2, seed=9)

    def train_on(model):
        th.manual_seed(4)
        model.set_env(environment())
        return model.learn(450, reset_num_timesteps=False)

    model = REINFORCE("MlpPolicy", environment(), seed=2, device="cpu", **schedules, **mode).learn(450)
    model.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model", env=environment(), device="cpu")
    for one in (model, loaded):
        train_on(one)
    assert model.num_timesteps == loaded.num_timesteps and model._n_updates == loaded._n_updates
    assert all(map(th.equal, model.policy.parameters(), loaded.policy.parameters()))
    for name in ("policy.optimizer", "critic_optimizer"):
        ours, theirs = model.get_parameters()[name], loaded.get_parameters()[name]
        assert str(ours) == str(theirs)


def test_load_with_another_number_of_environments(tmp_path):
    for mode in MODES:
        REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 2), **mode).learn(100).save(tmp_path / "model")
        model = REINFORCE.load(tmp_path / "model", env=make_vec_env("CartPole-v1", 5)).learn(100)
        assert model.n_envs == 5 and model.rollout_buffer.rewards.shape[1] == 5


def test_load_for_prediction_alone(tmp_path):
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=8, temperature=0.5).learn(32)
    model.save(tmp_path / "model")
    loaded = REINFORCE.load(tmp_path / "model")
    obs = np.random.default_rng(0).normal(size=(64, 4)).astype(np.float32)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])


def test_parameters_come_from_a2c():
    """``exact_match=False``, since A2C has no optimizer for the critic alone."""
    other = A2C("MlpPolicy", "CartPole-v1", policy_kwargs={"optimizer_class": th.optim.Adam}).learn(32)
    model = REINFORCE("MlpPolicy", "CartPole-v1")
    model.set_parameters(other.get_parameters(), exact_match=False)
    assert all(map(th.equal, model.policy.parameters(), other.policy.parameters()))
    model.learn(64)


def test_the_callers_policy_kwargs_are_not_written_to():
    policy_kwargs = {"net_arch": [8]}
    model = REINFORCE("MlpPolicy", "CartPole-v1", policy_kwargs=policy_kwargs).learn(32)
    model.policy_kwargs["net_arch"] = None
    assert policy_kwargs == {"net_arch": [8]}


def test_an_overshooting_last_rollout_trains_at_no_negative_rate():
    rates = []

    class Watch(BaseCallback):
        def _on_step(self):
            rates.extend(group["lr"] for group in self.model.policy.optimizer.param_groups)
            return True

    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=60, learning_rate=lambda progress: progress * 1e-3)
    model.learn(100, callback=Watch())
    assert model.num_timesteps == 120 and model._current_progress_remaining == 0
    assert model.policy.optimizer.param_groups[0]["lr"] == 0 and min(rates) >= 0


def test_schedules_are_followed():
    def falling(start):
        return LinearSchedule(start, start / 2, 1.0)

    model = REINFORCE(
        "MlpPolicy", "CartPole-v1", n_steps=16, learning_rate=falling(1e-3), critic_learning_rate=falling(4e-3),
        ent_coef=falling(0.1), temperature=falling(2.0),
    )  # fmt: skip
    seen = []

    class Watch(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_start(self):
            (hook,) = model.policy.action_net._forward_hooks.values()
            seen.append(hook.temperature.item())

    model.learn(64, callback=Watch())
    assert seen == pytest.approx([2.0, 1.75, 1.5, 1.25])
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(5e-4)
    assert model.critic_optimizer.param_groups[0]["lr"] == pytest.approx(2e-3)
    model.learn(16, callback=Watch())
    assert seen[-1] == pytest.approx(2.0)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "MultiDiscrete", "MultiBinary"])
def test_temperature_divides_the_logits(env_id):
    env = (
        env_id
        if "-" in env_id
        else Corridor(action_space=ACTIONS[{"MultiDiscrete": "multi_discrete"}.get(env_id, "multi_binary")])
    )
    models = [REINFORCE("MlpPolicy", env, temperature=t, seed=0, device="cpu") for t in (1.0, 0.25)]
    with th.no_grad():
        models[0].policy.action_net.weight.mul_(4)
        models[0].policy.action_net.bias.mul_(4)
    obs = th.randn(5, *models[0].observation_space.shape)
    actions = th.zeros(5, models[0].rollout_buffer.action_dim)
    actions = actions.flatten().long() if env_id == "CartPole-v1" else actions
    outcomes = [model.policy.evaluate_actions(obs, actions)[1:] for model in models]
    th.testing.assert_close(outcomes[0], outcomes[1])


def test_temperature_may_fall_to_zero(tmp_path):
    """As "linearly to 0" does: the last policy is its own mode, and a model loaded at the end is that too."""
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=32, temperature=LinearSchedule(1.0, 0.0, 1.0), device="cpu")
    with th.no_grad():
        model.policy.action_net.weight.normal_()
    model.learn(320)
    model.save(tmp_path / "cold")
    cold = REINFORCE.load(tmp_path / "cold", env=model.env)
    obs = th.randn(200, 4).numpy()
    sampled, mode = (cold.predict(obs, deterministic=deterministic)[0] for deterministic in (False, True))
    assert len(set(mode)) == 2 and (sampled == mode).all()
    cold.learn(64)
    assert all(parameter.isfinite().all() for parameter in cold.policy.parameters())


def test_min_std_is_a_floor():
    model = REINFORCE(
        "MlpPolicy", "Pendulum-v1", n_steps=16, min_std=0.6, learning_rate=0.5, policy_kwargs={"log_std_init": -3.0}
    )
    stds = []

    class Watch(BaseCallback):
        def _on_step(self):
            stds.append(self.model.policy.log_std.exp().min().item())
            return True

    model.learn(160, callback=Watch())
    assert min(stds) >= 0.6 - 1e-6 and model.logger.name_to_value["train/std"] >= 0.6 - 1e-6


@pytest.mark.parametrize("name", ["flat", "image", "dict"])
def test_the_critics_passes_leave_the_actor_and_a_shared_extractor_alone(name):
    """One policy step per rollout: at policy rate 0 nothing that the actor depends on moves, and the critic does."""
    space, policy = OBSERVATIONS[name]
    model = REINFORCE(policy, AnySpace(space), n_steps=10, learning_rate=0.0, critic_learning_rate=1e-3)
    before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
    model.learn(20)
    moved = {name for name, parameter in model.policy.named_parameters() if not th.equal(parameter, before[name])}
    assert moved == {name for name in before if "value_net" in name}


class BatchNormExtractor(FlattenExtractor):
    """An extractor that actor and critic share, with statistics that move when it is evaluated in training mode."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.batch_norm = th.nn.BatchNorm1d(self.features_dim)

    def forward(self, observations):
        return self.batch_norm(super().forward(observations))


def test_the_critics_passes_leave_the_statistics_of_a_shared_extractor_alone():
    statistics = []
    for n_critic_updates in (1, 20):
        kwargs = {"features_extractor_class": BatchNormExtractor}
        model = REINFORCE("MlpPolicy", "CartPole-v1", n_critic_updates=n_critic_updates, seed=0, policy_kwargs=kwargs)
        statistics.append(model.learn(32).policy.features_extractor.batch_norm.running_mean.clone())
    assert th.equal(*statistics) and statistics[0].abs().sum() > 0


def test_the_policy_step_trains_a_shared_extractor_for_the_critic_too():
    """With a policy gradient of zero, only ``vf_coef`` times the critic's error moves the extractor."""
    for vf_coef in (0.0, 0.5):
        model = REINFORCE("CnnPolicy", AnySpace(IMAGE), n_steps=10, vf_coef=vf_coef, seed=0)
        with th.no_grad():
            model.policy.action_net.weight.zero_()
        before = model.policy.features_extractor.linear[0].weight.clone()
        model.learn(10)
        assert th.equal(before, model.policy.features_extractor.linear[0].weight) == (vf_coef == 0)


def test_a_policy_that_is_replaced_or_frozen_after_construction():
    """As in A2C: what is trained is read from the policy at each step."""
    for kwargs in ({}, {"baseline": "none", "n_episodes": 2}):
        model, other = (REINFORCE("MlpPolicy", "CartPole-v1", **kwargs) for _ in range(2))
        model.policy = other.policy
        before = {name: parameter.clone() for name, parameter in model.policy.named_parameters()}
        model.learn(64)
        moved = {name for name, parameter in model.policy.named_parameters() if not th.equal(parameter, before[name])}
        assert moved == {name for name in before if not kwargs or "value_net" not in name}

        frozen = [
            *model.policy.mlp_extractor.policy_net.parameters(),
            *model.policy.mlp_extractor.value_net.parameters(),
        ]
        for parameter in frozen:
            parameter.requires_grad_(False)
        before = [parameter.clone() for parameter in frozen], model.policy.action_net.weight.clone()
        model.learn(64)
        assert all(map(th.equal, before[0], frozen)) and not th.equal(before[1], model.policy.action_net.weight)


class ConstantCritic(ActorCriticPolicy):
    """Thinks that nothing is worth anything."""

    def predict_values(self, obs):
        return th.zeros(len(obs), 1)


def test_a_critic_without_parameters():
    model = REINFORCE(ConstantCritic, "CartPole-v1", n_steps=16).learn(64)
    assert model._n_updates == 4 and (model.rollout_buffer.values == 0).all()


def test_what_a_callback_sets_is_used():
    class Set(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            self.model.ent_coef, self.model.temperature, self.model.gamma = 1e6, 3.0, 0.5

    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=16, max_grad_norm=None).learn(32, callback=Set())
    assert model.logger.name_to_value["train/grad_norm"] > 100
    assert next(iter(model.policy.action_net._forward_hooks.values())).temperature == 3


@pytest.mark.parametrize("mode", [{"n_steps": 8}, {"n_episodes": 5}])
def test_a_callback_may_read_the_buffer_in_minibatches_or_change_its_advantages(mode):
    """``get`` puts the rows of each environment one after the other; training is the same as without it."""

    class Read(BaseCallback):
        def __init__(self, read, factor=1.0):
            super().__init__()
            self.read, self.factor = read, factor

        def _on_step(self):
            return True

        def _on_rollout_end(self):
            if self.read:
                next(self.model.rollout_buffer.get(batch_size=3))
            self.model.rollout_buffer.advantages *= self.factor

    outcomes = []
    for callback in (Read(False), Read(True), Read(True, factor=0.0)):
        env = make_vec_env("CartPole-v1", 3, seed=0)
        model = REINFORCE("MlpPolicy", env, seed=0, device="cpu", **mode).learn(20, callback=callback)
        outcomes.append(model.policy.action_net.weight.clone())
    assert th.equal(outcomes[0], outcomes[1]) and not th.equal(outcomes[0], outcomes[2])


def test_a_callback_may_shape_the_rewards_in_place():
    class Shape(BaseCallback):
        def _on_step(self):
            self.locals["rewards"] *= 5
            return True

    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=16).learn(16, callback=Shape())
    assert (model.rollout_buffer.rewards == 5).all()


class Reused(VecEnvWrapper):
    """Hands out the same arrays at each step: dones, as numbers, and terminal observations."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        self.dones = getattr(self, "dones", np.zeros(self.num_envs, dtype=np.uint8))
        self.dones[:] = dones
        self.last = getattr(self, "last", np.zeros_like(obs))
        for i in np.flatnonzero(dones):
            self.last[i] = infos[i]["terminal_observation"]
            infos[i]["terminal_observation"] = self.last[i]
        return obs, rewards, self.dones, infos


@pytest.mark.parametrize("mode", MODES, ids=str)
def test_a_vec_env_may_reuse_its_arrays(mode):
    outcomes = []
    for wrapper in (lambda env: env, Reused):
        env = wrapper(make_vec_env(lambda: Corridor((2, 3, 5), truncate=True), 2, seed=0))
        model = REINFORCE("MlpPolicy", env, seed=0, device="cpu", policy_kwargs=TINY, **mode).learn(100)
        outcomes.append([parameter.clone() for parameter in model.policy.parameters()])
    assert all(map(th.equal, *outcomes))


class OwnAdd(RolloutBuffer):
    def add(self, *args, **kwargs):
        return super().add(*args, **kwargs)


def test_rollout_buffer_classes():
    model = REINFORCE("MlpPolicy", "CartPole-v1", rollout_buffer_class=RolloutBuffer, rollout_buffer_kwargs={})
    assert type(model.rollout_buffer) is RolloutBuffer
    with pytest.warns(UserWarning, match=r"OwnAdd overrides add"):
        REINFORCE("MlpPolicy", "CartPole-v1", rollout_buffer_class=OwnAdd)
    with pytest.raises(TypeError, match="wrong_keyword"):
        REINFORCE("MlpPolicy", "CartPole-v1", rollout_buffer_kwargs={"wrong_keyword": 1})


def test_min_std_holds_from_the_first_step_after_a_load(tmp_path):
    REINFORCE("MlpPolicy", "Pendulum-v1", policy_kwargs={"log_std_init": -3.0}).save(tmp_path / "model")
    model = REINFORCE.load(tmp_path / "model", env=gym.make("Pendulum-v1"), min_std=0.5, learning_rate=0.0)
    assert model.learn(32).policy.log_std.exp().item() == pytest.approx(0.5)


@pytest.mark.parametrize(("sde_sample_freq", "expected"), [(-1, 1), (4, 3)])
def test_the_noise_of_gsde_is_drawn_when_it_should_be(sde_sample_freq, expected, monkeypatch):
    model = REINFORCE("MlpPolicy", "Pendulum-v1", use_sde=True, sde_sample_freq=sde_sample_freq, n_steps=8)
    calls = []
    original = model.policy.reset_noise
    monkeypatch.setattr(model.policy, "reset_noise", lambda *args: calls.append(args) or original(*args))
    model.learn(8)
    assert calls == [(1,)] * expected


def test_a_squashed_action_is_unscaled_for_the_environment():
    sent = []

    class Recorder(gym.ActionWrapper):
        def action(self, action):
            sent.append(action)
            return action

    kwargs = {"squash_output": True, "log_std_init": 1.0}
    model = REINFORCE("MlpPolicy", Recorder(gym.make("Pendulum-v1")), n_steps=8, use_sde=True, policy_kwargs=kwargs)
    model.learn(8)
    np.testing.assert_allclose(np.ravel(sent), 2 * model.rollout_buffer.actions.ravel(), atol=1e-6)


def test_the_policy_can_be_pickled_and_copied():
    model = REINFORCE("MlpPolicy", "CartPole-v1", temperature=0.5)
    for policy in (copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))):
        assert all(map(th.equal, policy.parameters(), model.policy.parameters()))


def test_exactly_one_policy_step_per_rollout():
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=8, n_critic_updates=7)
    steps = []
    model.policy.optimizer.register_step_pre_hook(lambda *args: steps.append(model.num_timesteps))
    model.learn(32)
    assert steps == [8, 16, 24, 32]


@pytest.mark.parametrize(("n_critic_updates", "batch_size", "expected"), [(1, 64, 1), (3, 64, 3), (2, 5, 8)])
def test_the_critic_makes_its_passes_in_minibatches(n_critic_updates, batch_size, expected):
    model = REINFORCE("MlpPolicy", "CartPole-v1", n_steps=16, n_critic_updates=n_critic_updates, batch_size=batch_size)
    steps = []
    model.critic_optimizer.register_step_pre_hook(lambda *args: steps.append(1))
    model.learn(16)
    assert len(steps) == expected


def test_evaluate_policy():
    model = REINFORCE("MlpPolicy", "CartPole-v1")
    mean, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=3, warn=False)
    assert mean > 0


def test_memory_does_not_grow_with_updates():
    model = REINFORCE("MlpPolicy", make_vec_env(lambda: Corridor((3, 50)), 2), n_episodes=4, baseline="none")
    sizes = []

    class Watch(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            sizes.append(self.model.rollout_buffer.observations.nbytes)

    model.learn(10_000, callback=Watch())
    assert len(sizes) > 20 and max(sizes[len(sizes) // 2 :]) <= 2 * 50 * 4 * 50 * 4
