"""FiniteDifference as an algorithm of Stable-Baselines3: counts, callbacks, going on, and what may go wrong."""

import copy
import pickle
import warnings
from collections import deque
from functools import partial
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformObservation
from models import Scaled, plain
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_reinforce import FiniteDifference
from sb3_reinforce.envs.vec_env import GymnasiumVecEnv
from sb3_reinforce.estimation.estimators import GradientEstimate, central_difference

SMALL: dict[str, Any] = dict(n_delta=3, estimator="central", seed=0, device="cpu")


def make(env: Any = "CartPole-v1", policy: Any = "LinearPolicy", **kwargs: Any) -> FiniteDifference:
    return FiniteDifference(policy, env, **{**SMALL, **kwargs})


class Line(gym.Env):
    """One step an episode: the reward is −(a − 3 s)², with s drawn at reset."""

    observation_space, action_space = spaces.Box(-1, 1, (1,)), spaces.Box(-9, 9, (1,))

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return self.state, -float((action[0] - 3 * self.state[0]) ** 2), True, False, {}


class Recorder(BaseCallback):
    """Notes what a callback can see at each step, and stops at one of them."""

    def __init__(self, stop_at: int | None = None):
        super().__init__()
        self.stop_at, self.thetas, self.counts, self.starts, self.ends = stop_at, [], [], 0, 0

    def _on_rollout_start(self) -> None:
        self.starts += 1
        self.centre = self.model.theta

    def _on_rollout_end(self) -> None:
        self.ends += 1

    def _on_step(self) -> bool:
        assert {"self", "new_obs", "rewards", "dones", "infos"} <= self.locals.keys()
        assert th.equal(self.model.theta, self.centre)
        self.counts.append(self.num_timesteps)
        return self.stop_at is None or self.n_calls < self.stop_at


def estimates(n_updates: int, **kwargs: Any) -> list[GradientEstimate]:
    """Of as many updates on ``Line`` at one θ."""
    model, callback = make(Line(), learning_rate=0.0, delta_std=0.1, **kwargs), Recorder()
    model.learn(1, callback)
    return [model.estimate_gradient(callback) for _ in range(n_updates)]


def test_the_gradient_is_the_estimator_applied_to_the_utility() -> None:
    (estimate,) = estimates(1, n_delta=4)
    theta = estimate.candidates.mean()
    # In Line with W = w, U = −(w s − 3 s)² = −(w − 3)² s² for the start s of the column
    utilities, candidates = estimate.utilities.reshape(2, 4), estimate.candidates.reshape(2, 4)
    s_squared = -utilities / (candidates - 3) ** 2
    th.testing.assert_close(s_squared[0], s_squared[1], rtol=1e-4, atol=1e-6)
    assert len(s_squared[0].unique()) == 4
    deltas = candidates[0] - theta
    expected = central_difference(lambda x: -((x[..., 0] - 3) ** 2) * s_squared[0], theta[None], deltas[:, None])
    th.testing.assert_close(estimate.gradient, expected, rtol=1e-3, atol=1e-4)
    assert float(deltas.std()) < 3 * estimate.delta_std


@pytest.mark.parametrize("estimator", ["regression", "central", "forward"])
@pytest.mark.parametrize("n_envs", [1, 4])
def test_it_learns_the_line(estimator: str, n_envs: int) -> None:
    model = make(make_vec_env(Line, n_envs), estimator=estimator, n_delta=8, learning_rate=0.1).learn(3000)
    assert float(model.theta) == pytest.approx(3, abs=0.2)


@pytest.mark.parametrize("common_random_numbers", [True, False])
def test_every_real_step_is_counted_once(common_random_numbers: bool) -> None:
    class Counted(gym.Wrapper):
        steps = 0

        def step(self, action: Any) -> Any:
            Counted.steps += 1
            return super().step(action)

    env = make_vec_env("CartPole-v1", 3, wrapper_class=Counted)
    callback = Recorder()
    model = make(env, n_eval_episodes=2, common_random_numbers=common_random_numbers).learn(500, callback)
    assert model.num_timesteps == Counted.steps == callback.counts[-1]
    assert callback.counts == list(range(3, 3 * len(callback.counts) + 1, 3))
    assert callback.starts == callback.ends == model._n_updates


def test_an_update_once_begun_is_finished_and_none_is_begun_after_the_end() -> None:
    class Updates(BaseCallback):
        at: ClassVar[list[int]] = []

        def _on_rollout_start(self) -> None:
            self.at.append(self.num_timesteps)

        def _on_step(self) -> bool:
            return True

    callback = Updates()
    model = make().learn(300, callback)
    assert callback.at[-1] < 300 <= model.num_timesteps
    assert len(callback.at) == model._n_updates


