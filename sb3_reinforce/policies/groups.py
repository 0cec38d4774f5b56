"""Which parameters are the actor's, which the critic's, and which both share."""

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.policies.evaluation import Parameters, actor_parameters, critic_parameters, trainable


class ParameterGroups:
    """
    What log π depends on, what only V depends on, and what both do (a shared features extractor).

    They are read from graphs, not from names: a layer that computes π and V in one tensor counts as shared. A network
    may use a part of itself in each rollout, so the graphs of further rollouts are read until each trainable parameter
    has been reached. Until then it belongs to actor and critic.
    """

    def __init__(self) -> None:
        self.sorted_for: tuple[int, ...] = ()
        self.of_actor: set[th.nn.Parameter] = set()
        self.of_critic: set[th.nn.Parameter] = set()

    def sort(
        self, policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor
    ) -> tuple[Parameters, Parameters, Parameters]:
        """The trainable parameters of actor, critic alone and both, in the policy's order."""
        parameters = trainable(policy)
        present = tuple(map(id, parameters))
        if self.sorted_for != present:
            self.sorted_for = present
            self.of_actor = set()
            self.of_critic = set()
        if not self.of_actor | self.of_critic >= set(parameters):
            policy.set_training_mode(False)
            self.of_actor.update(actor_parameters(policy, obs, actions))
            self.of_critic.update(critic_parameters(policy, obs, actions))
            if policy.share_features_extractor:
                self.of_actor.update(policy.features_extractor.parameters())
        # They may count in training mode only, like the scale of a layer's noise; without a gradient they do not change
        others = set(parameters) - self.of_actor - self.of_critic
        only_critic = self.of_critic - self.of_actor
        actor = [each for each in parameters if each in self.of_actor | others]
        critic = [each for each in parameters if each in only_critic | others]
        shared = [each for each in parameters if each in self.of_actor & self.of_critic]
        return actor, critic, shared
