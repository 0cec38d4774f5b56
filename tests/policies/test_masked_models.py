"""Masked policies are saved, measured and used with every VecEnv, and wrong masks are named."""

import re

import numpy as np
import pytest
import torch as th
from environments import Random
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from masked_models import ALGORITHMS, TASKS, VECTOR, Masked, environment, make, two_environments
from models import plain
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_reinforce import REINFORCE, ActionMaskObservation, GymnasiumVecEnv, MaskedPolicy
from sb3_reinforce.diagnostics import PitfallCallback, check_gradient, compare_baselines, compare_estimators
from sb3_reinforce.policies.masks import sizes_of

# A2C and TRPO use a policy as PPO does. For what a policy refuses, its two classes are enough
some_algorithms = pytest.mark.parametrize("algorithm", ["reinforce", "search", "ppo", "recurrent"])
both_policies = pytest.mark.parametrize("algorithm", ["ppo", "recurrent"])


@pytest.mark.parametrize("algorithm", ["reinforce", "search"])
def test_the_policy_has_a_name(algorithm):
    cls, arguments = ALGORITHMS[algorithm]
    assert type(cls("MaskedPolicy", environment(), **arguments).policy) is MaskedPolicy


@pytest.mark.parametrize("algorithm", ["reinforce", "recurrent"])
def test_going_on_from_a_file_is_bit_for_bit_never_having_stopped(algorithm, tmp_path):
    def finish(model):
        model.set_env(two_environments(seed=5))
        set_random_seed(7)
        model.learn(100, reset_num_timesteps=False)
        return plain(model.get_parameters())

    model = make(algorithm, two_environments(seed=3)).learn(100)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", device="cpu")
    assert plain(loaded.get_parameters()) == plain(model.get_parameters())
    assert finish(loaded) == finish(model)


@pytest.mark.parametrize("task", TASKS)
def test_a_policy_that_is_saved_alone_acts_alike(task, tmp_path):
    env = make_vec_env(lambda: environment(task), 8, seed=0)
    policy = make("ppo", env).policy
    policy.save(tmp_path / "policy")
    loaded = MaskedPolicy.load(tmp_path / "policy", device="cpu")
    obs = policy.obs_to_tensor(env.reset())[0]
    assert plain(policy.state_dict()) == plain(loaded.state_dict())
    assert th.equal(*(each(obs, deterministic=True)[0] for each in (policy, loaded)))


def with_dicts():
    return ActionMaskObservation(Masked(spaces.Dict({"x": VECTOR}), spaces.Discrete(5), lengths=(3, 7)))


VEC_ENVS = {
    "normalize": lambda: VecNormalize(two_environments(), norm_obs_keys=["observation"]),
    "dicts": lambda: VecNormalize(make_vec_env(with_dicts, 2), norm_obs_keys=["x"]),
    "rewards": lambda: VecNormalize(two_environments(), norm_obs=False),
    "gymnasium": lambda: GymnasiumVecEnv(SyncVectorEnv([environment] * 2, autoreset_mode=AutoresetMode.SAME_STEP)),
}


@some_algorithms
@pytest.mark.parametrize("vec_env", VEC_ENVS)
def test_masks_reach_the_policy_through_every_vec_env(vec_env, algorithm):
    env, eval_env = VEC_ENVS[vec_env](), VEC_ENVS[vec_env]()
    model = make(algorithm, env).learn(150, EvalCallback(eval_env, eval_freq=50, n_eval_episodes=2, warn=False))
    assert model.num_timesteps >= 150


def test_masks_are_made_in_the_workers():
    env = two_environments(vec_env_cls=SubprocVecEnv)
    rollout = make("reinforce", env).learn(150).rollout
    env.close()
    masks = rollout.observations["action_mask"]
    assert not masks.all() and masks.gather(2, rollout.actions.long()).all()


def test_a_mask_is_not_normalized():
    with pytest.raises(ValueError, match=r"action_mask.*norm_obs_keys"):
        VecNormalize(two_environments())