@pytest.mark.parametrize("n_envs", [1, 4])
def test_a_callback_stops_at_the_very_step(n_envs: int) -> None:
    model = make(make_vec_env("CartPole-v1", n_envs))
    theta, callback = model.theta, Recorder(stop_at=7)
    model.learn(10_000, callback)
    assert callback.n_calls == 7 and model.num_timesteps == 7 * n_envs
    assert th.equal(model.theta, theta) and callback.ends == 0
    model.learn(100, reset_num_timesteps=False)
    assert model.num_timesteps >= 100 + 7 * n_envs


def test_callbacks_of_stable_baselines3(tmp_path: Any) -> None:
    env = VecNormalize(make_vec_env("CartPole-v1", 2))
    evaluation = EvalCallback(VecNormalize(make_vec_env("CartPole-v1", 1), training=False), eval_freq=50, verbose=0)
    saving = CheckpointCallback(100, str(tmp_path), save_vecnormalize=True)
    model = make(env).learn(300, [evaluation, saving])
    assert evaluation.n_calls > 0 and np.isfinite(evaluation.last_mean_reward)
    checkpoint = FiniteDifference.load(next(tmp_path.glob("rl_model_*steps.zip")))
    assert th.equal(checkpoint.theta, make(env).theta) and checkpoint.theta.shape == model.theta.shape
    assert VecNormalize.load(str(next(tmp_path.glob("*vecnormalize*"))), make_vec_env("CartPole-v1", 2)).training
    with warnings.catch_warnings():
        # tqdm calls its own rich bar experimental
        warnings.simplefilter("ignore")
        model.learn(10_000, StopTrainingOnMaxEpisodes(5), progress_bar=True)
    assert model.num_timesteps < 10_000


def test_the_log() -> None:
    written: dict[str, Any] = {}

    class Writer(KVWriter):
        def write(self, key_values: dict[str, Any], key_excluded: Any, step: int = 0) -> None:
            written.update(key_values)

        def close(self) -> None:
            pass

    model = make(estimator="regression", n_delta=20)
    model.set_logger(Logger(None, [Writer()]))
    model.learn(200, log_interval=1)
    train = "n_updates learning_rate delta_std grad_norm r_squared residual_std standard_error"
    rollout = "ep_rew_mean ep_len_mean utility_mean utility_std"
    clock = "iterations fps time_elapsed total_timesteps"
    expected = {f"train/{key}" for key in train.split()} | {f"rollout/{key}" for key in rollout.split()}
    assert written.keys() == expected | {f"time/{key}" for key in clock.split()}
    assert all(np.isfinite(value) for value in written.values())
    assert written["time/total_timesteps"] == model.num_timesteps
    assert isinstance(model.ep_info_buffer, deque) and model.ep_info_buffer.maxlen == 100


def test_another_seed_is_another_search() -> None:
    first, other = (make(seed=seed).learn(100).theta for seed in (0, 1))
    assert not th.equal(first, other)


def test_schedules_end_at_zero_and_never_below() -> None:
    seen: list[float] = []

    def schedule(progress: float) -> float:
        seen.append(progress)
        return 0.1 * progress

    class Scales(Recorder):
        def _on_rollout_end(self) -> None:
            scales.append(self.locals["delta_std"])

    scales: list[float] = []
    model = make(learning_rate=schedule, delta_std=lambda progress: 0.01 + 0.1 * progress)
    for _ in range(2):
        model.learn(300, Scales(), reset_num_timesteps=False)
    assert min(seen) >= 0 and max(seen) <= 1
    assert 0.01 <= scales[-1] < scales[0] == 0.11


def test_common_random_numbers_reduce_the_variance_of_the_gradient() -> None:
    shared, own = (
        th.stack([estimate.gradient for estimate in estimates(50, n_delta=2, common_random_numbers=is_shared)])
        for is_shared in (True, False)
    )
    assert shared.var() < own.var() / 2


def test_seeds_differ_from_update_to_update() -> None:
    found = estimates(3, n_delta=1, perturbation=lambda k, n, generator: th.ones(k, n))
    assert len({float(estimate.gradient) for estimate in found}) == 3


@pytest.mark.parametrize("norm_obs", [True, False])
def test_vec_normalize_is_frozen_in_an_update_and_learns_between(norm_obs: bool) -> None:
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_obs=norm_obs)
    counts: list[float] = []

    class Frozen(BaseCallback):
        def _on_rollout_start(self) -> None:
            counts.append(env.obs_rms.count if norm_obs else 0)

        def _on_step(self) -> bool:
            assert env.training
            counts.append(env.obs_rms.count if norm_obs else 0)
            return True

    model = make(env)
    model.learn(1, Frozen())
    assert len(set(counts)) == 1 and model._n_updates == 1 and env.training
    if norm_obs:
        assert env.obs_rms.count == pytest.approx(counts[0] + model.num_timesteps)
        count = env.obs_rms.count
        env.training = False
        model.learn(1)
        assert env.obs_rms.count == count and not env.training


