"""The worked examples of the chapter on policy gradient estimation."""

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.policies.evaluation import log_prob_of


class ScriptedPolicy(ActorCriticPolicy):
    """Takes the actions of a script, one after the other, instead of sampling them."""

    script = ()

    def forward(self, obs, deterministic=False):
        _, values, log_prob = super().forward(obs, deterministic)
        action, *self.script = self.script
        return th.tensor([action]), values, log_prob


def learn(rewards, script, **kwargs):
    """One gradient step from zero parameters on episodes of one step: each action of the script has its reward."""
    env = Corridor((1,), lambda t, action: rewards[action], spaces.Discrete(len(rewards)))
    policy_kwargs = {"net_arch": [], "optimizer_class": th.optim.SGD}
    model = REINFORCE(ScriptedPolicy, env, policy_kwargs=policy_kwargs, n_episodes=len(script), **kwargs)
    model.policy.script = script
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.zero_()
    return model.learn(1)


LEFT, RIGHT = 0, 1


def test_left_or_right():
    """π(Right) = σ(θ) at θ = 0, episodes Right, Left, Right: the gradient is 1.83 and the step at rate 0.1 is 0.183."""
    model = learn([-1.0, 5.0], [RIGHT, LEFT, RIGHT], baseline="none", learning_rate=0.1, max_grad_norm=None)
    theta = model.policy.action_net.weight[RIGHT].item()
    assert theta / 0.1 == pytest.approx((5 * 0.5 + 1 * 0.5 + 5 * 0.5) / 3, rel=1e-6)
    assert round(theta, 3) == 0.183
    assert 1 / (1 + np.exp(-theta)) == pytest.approx(0.546, abs=5e-4)


def test_actions_with_returns_8_10_12():
    """With the mean as baseline the average action gets no push, and the others −2 and 2."""
    for baseline, expected in (("mean", [-2, 0, 2]), ("none", [8, 10, 12])):
        model = learn([8.0, 10.0, 12.0], [0, 1, 2], baseline=baseline)
        assert model.rollout_buffer.advantages.ravel().tolist() == expected


def gradient_of_log_prob(policy, obs, action, parameter):
    log_prob = log_prob_of(policy, obs, action)
    return th.autograd.grad(log_prob.sum(), parameter)[0]


def test_score_of_a_softmax_policy():
    """∇ log π(a|s) with respect to the logits is 1(a' = a) − π(a'|s), and its mean under π is 0."""
    policy = REINFORCE("MlpPolicy", "Acrobot-v1", device="cpu").policy
    obs = th.randn(1, 6)
    probabilities = policy.get_distribution(obs).distribution.probs[0]
    scores = th.stack([gradient_of_log_prob(policy, obs, th.tensor([a]), policy.action_net.bias) for a in range(3)])
    th.testing.assert_close(scores, th.eye(3) - probabilities)
    th.testing.assert_close(probabilities @ scores, th.zeros(3), atol=1e-6, rtol=0)


def test_score_of_a_gaussian_policy():
    """∇_μ log π = (a − μ) / σ², and with respect to log σ it is (a − μ)² / σ² − 1."""
    policy = REINFORCE("MlpPolicy", "Pendulum-v1", device="cpu", policy_kwargs={"log_std_init": -0.7}).policy
    obs, action = th.randn(1, 3), th.tensor([[1.5]])
    with th.no_grad():
        difference, std = action - policy.get_distribution(obs).mode(), policy.log_std.exp()
    for parameter, expected in (
        (policy.action_net.bias, difference / std**2),
        (policy.log_std, difference**2 / std**2 - 1),
    ):
        th.testing.assert_close(gradient_of_log_prob(policy, obs, action, parameter), expected[0])
