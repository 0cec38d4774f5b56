"""No forbidden action is ever taken, and what is learned from is the softmax over the allowed ones."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch as th
from enumeration import assert_equal, discounted_return, expectation, rollout_of
from enumeration import make_model as make_unmasked
from environments import Tree
from gymnasium import spaces
from masked_models import ALGORITHMS, IMAGE, TASKS, VECTOR, Masked, environment, make
from models import Double, float64
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
)

from sb3_reinforce import ActionMaskObservation
from sb3_reinforce.estimation import BASELINES, gradients_by_episode
from sb3_reinforce.policies.masks import sizes_of


def takes_only_allowed_actions(algorithm, task, n_steps, **kwargs):
    """The environment would raise an error: it is asked in training, sampled and deterministic evaluation."""
    env = make_vec_env(lambda: environment(task), 4, seed=0)
    model = make(algorithm, env, learning_rate=0.05, **kwargs).learn(n_steps)
    for deterministic in (False, True):
        evaluate_policy(model, env, n_eval_episodes=4, deterministic=deterministic, warn=False)
    return sum(env.get_attr("n_steps"))


SMALL = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 16}}
NETWORKS = [{"enable_critic_lstm": False}, {"enable_critic_lstm": False, "shared_lstm": True}]


@pytest.mark.parametrize(
    ("algorithm", "task", "kwargs"),
    [
        *product(ALGORITHMS, ["discrete"], [{}]),
        *product(["reinforce", "search", "ppo", "recurrent"], ["multidiscrete"], [{}]),
        *product(["reinforce", "search", "recurrent"], ["numbers"], [{}]),
        *product(["reinforce", "search", "recurrent"], ["image"], [{"policy_kwargs": SMALL}]),
        *(("recurrent", "discrete", {"policy_kwargs": network}) for network in NETWORKS),
        *(("reinforce", "multidiscrete", {"temperature": temperature}) for temperature in (1e-3, 1e6)),
    ],
)
def test_no_forbidden_action_is_taken(algorithm, task, kwargs):
    """Whatever the critic remembers, and at any temperature."""
    assert takes_only_allowed_actions(algorithm, task, 200, **kwargs) > 200


@pytest.mark.slow
def test_no_forbidden_action_is_taken_in_100_000_steps():
    pairs = [*product(ALGORITHMS, ("discrete", "multidiscrete", "image"))]
    assert sum(takes_only_allowed_actions(*pair, 100_000 // len(pairs) + 100) for pair in pairs) > 100_000


def test_a_mask_starts_with_the_first_action():
    env = ActionMaskObservation(Masked(VECTOR, spaces.Discrete(5, start=2)))
    assert make("reinforce", env).learn(200).num_timesteps >= 200


def policy_and_obs(task):
    env = make_vec_env(lambda: environment(task), 64, seed=0)
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


@pytest.mark.parametrize("baseline", ["none", "optimal"])
def test_the_expected_gradient_is_that_of_the_expected_return(baseline):
    """By enumeration, with the package's weights and scores; log π of a trajectory and ∇E[G_0] by hand."""
    tree, n_episodes = MaskedTree(), 3 if baseline == "optimal" else 2
    policy_kwargs = {"net_arch": [], "features_extractor_class": Double}
    with float64():
        policy = make("episodes", ActionMaskObservation(tree), policy_kwargs=policy_kwargs).policy
    weight, bias = parameters = [*policy.action_net.parameters()]
    with th.no_grad():
        weight.normal_()
        bias.normal_()
    # The weights do not depend on the policy, nor on the form of the observations
    unmasked = make_unmasked(True, baseline="none", n_episodes=n_episodes)

    def log_prob(episode):
        logits = [(weight[:, node] + bias, action, th.tensor(tree.masks[node])) for node, action, _ in episode]
        return sum(z[action] - z[allowed].logsumexp(0) for z, action, allowed in logits)

    def estimate(batch):
        rollout, _ = rollout_of(unmasked, batch)
        masks = th.tensor(tree.masks)[rollout.observations.argmax(-1)]
        observations = {"observation": rollout.observations, "action_mask": masks}
        rollout = replace(rollout, observations=observations, policy=policy)
        weights = rollout.discounts * (rollout.returns - BASELINES[baseline](rollout))
        return gradients_by_episode(rollout, weights).sum((0, 1)) / rollout.denominator

    trajectories = tree.trajectories()
    log_probs = th.stack([log_prob(trajectory) for trajectory in trajectories])
    utilities = th.tensor([discounted_return(trajectory) for trajectory in trajectories])
    true = th.nn.utils.parameters_to_vector(th.autograd.grad(log_probs.exp() @ utilities, parameters))
    assert float(true.norm()) > 0.1
    assert_equal(expectation(estimate, trajectories, log_probs.detach(), n_episodes), true)


class Norm(BaseFeaturesExtractor):
    """A user's features extractor for vectors."""

    def __init__(self, space):
        assert isinstance(space, spaces.Box)
        super().__init__(space, 1)
        self.scale = th.nn.Parameter(th.tensor(1.0))

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
