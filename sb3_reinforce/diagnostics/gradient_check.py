"""Is the gradient right? The debugging checklist of the policy gradient, as a function that measures each item."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch as th
from stable_baselines3.common.utils import FloatSchedule

from sb3_reinforce.common.arguments import check_integer
from sb3_reinforce.common.tensors import select, to_vector
from sb3_reinforce.diagnostics.policy_errors import (
    largest_difference,
    log_prob_error,
    relative_difference,
    sampling_error,
    score_error,
    sign_error,
    spread,
)
from sb3_reinforce.diagnostics.sampling import check_model, collect_episodes, seeded, training_weights
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.baselines import BASELINES, Baseline
from sb3_reinforce.estimation.rollout import Rollout, used_inputs
from sb3_reinforce.estimation.scores import gradients_by_episode, parameters_of
from sb3_reinforce.estimation.weights import without_rounding
from sb3_reinforce.policies.evaluation import log_prob_of
from sb3_reinforce.policies.sequences import RecurrentPolicy
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.sampling.measurement import sampling_copy, undisturbed

# By check: the largest error that passes, and what the error compares
CHECKS = {
    "log_prob": (1e-4, "log π(a|s) when drawn and when evaluated"),
    "sampling": (5.0, "mean of −log π(a|s) over sampled actions and the entropy, in standard errors"),
    "scores": (0.02, "∇ log π by autograd and by finite differences"),
    "sign": (0.0, "fraction of sampled actions that a step along their own score makes less likely"),
    "returns": (1e-4, "G_t and its definition from the rewards"),
    "weights": (1e-4, "the weights used in training and γ^t (G_t − b_t)"),
    "surrogate": (1e-3, "the step of train() and Σ w_t ∇ log π"),
}


@dataclass(frozen=True)
class CheckRow:
    """
    One item of the checklist.

    :param check: What was checked
    :param error: How far the two sides are apart
    :param allowed: The largest error that passes
    :param passed: Whether it passes
    :param meaning: What the error compares
    """

    check: str
    error: float
    allowed: float
    passed: bool
    meaning: str


class CheckTable(Table[CheckRow]):
    """The items of a gradient check."""

    @property
    def passed(self) -> bool:
        """Whether every item passes."""
        return all(row.passed for row in self)

    @property
    def failures(self) -> list[str]:
        """The names of the items that fail."""
        return [row.check for row in self if not row.passed]


def check_gradient(model: REINFORCE, n_episodes: int = 4, seed: int = 0) -> CheckTable:
    """
    Check the chain from the environment to the gradient, on whole episodes that the model itself collects.

    - ``log_prob``: the log π that training differentiates is the log π of the sampled actions.
    - ``sampling``: actions are sampled with these probabilities, as far as their mean log π shows it.
    - ``scores``: the gradient of log π by autograd equals its gradient by finite differences.
    - ``sign``: after a step along the score of an action, the policy samples it more often, or samples closer to it.
      ``log_std`` is left out. A policy that always samples the same action, or trains nothing but ``log_std``, cannot
      be checked, and does not pass.
    - ``returns`` and ``weights``: G_t and γ^t (G_t − b_t) follow from the rewards by their definitions. The model's
      ``discount_scores`` and ``normalize_advantage`` are taken into account.
    - ``surrogate``: the step of ``train()`` is the sum of the weighted scores.

    Custom policies and subclasses of REINFORCE are checked as they are. With gSDE ``scores`` fails if layers before the
    last are trained: Stable-Baselines3 detaches the features on which the standard deviation depends, unless
    ``policy.action_dist.learn_features`` is set. ``scores`` can also fail by rounding if observations are far from 1,
    below about 0.01 or above 1,000: normalize them.

    :param model: The model; it is not changed, but a baseline with memory learns from these episodes too. The
        environments are left at the start of an episode
    :param n_episodes: Number of episodes, at least 2
    :param seed: Seed of the actions and of the directions of the finite differences
    :return: A table with one ``CheckRow`` per item; ``.passed`` is True if all of them pass
    :raises TypeError: If the model is not a REINFORCE
    :raises ValueError: If an argument is out of its range, log π cannot be differentiated, or the model has no
        environment or is collecting a rollout
    """
    check_model(model)
    check_integer("n_episodes", n_episodes, 2)
    policy = model.policy
    optimizer = policy.optimizer
    state = {name: value.clone() for name, value in policy.state_dict().items()}
    with seeded(policy, check_integer("seed", seed, 0)):
        try:
            errors = measure_errors(model, n_episodes)
        finally:
            policy.load_state_dict(state)
            policy.optimizer = optimizer
    rows = [
        CheckRow(check, errors[check], allowed, bool(errors[check] <= allowed), meaning)
        for check, (allowed, meaning) in CHECKS.items()
    ]
    legend = {"error": "how far the two sides of `meaning` are apart", "passed": "whether error <= allowed"}
    return CheckTable(f"Gradient check of {type(policy).__name__} ({n_episodes} episodes)", rows, legend)


class Recorded:
    """A baseline that keeps what it has returned: one with memory would return something else the next time."""

    def __init__(self, function: Baseline):
        self.function = function

    def __call__(self, rollout: Rollout) -> th.Tensor:
        self.values = self.function(rollout)
        return self.values


def measure_errors(model: REINFORCE, n_episodes: int) -> dict[str, float]:
    """The error of each check; the last one trains the model's policy."""
    baseline = Recorded(model.baseline) if callable(model.baseline) else model.baseline
    collector = sampling_copy(model, n_episodes, baseline)
    with undisturbed(model):
        rollout = collect_episodes(collector)
    policy = rollout.policy
    # An error where log π cannot be differentiated
    parameters_of(rollout)
    obs, actions = used_inputs(rollout)
    some_obs, some_actions = spread(policy, obs, actions)
    if isinstance(policy, RecurrentPolicy):
        # Its ``forward`` has no sequences: log π is compared as it was when the episodes were played
        played = select(th.as_tensor(collector.rollout_buffer.log_probs), rollout.used)
        difference = largest_difference(log_prob_of(policy, obs, actions).detach().cpu(), played)
    else:
        difference = log_prob_error(policy, some_obs)
    return {
        "log_prob": difference,
        "sampling": sampling_error(policy, obs, len(actions)),
        "scores": score_error(policy, some_obs, some_actions),
        "sign": sign_error(policy, obs, len(actions)),
        "returns": return_error(collector, rollout),
        "weights": weight_error(collector, rollout),
        "surrogate": surrogate_error(collector, rollout),
    }


