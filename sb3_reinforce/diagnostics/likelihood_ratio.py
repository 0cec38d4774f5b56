"""The likelihood-ratio gradient at γ = 1 of any model of this package, whichever algorithm trains it."""

import copy
from typing import cast

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.diagnostics.sampling import sampled
from sb3_reinforce.estimation import baselines
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import gradients_by_episode, scored_parameters
from sb3_reinforce.finite_difference import FiniteDifference
from sb3_reinforce.policies.parameters import actor_parameters
from sb3_reinforce.reinforce import REINFORCE


def likelihood_ratio(model: REINFORCE | FiniteDifference, n_episodes: int) -> tuple[th.Tensor, int]:
    """
    Gradients of whole episodes at γ = 1 with the leave-one-out baseline, for the actor without ``log_std``.

    The environments are seeded, by a draw from PyTorch's generator.

    :param model: The model
    :param n_episodes: Number of episodes
    :return: Shape ``(n_episodes, n)``, float64; and the environment steps that they took, of all environments
    """
    plain = as_reinforce(model)
    sampler, infos = sampled(plain, n_episodes, "leave_one_out", seed=int(th.randint(2**31, ())))
    rollout = cast(Rollout, sampler.rollout)
    baseline = baselines.leave_one_out(rollout)
    gradients = gradients_by_episode(rollout, rollout.returns - baseline)[0].double().cpu()
    wanted = {id(parameter) for parameter in actor_parameters(plain.policy)}
    mask = th.cat([th.full((parameter.numel(),), id(parameter) in wanted) for parameter in scored_parameters(rollout)])
    return gradients[:, mask], len(infos.infos) * cast(VecEnv, plain.env).num_envs


def as_reinforce(model: BaseAlgorithm) -> REINFORCE:
    """
    A REINFORCE at γ = 1 with a model's policy and environments, which keeps nothing of its own.

    :param model: A REINFORCE or FiniteDifference
    """
    if isinstance(model, REINFORCE):
        plain = copy.copy(model)
    else:
        plain = REINFORCE(
            type(model.policy),  # type: ignore[arg-type]
            cast(VecEnv, model.env),
            policy_kwargs=model.policy_kwargs,
            max_episode_steps=getattr(model, "max_episode_steps", 100_000),
            device=model.device,
        )
        plain.policy = cast(ActorCriticPolicy, model.policy)
    plain.gamma, plain.gae_lambda, plain.reward_to_go, plain.discount_scores = 1.0, 1.0, True, False
    plain.baseline = "leave_one_out"
    return plain