def test_utilities_are_sums_of_rewards_before_their_scaling() -> None:
    env = VecNormalize(make_vec_env("CartPole-v1", 2), norm_reward=True)
    env.ret_rms.var = np.array(100.0)
    callback = Recorder()
    model = make(env, n_delta=2).learn(0, callback)
    lengths = model.estimate_gradient(callback).utilities.tolist()
    assert all(length.is_integer() and length > 1 for length in lengths)
    assert sorted(lengths) == sorted(episode["l"] for episode in model.ep_info_buffer)


@pytest.mark.parametrize(
    ("policy", "env"),
    [
        ("LinearPolicy", lambda: IdentityEnv(2)),
        ("MlpPolicy", lambda: IdentityEnvBox()),
        ("CnnPolicy", lambda: FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=True)),
        ("MultiInputPolicy", lambda: SimpleMultiObsEnv(random_start=False)),
    ],
)
@pytest.mark.parametrize("deterministic", [True, False])
def test_policies(policy: str, env: Any, deterministic: bool) -> None:
    model = make(make_vec_env(env, 2), policy, n_delta=1, deterministic=deterministic)
    model.learn(2)
    assert model._n_updates == 1 and model.theta.shape == (model.n_parameters,)
    assert np.isfinite(evaluate_policy(model, model.get_env(), 1)[0])


def test_a_linear_policy_on_dicts() -> None:
    """Where a features extractor puts them in a row."""
    space = spaces.Dict(once=spaces.Box(-1, 1, (1,)), twice=spaces.Box(-2, 2, (1,)))
    doubled = partial(TransformObservation, func=lambda s: {"once": s, "twice": 2 * s}, observation_space=space)
    env = make_vec_env(lambda: doubled(Line()), 2)
    model = make(env, policy_kwargs={"features_extractor_class": CombinedExtractor}).learn(20)
    assert model.n_parameters == 2 and model._n_updates > 0
    with pytest.raises(ValueError, match="use MultiInputPolicy"):
        make(env)


def test_a_features_extractor_of_the_user_is_searched_and_left_as_it_was() -> None:
    model = make(Line(), "MlpPolicy", policy_kwargs=dict(features_extractor_class=Scaled), learning_rate=0.0)
    before = plain(model.policy.state_dict())
    for _ in range(2):
        model.learn(20)
        assert plain(model.policy.state_dict()) == before
    assert any(parameter is model.policy.features_extractor.scale for parameter in model._find_parameters())


class Freeze(BaseCallback):
    """Freezes the hidden layers when the first rollout ends."""

    def _on_rollout_end(self) -> None:
        if not self.model._n_updates:
            self.hidden = plain(self.model.policy.mlp_extractor.state_dict())
            self.model.policy.mlp_extractor.requires_grad_(False)

    def _on_step(self) -> bool:
        return True


def test_what_is_searched_is_what_is_trainable_when_an_update_begins() -> None:
    model = make(Line(), "MlpPolicy")
    n_parameters = model.n_parameters
    model.policy.action_net.requires_grad_(False)
    head = plain(model.policy.action_net.state_dict())
    model.learn(12)
    assert plain(model.policy.action_net.state_dict()) == head and model.n_parameters == n_parameters - 65
    old, model.policy = model.policy, make(Line(), "MlpPolicy", seed=1).policy
    states = [plain(policy.state_dict()) for policy in (old, model.policy)]
    model.learn(12)
    assert plain(old.state_dict()) == states[0] and plain(model.policy.state_dict()) != states[1]
    assert model.n_parameters == n_parameters


def test_what_a_callback_freezes_is_searched_for_the_last_time() -> None:
    model, callback = make(Line(), "MlpPolicy"), Freeze()
    model.learn(6, callback)
    once = plain(model.policy.mlp_extractor.state_dict())
    assert model._n_updates == 1 and once != callback.hidden
    model.learn(6, callback, reset_num_timesteps=False)
    assert model._n_updates == 2 and plain(model.policy.mlp_extractor.state_dict()) == once


def test_a_model_can_be_copied_when_new_and_pickled_after_learning() -> None:
    model = make(Line())
    same = copy.deepcopy(model)
    assert th.equal(model.learn(60).theta, same.learn(60).theta)
    again = pickle.loads(pickle.dumps(model))
    assert th.equal(model.learn(60).theta, again.learn(60).theta)


