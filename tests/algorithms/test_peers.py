"""
Faults that other implementations of the policy gradient have or had, and what would catch them here.

- an untrained critic in the return, at a cut or a time limit: test_rollouts, the value network changes nothing
- a time limit not bootstrapped with a critic, a terminal step bootstrapped: test_rollouts, the critic stands in
- episodes or environments mixed, the total return in place of the reward-to-go: test_gradient, the step is the formula
- "the first episodes to finish", which are the short ones: test_rollouts, lengths are drawn without bias
- several steps on one rollout without a correction: test_trained_parameters, one policy step per rollout
- division by the variance, by a deviation of 0, or of a single sample: test_gradient, standardized; test_fuzz
- an in-sample optimal baseline, whose gradient vanishes for one episode: test_enumeration, in sample; test_baselines
- γ^t missing, doubled, or applied to the total return: test_enumeration
- one clipping norm for actor and critic, the critic found by its name: below
"""

import torch as th
from environments import Corridor
from models import moved_by_learning
from stable_baselines3.common.policies import ActorCriticPolicy

from sb3_reinforce import REINFORCE


def test_the_critics_gradient_does_not_eat_the_actors_clipping_norm():
    """The weights are far within the bound and the critic's error far beyond it: the actor's step is not scaled."""
    steps = []
    for max_grad_norm in (100.0, None):
        env = Corridor((4,), reward=lambda t, action: 300.0 + float(action))
        kwargs = {"net_arch": [], "optimizer_class": th.optim.SGD}
        model = REINFORCE(
            "MlpPolicy", env, n_steps=8, learning_rate=1.0, critic_learning_rate=0.0, max_grad_norm=max_grad_norm,
            normalize_advantage=True, policy_kwargs=kwargs, seed=0, device="cpu",
        )  # fmt: skip
        before = model.policy.action_net.weight.clone()
        model.learn(8)
        steps.append(model.policy.action_net.weight - before)
    assert model.logger.name_to_value["train/value_loss"] > 1e5
    assert th.equal(*steps) and steps[0].norm() > 0


class Misnamed(ActorCriticPolicy):
    """The actor's part is called value, the critic's is not."""

    def _build(self, lr_schedule):
        super()._build(lr_schedule)
        self.value_of_actions, self.judge = self.action_net, self.value_net
        del self.action_net, self.value_net
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def __getattr__(self, name):
        renamed = {"action_net": "value_of_actions", "value_net": "judge"}
        return super().__getattr__(name if name in self._modules else renamed.get(name, name))


def test_the_critic_is_found_by_what_depends_on_it_not_by_its_name():
    model = REINFORCE(Misnamed, "CartPole-v1", n_steps=32, learning_rate=0.0, critic_learning_rate=1e-3)
    moved = moved_by_learning(model, 32)
    assert {name for name in moved if "mlp" not in name} == {"judge.weight", "judge.bias"}
