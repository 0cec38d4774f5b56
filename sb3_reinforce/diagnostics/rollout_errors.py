"""What ``gradient_check`` measures of a rollout: how far returns, weights and training step are from the formula."""

import numpy as np
import torch as th
from stable_baselines3.common.utils import FloatSchedule, obs_as_tensor

from sb3_reinforce.common.arguments import check_function
from sb3_reinforce.common.tensors import stack, to_vector
from sb3_reinforce.diagnostics.policy_errors import relative
from sb3_reinforce.diagnostics.sampling import Infos, training_weights
from sb3_reinforce.estimation import BASELINES
from sb3_reinforce.estimation.rollout import Rollout
from sb3_reinforce.estimation.scores import gradients_by_episode, scored_parameters
from sb3_reinforce.reinforce import REINFORCE


def return_by_definition(rewards: np.ndarray, next_values: np.ndarray, gamma: float, lam: float) -> np.ndarray:
    """
    ``G_t = (1 − λ) Σ_{n=1}^{N−1} λ^{n−1} G_{t:t+n} + λ^{N−1} G_{t:t+N}``, ``G_{t:t+n} = Σ_{k<n} γ^k r_{t+k} + γ^n V``.

    Source: Sutton and Barto (2018), equations 12.1 and 12.3, term by term and not by a recursion.

    :param rewards: Rewards of one episode, shape ``(T,)``
    :param next_values: V(s_{t+1}), shape ``(T,)``
    :param gamma: γ
    :param lam: λ
    :return: Shape ``(T,)``
    """
    returns = np.zeros(len(rewards))
    for t in range(len(rewards)):
        n = np.arange(1, len(rewards) - t + 1)
        n_step = np.cumsum(gamma ** (n - 1) * rewards[t:]) + gamma**n * next_values[t:]
        shares = np.where(n < n[-1], (1 - lam) * lam ** (n - 1.0), lam ** (n - 1.0))
        returns[t] = shares @ n_step
    return returns


def return_error(sampler: REINFORCE, rollout: Rollout, infos: Infos) -> float:
    """
    The largest difference of a return from its definition, by the largest return.

    :param sampler: The model that collected
    :param rollout: What it collected
    :param infos: The infos of its steps
    """
    error, scale = 0.0, 1e-12
    for episode in th.unique(rollout.episodes[rollout.used]):
        steps, envs = ((rollout.episodes == episode) & rollout.used).nonzero(as_tuple=True)
        values = np.zeros(len(steps))
        if rollout.values is not None:
            values[:-1] = rollout.values[steps, envs][1:]
            info = infos.infos[int(steps[-1])][int(envs[-1])]
            if info.get("TimeLimit.truncated"):
                terminal = obs_as_tensor(stack([info["terminal_observation"]]), sampler.device)
                with th.no_grad():
                    values[-1] = float(sampler.policy.predict_values(terminal))
        rewards = rollout.rewards[steps, envs].numpy()
        expected = return_by_definition(rewards, values, sampler.gamma, sampler.gae_lambda)
        if not sampler.reward_to_go:
            expected[:] = expected[0]
        error = max(error, float(np.abs(rollout.returns[steps, envs].numpy() - expected).max()))
        scale = max(scale, float(np.abs(expected).max()))
    return error / scale


def weight_error(sampler: REINFORCE, rollout: Rollout) -> float:
    """
    ``‖w − (G − b)‖ / ‖w‖`` over the used steps, w being what training reads from the rollout buffer.

    :param sampler: The model that collected
    :param rollout: What it collected
    """
    expected = (rollout.returns - check_function("baseline", sampler.baseline, BASELINES)(rollout).cpu()) * rollout.used
    return relative(training_weights(sampler), expected)


def surrogate_error(sampler: REINFORCE, rollout: Rollout) -> float:
    """
    The step of ``train()``, without entropy bonus, normalization and clipping, against
    ``Σ w_t γ^t ∇ log π / denominator``.

    :param sampler: The model that collected; its policy is trained
    :param rollout: What it collected
    """
    expected = (
        gradients_by_episode(rollout, training_weights(sampler) * rollout.discounts)[0].sum(0) / rollout.denominator
    )
    parameters = scored_parameters(rollout)
    before = to_vector(parameters)
    # As long as θ, where the gradient is shorter: a short step would drown in the rounding of θ
    rate = min(1e6, max(1.0, float(before.norm() / expected.norm())))
    sampler.policy.optimizer = th.optim.SGD(sampler.policy.parameters(), lr=rate)
    sampler.lr_schedule = FloatSchedule(rate)
    sampler.ent_coef, sampler.vf_coef, sampler.max_grad_norm, sampler.min_std = 0.0, 0.0, None, 0.0  # type: ignore[assignment]
    sampler.critic_learning_rate, sampler.normalize_advantage, sampler._sorted_parameters = 0.0, False, ()
    sampler._make_critic_optimizer()
    sampler.train()
    return relative(to_vector(parameters) - before, rate * expected)