def test_a_model_that_a_callback_saves_is_not_collecting(tmp_path: Any) -> None:
    class Save(BaseCallback):
        def _on_step(self) -> bool:
            assert self.model.is_collecting
            self.model.save(tmp_path / "model")
            return True

    model = make(Line()).learn(1, Save())
    assert not model.is_collecting and not FiniteDifference.load(tmp_path / "model").is_collecting


@pytest.mark.parametrize("estimator", ["central", "regression"])
def test_a_vector_environment_with_workers_is_searched_as_one_without(estimator: str) -> None:
    same_step = gym.vector.AutoresetMode.SAME_STEP
    workers = GymnasiumVecEnv(gym.vector.AsyncVectorEnv([Line] * 2, autoreset_mode=same_step))
    thetas = [make(env, estimator=estimator).learn(20).theta for env in (workers, make_vec_env(Line, 2))]
    workers.close()
    assert th.equal(*thetas)


def test_frame_stack_over_normalize() -> None:
    env = VecFrameStack(VecNormalize(make_vec_env("CartPole-v1", 2)), 2)
    assert make(env).learn(200).num_timesteps >= 200


class Own(ActorCriticPolicy):
    def _predict(self, observation: Any, deterministic: bool = False) -> th.Tensor:
        return super()._predict(observation, deterministic)


def test_a_policy_with_code_of_its_own_gives_the_same_and_says_that_it_is_slower(capsys: Any) -> None:
    thetas = []
    for policy, verbose in (("MlpPolicy", 0), (Own, 1)):
        model = make(make_vec_env("CartPole-v1", 2), policy, n_delta=2, verbose=verbose)
        thetas.append(model.learn(100, log_interval=None).theta)
    assert "Own is not a plain MLP" in capsys.readouterr().out
    th.testing.assert_close(*thetas)


def test_too_few_perturbations_for_a_regression_are_said_once() -> None:
    model = make(estimator="regression", n_delta=4)
    with pytest.warns(UserWarning, match="n_delta=4 perturbations do not determine the gradient of 8") as warned:
        model.learn(1)
    assert warned[0].filename == __file__
    model.learn(1)


def test_the_rule_of_thumb() -> None:
    n = make().n_parameters
    assert make(estimator="regression", n_delta=None).n_delta == 2 * n
    assert make(estimator="central", n_delta=None).n_delta == n
    assert make(policy="MlpPolicy", n_delta=None).n_delta == 64


def test_a_perturbation_and_an_estimator_of_the_user() -> None:
    def estimator(utility: Any, theta: th.Tensor, deltas: th.Tensor) -> th.Tensor:
        # Two calls: rows that are compared meet the same episodes
        plus, minus = utility(theta + deltas), utility(theta - deltas)
        return (plus - minus) @ deltas / (2 * (deltas**2).sum())

    def perturbation(k: int, n: int, generator: th.Generator) -> th.Tensor:
        return th.ones(k, n)

    model = make(Line(), estimator=estimator, perturbation=perturbation, learning_rate=0.1).learn(2000)
    assert float(model.theta) == pytest.approx(3, abs=0.3)


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        (dict(estimator=lambda u, t, d: t[:1]), r"estimator must return a tensor of shape \(8,\), got .*\(1,\)"),
        (dict(estimator=lambda u, t, d: 3.0), r"estimator must return a tensor of shape \(8,\), got 3.0"),
        (dict(estimator=lambda u, t, d: t * np.nan), "estimator must return finite numbers"),
        (dict(estimator=lambda u, t, d: t), "estimator must call the utility at least once"),
        (dict(estimator=lambda u, t, d: u(t)), r"candidates must be a tensor of shape \(k, 8\) or \(m, k, 8\)"),
        (dict(perturbation=lambda k, n, g: th.ones(n, k)), r"perturbation must return a tensor of shape \(3, 8\)"),
        (dict(perturbation=lambda k, n, g: th.full((k, n), th.inf)), "perturbation must return finite numbers"),
        (dict(perturbation=lambda k, n, g: th.zeros(k, n)), "no usable direction"),
        (
            dict(estimator="regression", n_delta=9, perturbation=lambda k, n, g: th.ones(k, n)),
            "no usable direction",
        ),
        (dict(max_episode_steps=3), "has not ended after max_episode_steps=3 steps"),
    ],
)
def test_what_a_user_returns_wrongly_is_named_and_theta_stays(kwargs: dict[str, Any], match: str) -> None:
    model = make(**kwargs)
    theta = model.theta
    with pytest.raises(ValueError, match=match):
        model.learn(100)
    assert th.equal(model.theta, theta) and model._n_updates == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_learns_cart_pole(seed: int) -> None:
    model = FiniteDifference("LinearPolicy", make_vec_env("CartPole-v1", 1, seed=seed), seed=seed, device="cpu")
    assert evaluate_policy(model.learn(50_000), model.get_env(), 50)[0] >= 475
