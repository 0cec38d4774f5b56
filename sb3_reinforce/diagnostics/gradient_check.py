"""Is the gradient right? The debugging list of the policy gradient, as a function that measures each item."""

from dataclasses import dataclass

from sb3_reinforce.common.arguments import check_integer
from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import select
from sb3_reinforce.diagnostics.policy_errors import log_prob_error, score_error, sign_error, some
from sb3_reinforce.diagnostics.rollout_errors import return_error, surrogate_error, weight_error
from sb3_reinforce.diagnostics.sampling import check_model, sampled, seeded
from sb3_reinforce.diagnostics.tables import Table
from sb3_reinforce.estimation.scores import scored_parameters
from sb3_reinforce.reinforce import REINFORCE


@dataclass(frozen=True)
class CheckRow:
    """
    One line of the debugging list.

    :param check: What was checked
    :param error: The figure: how far the two sides are apart
    :param allowed: The largest figure that passes
    :param passed: Whether it does
    :param meaning: What the figure compares
    """

    check: str
    error: float
    allowed: float
    passed: bool
    meaning: str


class CheckTable(Table[CheckRow]):
    """The lines of a gradient check."""

    @property
    def passed(self) -> bool:
        """Whether every line passes."""
        return all(row.passed for row in self)

    @property
    def failures(self) -> list[str]:
        """The names of the lines that fail."""
        return [row.check for row in self if not row.passed]


def check_gradient(model: REINFORCE, n_episodes: int = 4, seed: int = 0) -> CheckTable:
    """
    Check the chain from the environment to the gradient, on whole episodes that the model itself collects.

    ``log_prob``: log π that training differentiates is log π of the actions drawn. ``scores``: its gradient by autograd
    is that by finite differences. ``sign``: a step along the score of an action makes the policy draw it more often, or
    draw nearer to it; a policy that always draws the same cannot be checked for it, and does not pass. ``returns`` and
    ``weights``: G_t and G_t − b_t follow from the rewards by their definitions. ``surrogate``: the step of ``train()``
    is the sum of the weighted scores. A policy of one's own, or a subclass of REINFORCE, is checked as it is. With gSDE
    ``scores`` fails as Stable-Baselines3 makes it: the standard deviation's dependence on the features is detached
    there, unless ``policy.action_dist.learn_features`` is set.

    :param model: The model; it is not changed, and its environments are left at the start of an episode
    :param n_episodes: Episodes, at least 2
    :param seed: Seed of the draws and of the directions of the finite differences
    :return: A table with a ``CheckRow`` each; ``.passed`` tells whether all of them hold
    :raises TypeError: If the model is not a REINFORCE
    :raises ValueError: If there are too few episodes, or log π cannot be differentiated
    """
    check_model(model)
    check_integer("n_episodes", n_episodes, 2)
    policy, optimizer = model.policy, model.policy.optimizer
    state = {name: value.clone() for name, value in policy.state_dict().items()}
    with seeded(policy, check_integer("seed", seed, 0)):
        try:
            rows = check_rows(model, n_episodes)
        finally:
            policy.load_state_dict(state)
            policy.optimizer = optimizer
    return CheckTable(f"Gradient check of {type(policy).__name__} ({n_episodes} episodes)", rows)


def check_rows(model: REINFORCE, n_episodes: int) -> list[CheckRow]:
    """
    The lines of ``check_gradient``; the model's policy is trained by the last.

    :param model: The model
    :param n_episodes: Episodes
    """
    sampler, infos = sampled(model, n_episodes, model.baseline)
    policy, rollout = sampler.policy, sampler.rollout
    assert rollout is not None
    obs = select(rollout.observations, rollout.used)
    actions = as_policy_actions(select(rollout.actions, rollout.used), model.action_space)
    scored_parameters(rollout)
    return [
        row(
            "log_prob", log_prob_error(policy, some(obs, actions)[0]), 1e-4, "log π(a|s) when drawn and when evaluated"
        ),
        row("scores", score_error(policy, *some(obs, actions)), 0.02, "∇ log π by autograd and by differences"),
        row("sign", sign_error(policy, obs), 0.0, "share of actions that their own score repels"),
        row("returns", return_error(sampler, rollout, infos), 1e-4, "G_t and its definition, from the rewards"),
        row("weights", weight_error(sampler, rollout), 1e-4, "the weights of training and G_t − b_t"),
        row("surrogate", surrogate_error(sampler, rollout), 1e-3, "the step of train() and Σ w_t ∇ log π"),
    ]


def row(check: str, error: float, allowed: float, meaning: str) -> CheckRow:
    """
    A line, which passes if the error is not above what is allowed; NaN fails.

    :param check: What was checked
    :param error: The figure
    :param allowed: The largest figure that passes
    :param meaning: What the figure compares
    """
    return CheckRow(check, error, allowed, bool(error <= allowed), meaning)