@np.errstate(under="ignore")
def return_by_definition(rewards: np.ndarray, next_values: np.ndarray, gamma: float, lam: float) -> np.ndarray:
    """
    ``G_t = (1 − λ) Σ_{n=1}^{N−1} λ^{n−1} G_{t:t+n} + λ^{N−1} G_{t:t+N}``, ``G_{t:t+n} = Σ_{k<n} γ^k r_{t+k} + γ^n V``,
    for rewards and V(s_{t+1}) of one episode, each of shape (T,).

    Sutton and Barto (2018), equations 12.1 and 12.9, term by term instead of by a recursion.
    """
    returns = np.zeros(len(rewards))
    for t in range(len(rewards)):
        n = np.arange(1, len(rewards) - t + 1)
        n_step = np.cumsum(gamma ** (n - 1) * rewards[t:]) + gamma**n * next_values[t:]
        shares = np.where(n < n[-1], (1 - lam) * lam ** (n - 1.0), lam ** (n - 1.0))
        returns[t] = shares @ n_step
    return returns


def steps_by_episode(rollout: Rollout) -> Iterator[tuple[th.Tensor, ...]]:
    """The steps and environments of each episode, in the order in which they were played."""
    for episode in rollout.used_episodes:
        yield ((rollout.episodes == episode) & rollout.used).nonzero(as_tuple=True)


def return_error(collector: REINFORCE, rollout: Rollout) -> float:
    """The largest difference between a return and its definition, relative to the largest return."""
    expected = th.zeros_like(rollout.returns)
    for steps, envs in steps_by_episode(rollout):
        values = np.zeros(len(steps)) if rollout.next_values is None else rollout.next_values[steps, envs].numpy()
        rewards = rollout.rewards[steps, envs].numpy()
        returns = return_by_definition(rewards, values, collector.gamma, collector.gae_lambda)
        expected[steps, envs] = th.as_tensor(returns if collector.reward_to_go else np.full_like(returns, returns[0]))
    differences = (rollout.returns - expected)[rollout.used]
    return float(differences.abs().max() / expected.abs().max().clamp(min=1e-12))


def weight_error(collector: REINFORCE, rollout: Rollout) -> float:
    """
    The relative difference between the weights of ``train()`` and γ^t (G_t − b_t), normalized as the model does; γ^t
    only with ``discount_scores`` and returns to go.
    """
    baseline = collector.baseline
    values = baseline.values if isinstance(baseline, Recorded) else BASELINES[cast(str, baseline)](rollout)
    differences = without_rounding(rollout.returns - values.cpu(), rollout.returns).float()[rollout.used]
    expected = th.zeros_like(rollout.returns)
    if collector.normalize_advantage and differences.max() > differences.min():
        differences = (differences - differences.mean()) / (differences.std() + 1e-8)
    expected[rollout.used] = differences.double()
    if collector.discount_scores and collector.reward_to_go:
        for steps, envs in steps_by_episode(rollout):
            expected[steps, envs] *= collector.gamma ** th.arange(len(steps), dtype=th.float64)
    return relative_difference(training_weights(collector), expected)


def surrogate_error(collector: REINFORCE, rollout: Rollout) -> float:
    """A step of ``train()`` by SGD, without entropy bonus and clipping, against ``Σ_t w_t ∇ log π / D``."""
    gradients = gradients_by_episode(rollout, training_weights(collector))[0]
    by_steps = collector.normalize_by == "steps"
    expected = gradients.sum(0) / (int(rollout.used.sum()) if by_steps else len(rollout.used_episodes))
    parameters = parameters_of(rollout)
    before = to_vector(parameters)
    # A step as long as θ where the gradient is shorter: a short one would drown in the rounding of θ
    rate = min(1e6, max(1.0, float(before.norm() / expected.norm())))
    collector.policy.optimizer = th.optim.SGD(collector.policy.parameters(), lr=rate)
    # A ``CheckedSchedule`` would be made again from ``learning_rate``
    collector.lr_schedule = FloatSchedule(rate)
    # Without values no critic is trained
    collector.rollout = replace(rollout, values=None)
    collector.step = "optimizer"
    collector.ent_coef = 0.0
    collector.max_grad_norm = None  # type: ignore[assignment]
    collector.min_std = 0.0
    collector.train()
    return relative_difference(to_vector(parameters) - before, rate * expected)
