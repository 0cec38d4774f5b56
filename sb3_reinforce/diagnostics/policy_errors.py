"""What ``gradient_check`` measures of a policy: how far the two sides of each identity of log π are apart."""

from collections.abc import Callable

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_reinforce.common.spaces import as_policy_actions
from sb3_reinforce.common.tensors import take, to_vector
from sb3_reinforce.estimation.scores import score_parameters
from sb3_reinforce.policies.evaluation import Parameters, log_prob_and_entropy

# Draws behind a frequency or a mean action, and for observations of more elements than LARGE
N_DRAWS, N_DRAWS_LARGE, LARGE = 1024, 256, 4096
# Elements of the observations whose log π is differentiated by differences
N_ELEMENTS = 2**21


def relative(x: th.Tensor, y: th.Tensor) -> float:
    """
    ``‖x − y‖ / max(‖x‖, ‖y‖)``, and 0 where both are zero.

    :param x: Any tensor
    :param y: A tensor of the same shape
    """
    scale = max(float(x.norm()), float(y.norm()))
    return float((x - y).norm()) / scale if scale > 0 else 0.0


@th.no_grad()
def log_prob_error(policy: ActorCriticPolicy, obs: PyTorchObs) -> float:
    """
    The largest difference between log π of drawn actions as ``forward`` and as training tell it.

    :param policy: The policy
    :param obs: Observations
    """
    drawn, _, log_prob = policy(obs)
    evaluated, _ = log_prob_and_entropy(policy, obs, flat_actions(policy, drawn))
    return float(((evaluated - log_prob).abs() / log_prob.abs().clamp(min=1)).max())


def size_of(obs: PyTorchObs) -> int:
    """
    The number of elements of one observation.

    :param obs: ``n`` observations
    """
    parts = list(obs.values()) if isinstance(obs, dict) else [obs]
    return sum(part[0].numel() for part in parts)


