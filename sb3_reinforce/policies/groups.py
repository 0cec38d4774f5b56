"""Which parameters are the actor's, which the critic's, and which both share."""

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.policies.evaluation import Parameters, actor_parameters, critic_parameters, trainable


class ParameterGroups:
    """
    What log π depends on, what only V depends on, and what both do (a shared features extractor).

    They are read from graphs, not from names: a layer that computes π and V in one tensor counts as shared. They are
    read again only when the set of trainable parameters changes. A parameter that neither log π nor V reaches in this
    rollout belongs to actor and critic, since a network may use different parts in different rollouts.
    """

    def __init__(self) -> None:
        self.parameters: Parameters = []
        self.groups: tuple[Parameters, Parameters, Parameters] = ([], [], [])

    def sort(
        self, policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor
    ) -> tuple[Parameters, Parameters, Parameters]:
        """The trainable parameters of actor, critic alone and both, in the policy's order."""
        parameters = trainable(policy)
        if list(map(id, parameters)) != list(map(id, self.parameters)):
            policy.set_training_mode(False)
            of_actor = set(actor_parameters(policy, obs, actions))
            of_critic = set(critic_parameters(policy, obs, actions))
            if policy.share_features_extractor:
                of_actor.update(policy.features_extractor.parameters())
            # A parameter that neither reaches may count in training mode only, like the scale of a layer's noise. It is
            # in both lists: without a gradient it does not change
            actor = [each for each in parameters if each not in of_critic - of_actor]
            critic = [each for each in parameters if each not in of_actor]
            shared = [each for each in parameters if each in of_actor & of_critic]
            self.parameters = parameters
            self.groups = actor, critic, shared
        return self.groups