def test_the_gradient_lab_measures_a_masked_policy():
    env = make_vec_env(environment, 4, seed=0)
    model = make("episodes", env, policy_kwargs={"net_arch": []}).learn(200, PitfallCallback())
    assert check_gradient(model).passed
    assert check_gradient(make("recurrent", env)).passed
    assert len(compare_baselines(model, 8, n_resamples=2)) > 0
    assert len(compare_estimators(model, 8, 3, n_delta=2, n_resamples=2)) > 0


class Forced(Masked):
    """Allows one action only, but for every thirtieth step."""

    def observe(self):
        obs = super().observe()
        self.parts[0][:] = self.n_steps % 30 == 0
        self.parts[0][0] = True
        return obs


@pytest.mark.filterwarnings("ignore:The (returns|policy hardly changes)")
def test_a_policy_that_has_no_choice_is_not_called_deterministic():
    env = make_vec_env(lambda: ActionMaskObservation(Forced(*TASKS["discrete"], lengths=(50,))), 2, seed=0)
    callback = PitfallCallback()
    make("reinforce", env, learning_rate=1e-4).learn(1000, callback)
    assert "deterministic_too_early" not in callback.found


class Early(Masked):
    """Has a choice in the first steps of an episode only."""

    def observe(self):
        obs = super().observe()
        self.parts[0][:] = self.t < 20
        self.parts[0][0] = True
        return obs


@pytest.mark.filterwarnings("ignore:The returns")
@pytest.mark.parametrize("algorithm", ["reinforce", "recurrent"])
def test_the_randomness_of_a_nearly_uniform_policy_is_near_one_whenever_it_has_a_choice(algorithm):
    env = make_vec_env(lambda: ActionMaskObservation(Early(*TASKS["discrete"], lengths=(400,))), 2, seed=0)
    callback = PitfallCallback()
    make(algorithm, env, n_steps=400, learning_rate=1e-6).learn(1600, callback)
    assert [update.randomness for update in callback.updates] == pytest.approx([1.0, 1.0], abs=0.02)


@both_policies
@pytest.mark.parametrize("space", [spaces.MultiBinary(3), spaces.Box(-1, 1, (2,))])
def test_only_discrete_actions_can_be_masked(space, algorithm):
    env = Masked(VECTOR)
    env.action_space = space
    expected = re.escape(f"action_space must be Discrete or MultiDiscrete for its actions to be masked, got {space}")
    with pytest.raises(ValueError, match=expected):
        ActionMaskObservation(env)
    with pytest.raises(ValueError, match=expected):
        make(algorithm, Random(spaces.Dict({"observation": VECTOR, "action_mask": spaces.MultiBinary(3)}), space))


def test_an_environment_needs_action_masks():
    with pytest.raises(TypeError, match=r"env must have a method action_masks\(\) .*got <Random"):
        ActionMaskObservation(Random(VECTOR))
    attribute = Masked(VECTOR)
    attribute.action_masks = np.ones(2, dtype=bool)
    with pytest.raises(TypeError, match=r"env must have a method action_masks\(\)"):
        ActionMaskObservation(attribute)
    with pytest.raises(ValueError, match="must not have the key 'action_mask' yet"):
        ActionMaskObservation(environment())


@both_policies
def test_an_evaluation_needs_masks_too(algorithm):
    model = make(algorithm, environment())
    for obs in (VECTOR.sample(), {"observation": VECTOR.sample()}):
        with pytest.raises(ValueError, match=r"observation must be a dict with the key 'action_mask'.*wrap this"):
            model.predict(obs)


class OwnNetwork(MaskedPolicy):
    """Has a network as Stable-Baselines3's documentation shows it."""

    def _build_mlp_extractor(self):
        self.mlp_extractor = MlpExtractor(self.features_dim, [3], th.nn.ReLU, self.device)


def test_a_user_may_build_another_network():
    env = two_environments()
    model = REINFORCE(OwnNetwork, env, n_steps=16, seed=0, device="cpu").learn(64)
    assert type(model.policy.mlp_extractor.extractor) is MlpExtractor
    evaluate_policy(model, env, n_eval_episodes=4, warn=False)


