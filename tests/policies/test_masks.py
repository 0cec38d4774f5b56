"""No forbidden action is ever taken, and what is learned from is the softmax over the allowed ones."""

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch as th
from enumeration import GAMMA, assert_equal, discounted_return, rollout_of
from enumeration import make_model as make_unmasked
from environments import Random, Tree
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from models import Double, float64, plain
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    MlpExtractor,
    NatureCNN,
)
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_reinforce import REINFORCE, ActionMaskObservation, FiniteDifference, GymnasiumVecEnv, MaskedPolicy
from sb3_reinforce.diagnostics import PitfallCallback, check_gradient, compare_baselines, compare_estimators
from sb3_reinforce.estimation import BASELINES, gradients_by_episode
from sb3_reinforce.policies.masks import sizes_of
from sb3_reinforce.recurrent import MaskedLstmPolicy, RecurrentREINFORCE

ALGORITHMS = {
    "reinforce": (REINFORCE, {"n_steps": 16}),
    "episodes": (REINFORCE, {"n_episodes": 4, "baseline": "leave_one_out"}),
    "search": (FiniteDifference, {"n_delta": 4, "estimator": "central", "deterministic": False}),
    "a2c": (A2C, {"n_steps": 16}),
    "ppo": (PPO, {"n_steps": 64, "batch_size": 64, "n_epochs": 2}),
    "recurrent": (RecurrentREINFORCE, {"n_steps": 16}),
}
VECTOR = spaces.Box(-1, 1, (3,))
IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)
TASKS = {
    "discrete": (VECTOR, spaces.Discrete(5)),
    "multidiscrete": (VECTOR, spaces.MultiDiscrete([2, 4, 3])),
    "image": (spaces.Dict({"image": IMAGE, "vector": VECTOR}), spaces.Discrete(5)),
    "numbers": (spaces.MultiDiscrete([2, 3]), spaces.Discrete(5)),
}


class Masked(Random):
    """Draws a new mask at each step, which allows nothing when the episode is over, and refuses forbidden actions."""

    def observe(self):
        sizes = sizes_of(self.action_space)
        parts = [self.np_random.random(size) < 0.4 for size in sizes]
        for part in parts:
            part[self.np_random.integers(len(part))] = True
        self.parts = parts if self.t < self.length else [np.zeros(size, bool) for size in sizes]
        return super().observe()

    def action_masks(self):
        return np.concatenate(self.parts)

    def step(self, action):
        chosen = np.atleast_1d(action - getattr(self.action_space, "start", 0))
        assert all(part[a] for part, a in zip(self.parts, chosen, strict=True)), f"{action} is forbidden"
        return super().step(action)


def environment(task="discrete"):
    return ActionMaskObservation(Masked(*TASKS[task], lengths=(3, 7)))


def two_environments(**kwargs):
    return make_vec_env(environment, 2, **{"seed": 0, **kwargs})


def make(algorithm, env, **kwargs):
    cls, arguments = ALGORITHMS[algorithm]
    fixed = {"seed": 0, "device": "cpu", "policy_kwargs": {"net_arch": [8]}}
    policy = MaskedLstmPolicy if cls is RecurrentREINFORCE else MaskedPolicy
    return cls(policy, env, **{**fixed, **arguments, **kwargs})


def takes_only_allowed_actions(algorithm, task, n_steps, **kwargs):
    """The environment would raise an error: it is asked in training, sampled and deterministic evaluation."""
    env = make_vec_env(lambda: environment(task), 4, seed=0)
    model = make(algorithm, env, learning_rate=0.05, **kwargs).learn(n_steps)
    for deterministic in (False, True):
        evaluate_policy(model, env, n_eval_episodes=8, deterministic=deterministic, warn=False)
    return sum(env.get_attr("n_steps"))


algorithms = pytest.mark.parametrize("algorithm", ALGORITHMS)


NETWORKS = [{"enable_critic_lstm": False}, {"enable_critic_lstm": False, "shared_lstm": True}]


@pytest.mark.parametrize(
    ("algorithm", "task", "kwargs"),
    [
        *product(ALGORITHMS, TASKS, [{}]),
        *(("recurrent", "discrete", {"policy_kwargs": network}) for network in NETWORKS),
        *(("reinforce", "multidiscrete", {"temperature": temperature}) for temperature in (1e-3, 0.5, 1e6)),
    ],
)
def test_no_forbidden_action_is_taken(algorithm, task, kwargs):
    """Whatever the critic remembers, and at any temperature."""
    assert takes_only_allowed_actions(algorithm, task, 200, **kwargs) > 200


