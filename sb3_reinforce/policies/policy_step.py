"""The policy's step along ĝ, as ``critic`` has the critic's passes."""

import torch as th
from stable_baselines3.common.policies import ActorCriticPolicy
from torch.nn import functional as F

from sb3_reinforce.common import optimization
from sb3_reinforce.estimation.weights import Steps
from sb3_reinforce.policies.evaluation import Parameters, evaluate


def step_policy(
    policy: ActorCriticPolicy,
    parameters: Parameters,
    steps: Steps,
    denominator: int,
    ent_coef: float,
    vf_coef: float | None,
    max_grad_norm: float | None,
) -> dict[str, float]:
    """
    One step of the policy's optimizer that lowers

        ``L = −Σ_t [w_t log π(a_t|s_t) + ent_coef · H(π(·|s_t))] / D + vf_coef · mean_t (G_t − V(s_t))²``

    whose first term has the gradient −ĝ (Williams, 1992, equation 4).

    :param policy: The policy
    :param parameters: The parameters to change
    :param steps: The steps, with w_t and G_t
    :param denominator: D
    :param ent_coef: Weight of the entropy H
    :param vf_coef: Weight of the critic's squared error; None without it: no features extractor is shared
    :param max_grad_norm: Bound on the norm of the gradient, None for no bound
    :return: ``entropy_loss``, ``policy_loss`` and ``grad_norm`` (before clipping), for the log
    :raises ValueError: If the gradient is not finite, or a parameter would not be; the parameters are those before
    """
    log_prob, entropy, values = evaluate(policy, steps.observations, steps.actions, with_values=vf_coef is not None)
    policy_loss = -(steps.weights * log_prob).sum() / denominator
    loss = policy_loss - ent_coef * entropy.sum() / denominator
    if vf_coef is not None and values is not None:
        loss = loss + vf_coef * F.mse_loss(values, steps.returns)
    gradient = th.autograd.grad(loss, parameters, allow_unused=True)
    with optimization.kept_finite(policy.optimizer, parameters, "policy"):
        grad_norm = optimization.step(policy.optimizer, parameters, gradient, max_grad_norm, "policy")
    return {"entropy_loss": -entropy.mean().item(), "policy_loss": policy_loss.item(), "grad_norm": grad_norm}