@both_policies
@pytest.mark.parametrize(
    "space",
    [
        VECTOR,
        spaces.Dict({"observation": VECTOR}),
        spaces.Dict({"observation": VECTOR, "action_mask": spaces.MultiBinary(3)}),
        # VecNormalize would take this for numbers
        spaces.Dict({"observation": VECTOR, "action_mask": spaces.Box(0, 1, (2,))}),
        spaces.Dict({"action_mask": spaces.MultiBinary(2)}),
    ],
)
def test_a_masked_policy_needs_masks_and_observations(space, algorithm):
    expected = r"observation_space that is a Dict with 'action_mask': MultiBinary\(2\) .*, got "
    with pytest.raises(ValueError, match=expected + re.escape(f"{space}: wrap the environment in ActionMask")):
        make(algorithm, Random(space))


@pytest.mark.parametrize(
    ("task", "masks", "sentence"),
    [
        ("discrete", [True, False], "must return 5 booleans in a row for Discrete(5), got [True, False]"),
        ("discrete", None, "must return 5 booleans in a row for Discrete(5), got None"),
        ("discrete", np.zeros(6), "must return 5 booleans"),
        ("discrete", [0.0, -np.inf, 0.0, 0.0, 0.0], "must return 5 booleans"),
        ("discrete", [1, 2, 0, 0, 0], "must return 5 booleans"),
        ("discrete", [False] * 5, "must allow an action of Discrete(5) until the episode is over, got [False, "),
        ("multidiscrete", [[True] * 2, [True] * 4, [True] * 3], "must return 9 booleans in a row for MultiDiscrete"),
        ("multidiscrete", [True] * 6 + [False] * 3, "must allow an action in each dimension of MultiDiscrete"),
    ],
)
def test_a_wrong_mask_is_named(task, masks, sentence):
    env = environment(task)
    env.reset()
    env.unwrapped.action_masks = lambda: masks
    for ask in (env.reset, lambda: env.step(env.action_space.sample())):
        env.unwrapped.parts = [np.ones(size, bool) for size in sizes_of(env.action_space)]
        with pytest.raises(ValueError, match=re.escape(f"action_masks() {sentence}")):
            ask()


def test_what_an_environment_does_to_its_mask_later_does_not_count():
    env = environment()
    masks = np.ones(5, np.int8)
    env.unwrapped.action_masks = lambda: masks
    obs, _ = env.reset()
    masks[:] = 0
    assert env.observation_space.contains(obs) and obs["action_mask"].all()


class Ended(Masked):
    """Knows no actions when its episode is over."""

    def action_masks(self):
        assert self.t < self.length
        return super().action_masks()


@some_algorithms
def test_an_environment_is_not_asked_for_the_actions_of_a_terminal_state(algorithm):
    def ended():
        return ActionMaskObservation(Ended(*TASKS["discrete"], lengths=(3,), truncate=False))

    make(algorithm, make_vec_env(ended, 2)).learn(32)
    env = ended()
    env.reset(seed=0)
    steps = [env.step(int(env.unwrapped.action_masks().argmax())) for _ in range(3)]
    assert [terminated for _, _, terminated, *_ in steps] == [False, False, True]
    assert env.observation_space.contains(steps[-1][0]) and not steps[-1][0]["action_mask"].any()
    assert {obs["action_mask"].dtype for obs, *_ in steps} == {np.dtype(np.int8)}


def test_a_dict_with_the_key_observation_keeps_its_other_parts():
    """As of a goal environment."""
    space = spaces.Dict({"observation": VECTOR, "desired_goal": VECTOR})
    model = make("reinforce", ActionMaskObservation(Masked(space, spaces.Discrete(5)))).learn(16)
    assert model.policy.features_dim == 6


def test_the_mask_at_a_time_limit_is_the_environments():
    """The state is not terminal, and its value stands in for what would have followed."""
    env = environment()
    env.reset(seed=0)
    truncated = False
    while not truncated:
        action = int(env.unwrapped.action_masks().argmax())
        env.unwrapped.action_masks = lambda: np.arange(5) == 2
        obs, _, terminated, truncated, _ = env.step(action)
        del env.unwrapped.action_masks
    assert not terminated and obs["action_mask"].tolist() == [0, 0, 1, 0, 0]