@pytest.mark.slow
def test_no_forbidden_action_is_taken_in_100_000_steps():
    pairs = [*product(ALGORITHMS, ("discrete", "multidiscrete", "image"))]
    assert sum(takes_only_allowed_actions(*pair, 100_000 // len(pairs) + 100) for pair in pairs) > 100_000


@pytest.mark.parametrize("algorithm", ["reinforce", "search"])
def test_a_mask_starts_with_the_first_action(algorithm):
    env = ActionMaskObservation(Masked(VECTOR, spaces.Discrete(5, start=2)))
    assert make(algorithm, env).learn(200).num_timesteps >= 200


def policy_and_obs(task, n=64):
    env = make_vec_env(lambda: environment(task), n, seed=0)
    policy = make("ppo", env).policy
    with th.no_grad():
        policy.action_net.action_net.weight.normal_()
    return policy, policy.obs_to_tensor(env.reset())[0]


def softmax_over_allowed(logits, mask, sizes):
    """A drawn action, its log π and the entropy of one observation, from the allowed logits alone."""
    actions, log_prob, entropy = [], 0.0, 0.0
    for part, allowed in zip(logits.split(sizes), mask.bool().split(sizes), strict=True):
        log_p = part[allowed].log_softmax(0)
        chosen = int(th.randint(len(log_p), ()))
        actions.append(int(allowed.nonzero()[chosen, 0]))
        log_prob = log_prob + log_p[chosen]
        entropy = entropy - (log_p.exp() * log_p).sum()
    return th.tensor(actions), log_prob, entropy


@pytest.mark.parametrize("task", ["discrete", "multidiscrete"])
def test_log_prob_entropy_and_gradient_are_those_of_the_softmax_over_the_allowed_actions(task):
    policy, obs = policy_and_obs(task)
    body, head = policy.mlp_extractor.extractor.policy_net, policy.action_net.action_net
    sizes = sizes_of(policy.action_space)
    rows = zip(head(body(obs["observation"])), obs["action_mask"], strict=True)
    actions, *expected = map(th.stack, zip(*(softmax_over_allowed(*row, sizes) for row in rows), strict=True))
    _, *ours = policy.evaluate_actions(obs, actions.reshape(-1, *policy.action_space.shape))
    parameters = [*body.parameters(), *head.parameters()]
    for mine, true in zip(ours, expected, strict=True):
        th.testing.assert_close(mine, true, rtol=0, atol=1e-6)
        gradients = [th.autograd.grad(each.mean(), parameters, retain_graph=True) for each in (mine, true)]
        th.testing.assert_close(*gradients, rtol=0, atol=1e-6)


def test_everything_is_allowed_where_nothing_is():
    policy, obs = policy_and_obs("multidiscrete")
    obs["action_mask"][:, :6] = 0
    parts = policy.get_distribution(obs).distribution
    assert all((part.probs > 0).all() for part in parts[:2])
    assert ((parts[2].probs > 0) == obs["action_mask"][:, 6:].bool()).all()


def test_the_critic_does_not_see_the_mask():
    policy, obs = policy_and_obs("discrete")
    other = {**obs, "action_mask": 1 - obs["action_mask"]}
    assert th.equal(policy.predict_values(obs), policy.predict_values(other))


class MaskedTree(Tree):
    """Each node allows two of three actions."""

    masks = np.array([[True, True, False], [False, True, True], [True, False, True]])
    rewards = np.array([[3.0, -1.0, np.nan], [np.nan, 5.0, -2.0], [1.0, np.nan, 4.0]])

    def __init__(self, ragged=True):
        super().__init__(ragged)
        self.action_space = spaces.Discrete(3)

    def action_masks(self):
        return self.masks[self.node]


@pytest.mark.parametrize("ragged", [True, False])
@pytest.mark.parametrize("baseline", ["none", "leave_one_out", "optimal"])
def test_the_expected_gradient_is_that_of_the_expected_return(baseline, ragged):
    """By enumeration, with the package's weights and scores; log π of a trajectory and ∇E[G_0] by hand."""
    tree, n_episodes = MaskedTree(ragged), 3 if baseline == "optimal" else 2
    policy_kwargs = {"net_arch": [], "features_extractor_class": Double}
    with float64():
        policy = make("episodes", ActionMaskObservation(tree), policy_kwargs=policy_kwargs).policy
    weight, bias = parameters = [*policy.action_net.parameters()]
    with th.no_grad():
        weight.normal_()
        bias.normal_()
    # The weights do not depend on the policy, nor on the form of the observations
    unmasked = make_unmasked(ragged, baseline="none", n_episodes=n_episodes)

    def log_prob(episode):
        logits = [(weight[:, node] + bias, action, th.tensor(tree.masks[node])) for node, action, _ in episode]
        return sum(z[action] - z[allowed].logsumexp(0) for z, action, allowed in logits)

    expected = 0.0
    for batch in product(tree.trajectories(), repeat=n_episodes):
        rollout, _ = rollout_of(unmasked, batch)
        masks = th.tensor(tree.masks)[rollout.observations.argmax(-1)]
        observations = {"observation": rollout.observations, "action_mask": masks}
        rollout = replace(rollout, observations=observations, policy=policy)
        weights = rollout.discounts * (rollout.returns - BASELINES[baseline](rollout))
        gradient = gradients_by_episode(rollout, weights).sum((0, 1)) / rollout.denominator
        expected = expected + th.stack([log_prob(episode) for episode in batch]).sum().exp().detach() * gradient
    utility = sum(log_prob(episode).exp() * discounted_return(episode) for episode in tree.trajectories())
    true = th.autograd.grad(utility, parameters)
    assert GAMMA < 1 and float(th.cat([part.flatten() for part in true]).norm()) > 0.1
    assert_equal(expected, th.cat([part.flatten() for part in true]))


@pytest.mark.parametrize("algorithm", ["reinforce", "search"])
def test_the_policy_has_a_name(algorithm):
    cls, arguments = ALGORITHMS[algorithm]
    assert type(cls("MaskedPolicy", environment(), **arguments).policy) is MaskedPolicy


class Norm(BaseFeaturesExtractor):
    """A user's features extractor for vectors."""

    def __init__(self, space, scale=1.0):
        assert isinstance(space, spaces.Box)
        super().__init__(space, 1)
        self.scale = th.nn.Parameter(th.tensor(scale))

    def forward(self, observations):
        return self.scale * observations.norm(dim=1, keepdim=True)


class NormOfParts(Norm):
    """A user's features extractor for dicts."""

    def __init__(self, space):
        assert space.spaces.keys() == {"image", "vector"}
        super().__init__(space["vector"])

    def forward(self, observations):
        return super().forward(observations["vector"])


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize(
    ("task", "extractor", "expected"),
    [
        ("discrete", None, FlattenExtractor),
        ("image", None, CombinedExtractor),
        ("cnn", None, NatureCNN),
        ("discrete", Norm, Norm),
        ("image", NormOfParts, NormOfParts),
    ],
)
def test_any_features_extractor_sees_the_observation_without_the_mask(task, extractor, expected, shared):
    env = ActionMaskObservation(Masked(*TASKS.get(task, (IMAGE, spaces.Discrete(5)))))
    policy_kwargs = {"features_extractor_class": extractor, "share_features_extractor": shared}
    model = make("reinforce", env, policy_kwargs=policy_kwargs).learn(32)
    assert type(model.policy.features_extractor.extractor) is expected


@algorithms
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


VEC_ENVS = {
    "dummy": two_environments,
    "normalize": lambda: VecNormalize(two_environments(), norm_obs_keys=["observation"]),
    "rewards": lambda: VecNormalize(two_environments(), norm_obs=False),
    "gymnasium": lambda: GymnasiumVecEnv(SyncVectorEnv([environment] * 2, autoreset_mode=AutoresetMode.SAME_STEP)),
}


@algorithms
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
    assert len(compare_baselines(model, 8, n_resamples=2)) > 0
    assert len(compare_estimators(model, 8, 3, n_delta=2, n_resamples=2)) > 0


class Forced(Masked):
    """Allows one action only, but for every tenth step."""

    def observe(self):
        obs = super().observe()
        self.parts[0][:] = self.n_steps % 10 == 0
        self.parts[0][0] = True
        return obs


@pytest.mark.filterwarnings("ignore:The returns")
def test_a_policy_that_has_no_choice_is_not_called_deterministic():
    env = make_vec_env(lambda: ActionMaskObservation(Forced(*TASKS["discrete"], lengths=(50,))), 2, seed=0)
    callback = PitfallCallback()
    make("reinforce", env, learning_rate=1e-4).learn(1000, callback)
    assert "deterministic_too_early" not in callback.found


@pytest.mark.parametrize("algorithm", [*ALGORITHMS])
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


@algorithms
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


@algorithms
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
    expected = r"observation_space must be .*'action_mask': MultiBinary\(2\).*ActionMaskObservation.*got "
    with pytest.raises(ValueError, match=expected + re.escape(str(space))):
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