def some(obs: PyTorchObs, actions: th.Tensor) -> tuple[PyTorchObs, th.Tensor]:
    """
    Steps spread evenly over a rollout, as many as ``N_ELEMENTS`` allow.

    :param obs: ``n`` observations
    :param actions: ``n`` actions
    """
    allowed = max(1, N_ELEMENTS // size_of(obs))
    steps = th.arange(0, len(actions), -(-len(actions) // allowed))
    return take(obs, steps), actions[steps]


def flat_actions(policy: ActorCriticPolicy, drawn: th.Tensor) -> th.Tensor:
    """
    Drawn actions in the form that ``evaluate_actions`` takes.

    :param policy: The policy
    :param drawn: ``n`` actions as ``forward`` returns them
    """
    return as_policy_actions(drawn.reshape(len(drawn), -1), policy.action_space)


def score_error(policy: ActorCriticPolicy, obs: PyTorchObs, actions: th.Tensor, n_directions: int = 16) -> float:
    """
    ``⟨∇L, u⟩`` against ``(L(θ + h u) − L(θ − h u)) / 2h`` for random u; ``L = Σ ± log π(a_t|s_t)`` with random signs.

    :param policy: The policy
    :param obs: ``n`` observations
    :param actions: ``n`` actions
    :param n_directions: Number of directions
    :return: ``‖by autograd − by differences‖ / ‖by differences‖`` over the directions, for the h that is best: where
        log π is curved much, only a short one is, and a wrong gradient is wrong for all
    """
    parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
    signs = 2.0 * th.randint(2, (len(actions),)).to(actions.device) - 1

    def objective() -> th.Tensor:
        return (log_prob_and_entropy(policy, obs, actions)[0].double() * signs).sum()

    found = th.autograd.grad(objective(), parameters, allow_unused=True)
    gradient = th.cat(
        [th.zeros_like(p).flatten() if g is None else g.flatten() for p, g in zip(parameters, found, strict=True)]
    ).double()
    theta = to_vector(parameters)
    directions = th.nn.functional.normalize(th.randn(n_directions, len(theta), device=theta.device))
    errors = []
    # In float32 the rounding of log π and the third derivative are usually in balance near eps^(1/3), the first
    for h in (5e-3, 5e-4, 5e-5):
        step = h * max(1.0, float(theta.norm()))
        differences = th.stack([difference(objective, parameters, theta, step * each) for each in directions])
        errors.append(relative(directions.double() @ gradient, differences / (2 * step)))
    return min(errors)


@th.no_grad()
def difference(
    function: Callable[[], th.Tensor], parameters: Parameters, theta: th.Tensor, step: th.Tensor
) -> th.Tensor:
    """
    ``f(θ + step) − f(θ − step)``.

    :param function: f of the parameters
    :param parameters: They are left at θ
    :param theta: θ, shape ``(n,)``
    :param step: Shape ``(n,)``
    """
    values = []
    for moved in (theta + step, theta - step):
        th.nn.utils.vector_to_parameters(moved, parameters)
        values.append(function())
    th.nn.utils.vector_to_parameters(theta, parameters)
    return values[0] - values[1]


def sign_error(policy: ActorCriticPolicy, obs: PyTorchObs, n_actions: int = 8) -> float:
    """
    The share of drawn actions from which the policy moves away by a step along their own score, ``θ + h ∇ log π(a|s)``.

    Whether it does is seen from what it draws, not from any log π: see ``closeness``.

    :param policy: The policy
    :param obs: ``n`` observations
    :param n_actions: Actions to try, at most n
    :return: NaN if all draws are alike, as those of a policy without randomness are: nothing could be tried
    """
    n_obs = len(next(iter(obs.values())) if isinstance(obs, dict) else obs)
    wrong, tried = 0, 0
    n_draws = N_DRAWS_LARGE if size_of(obs) > LARGE else N_DRAWS
    for index in th.randperm(n_obs)[:n_actions]:
        repeated = take(obs, index.repeat(n_draws))
        with th.no_grad():
            draws = draw(policy, repeated, n_draws)
        # Of a few draws the one that is farthest from the rest: a step along its score is the plainest to see
        action = draws[int(th.stack([closeness(policy, draws, draws[i]) for i in range(8)]).argmin())]
        before, after = closeness_after_step(policy, repeated, action, n_draws)
        if before < closeness(policy, action[None].expand_as(draws), action):
            wrong, tried = wrong + int(after <= before), tried + 1
    return wrong / tried if tried else float("nan")


def draw(policy: ActorCriticPolicy, obs: PyTorchObs, n_draws: int) -> th.Tensor:
    """
    Independent actions; with gSDE each by a noise matrix of its own.

    :param policy: The policy
    :param obs: One observation, ``n_draws`` times
    :param n_draws: Their number
    """
    if policy.use_sde:
        policy.reset_noise(n_draws)
    return flat_actions(policy, policy(obs)[0])


def closeness(policy: ActorCriticPolicy, draws: th.Tensor, action: th.Tensor) -> th.Tensor:
    """
    How near draws are to an action: the mean share of equal components, or for a Box minus the distance of their mean.

    :param policy: The policy
    :param draws: Shape ``(n,)`` or ``(n, action_dim)``
    :param action: Shape ``()`` or ``(action_dim,)``
    """
    if isinstance(policy.action_space, spaces.Box):
        distance: th.Tensor = (draws.mean(0) - action).norm()
        return -distance
    return (draws == action).double().mean()


def closeness_after_step(
    policy: ActorCriticPolicy, obs: PyTorchObs, action: th.Tensor, n_draws: int
) -> tuple[th.Tensor, th.Tensor]:
    """
    ``closeness`` before and after a step along the score of an action, with the same random numbers.

    :param policy: The policy; it is left as it was
    :param obs: One observation, ``n_draws`` times
    :param action: The action
    :param n_draws: Actions to draw before and after
    """
    parameters = score_parameters(policy, take(obs, th.arange(1)), action[None])
    log_prob, _ = log_prob_and_entropy(policy, take(obs, th.arange(1)), action[None])
    gradient = to_vector(th.autograd.grad(log_prob.sum(), parameters))
    theta = to_vector(parameters)
    # To first order, log π(a|s) rises by this much
    step = 0.3 * gradient / gradient.square().sum().clamp(min=1e-12)
    results, seed = [], int(th.randint(2**31, ()))
    for values in (theta, theta + step):
        th.nn.utils.vector_to_parameters(values, parameters)
        with th.random.fork_rng(devices=[]), th.no_grad():
            th.manual_seed(seed)
            results.append(closeness(policy, draw(policy, obs, n_draws), action))
    th.nn.utils.vector_to_parameters(theta, parameters)
    return results[0], results[1]
