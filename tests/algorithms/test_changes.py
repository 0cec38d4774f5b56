"""What a user may change in the middle of training: arguments by a callback, and which parameters are trainable."""

import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import check_gradient, compare_baselines


class AtRolloutEnd(BaseCallback):
    def __init__(self, change):
        super().__init__()
        self.change = change

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.change(self.model)


def make(policy="MlpPolicy", space=None, **kwargs):
    env = make_vec_env(lambda: Corridor((3, 4), lambda t, action: float(t), space), 2, seed=0)
    arguments = {"seed": 0, "device": "cpu", "policy_kwargs": {"optimizer_class": th.optim.SGD}, **kwargs}
    return REINFORCE(policy, env, **arguments)


def test_the_rollout_at_hand_is_divided_by_its_own_number_of_episodes():
    arguments = {"n_episodes": 4, "normalize_by": "episodes", "baseline": "none", "max_grad_norm": None}
    ends = []
    for n_episodes in (4, 8):
        model = make(**arguments)
        model.learn(1, callback=AtRolloutEnd(lambda model, n=n_episodes: setattr(model, "n_episodes", n)))
        ends.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    assert th.equal(*ends)


def test_a_critic_that_is_asked_for_at_the_end_of_a_rollout_waits_for_the_next():
    model = make(n_steps=8, baseline="none")
    before = model.policy.value_net.weight.clone()
    with pytest.warns(UserWarning, match="n_steps cuts"):
        model.learn(1, callback=AtRolloutEnd(lambda model: setattr(model, "baseline", "value")))
    assert th.equal(model.policy.value_net.weight, before)
    model.learn(1)
    assert not th.equal(model.policy.value_net.weight, before)


def test_a_critic_warms_up_while_the_actor_is_frozen():
    """As A2C allows."""
    model = make(n_steps=8)
    actor = [*model.policy.mlp_extractor.policy_net.parameters(), *model.policy.action_net.parameters()]
    for parameter in actor:
        parameter.requires_grad_(False)
    before = [parameter.clone() for parameter in actor]
    critic = model.policy.value_net.weight.clone()
    model.learn(16)
    assert all(map(th.equal, before, actor)) and not th.equal(model.policy.value_net.weight, critic)
    assert model.logger.name_to_value["train/grad_norm"] == 0


class Exponential(th.nn.Module):
    def forward(self, x):
        return x.exp()


def parametrized(policy):
    th.nn.utils.parametrize.register_parametrization(policy, "log_std", Exponential())


def shared(policy):
    policy.log_std = th.nn.Parameter(th.zeros(1))


@pytest.mark.parametrize("change", [parametrized, shared])
def test_a_log_std_of_another_form(change):
    class Changed(ActorCriticPolicy):
        def _build(self, lr_schedule):
            super()._build(lr_schedule)
            change(self)
            self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    model = make(Changed, spaces.Box(-1, 1, (2,)), n_episodes=4, baseline="optimal", policy_kwargs={"net_arch": [4]})
    model.learn(40)
    assert check_gradient(model).passed
    assert compare_baselines(model, n_episodes=10)["optimal"].variance.value > 0
