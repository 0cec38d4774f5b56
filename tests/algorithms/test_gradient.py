"""
The step of one ``learn()`` against the formula of the class docstring, evaluated in float64 on what the environments
have logged: a linear policy, plain gradient steps at rate 1, so that the parameters move by ĝ itself.

Rewards are powers of ten and observations one-hot, so that every weight of every step can be read from ĝ.
"""

import math

import numpy as np
import pytest
import torch as th
from environments import Corridor
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_reinforce import REINFORCE
from sb3_reinforce.estimation.weights import standardize
from sb3_reinforce.policies.evaluation import evaluate

GAMMA = 0.5
N_OBS = 5


class Logging(Corridor):
    """Episodes of 1 to 5 steps; keeps (t, action, reward, whether the episode ended, and how) of every step."""

    def __init__(self, truncate):
        super().__init__((1, 2, 3, N_OBS), lambda t, action: 10.0**t * (1 + int(action)), truncate=truncate)
        self.log = []

    def step(self, action):
        t = self.t
        new_obs, reward, terminated, truncated, info = super().step(action)
        self.log.append((t, int(action), reward, terminated, truncated))
        return new_obs, reward, terminated, truncated, info


def time_squared(rollout):
    """A user's baseline."""
    return rollout.timesteps.double() ** 2


def learn(n_rollouts=1, n_envs=1, truncate=False, critic_learning_rate=0.0, **kwargs):
    """Train for some rollouts, at rate 0 until the last; return the model, the parameters before, and the logs."""
    env = make_vec_env(lambda: Logging(truncate), n_envs, seed=0)
    model = REINFORCE(
        "MlpPolicy",
        env,
        learning_rate=lambda progress: float(progress < 0.5 / n_rollouts),
        critic_learning_rate=critic_learning_rate,
        gamma=GAMMA,
        policy_kwargs={"net_arch": [], "optimizer_class": th.optim.SGD},
        seed=1,
        device="cpu",
        **{"max_grad_norm": None, **kwargs},
    )
    with th.no_grad():
        for parameter in model.policy.parameters():
            parameter.normal_()
    before = {name: parameter.double().numpy().copy() for name, parameter in model.policy.state_dict().items()}
    model.learn(n_rollouts * (model.n_steps or 1) * n_envs)
    return model, before, [wrapped.unwrapped.log for wrapped in env.envs]


def step_of(model, before):
    after = model.policy.state_dict()
    return {name: after[name].double().numpy() - before[name] for name in ("action_net.weight", "action_net.bias")}


def episodes_of(log):
    """Cut a log into episodes; the last one may be unfinished."""
    episodes = [[]]
    for step in log:
        episodes[-1].append(step)
        if step[3] or step[4]:
            episodes.append([])
    return [episode for episode in episodes if episode]


def one_hot(t):
    return np.eye(N_OBS + 1)[t, :N_OBS]


def formula(
    before, logs, baseline, n_episodes, n_steps, n_rollouts, reward_to_go, discount_scores, normalize_by, lam=1.0
):
    """ĝ of the last rollout, from the definitions."""

    def value(t):
        return (before["value_net.weight"] @ one_hot(t) + before["value_net.bias"]).item()

    def score(t, action):
        logits = before["action_net.weight"] @ one_hot(t) + before["action_net.bias"]
        difference = np.eye(2)[action] - np.exp(logits) / np.exp(logits).sum()
        return np.append(np.outer(difference, one_hot(t)).ravel(), difference)

    critic, n_envs, used = baseline == "value", len(logs), []
    for env, log in enumerate(logs):
        quota = np.inf if n_steps else n_episodes // n_envs + (env < n_episodes % n_envs)
        first_row = (n_rollouts - 1) * n_steps if n_steps else 0
        row = 0
        for number, episode in enumerate(episodes_of(log)):
            rewards = [reward for _, _, reward, _, _ in episode]
            _, _, _, terminated, truncated = episode[-1]
            tail = value(len(episode)) if critic and not terminated else 0.0
            values = [value(t) if critic else 0.0 for t in range(len(episode))] + [tail]
            for t, action, *_ in episode:
                if reward_to_go:
                    # Without a critic, V = 0 and λ = 1: the reward-to-go
                    g = values[t] + sum(
                        (GAMMA * lam) ** (k - t) * (rewards[k] + GAMMA * values[k + 1] - values[k])
                        for k in range(t, len(episode))
                    )
                else:
                    g = sum(GAMMA**k * reward for k, reward in enumerate(rewards)) + GAMMA ** len(episode) * tail
                known = critic or terminated or truncated
                if known and number < quota and row >= first_row:
                    d = GAMMA**t if discount_scores and reward_to_go else 1.0
                    used.append((env, number, t, action, g, d, score(t, action)))
                row += 1

    def b(env, number, t):
        same_t = [step for step in used if step[2] == t]
        if baseline == "mean":
            return np.mean([step[4] for step in used])
        if baseline == "time_mean":
            return np.mean([step[4] for step in same_t])
        if baseline == "leave_one_out":
            others = [step[4] for step in same_t if step[:2] != (env, number)]
            return np.mean(others) if others else 0.0
        if baseline == "optimal":
            above = below = 0.0
            for other in {step[:2] for step in used} - {(env, number)}:
                steps = [step for step in used if step[:2] == other]
                total_score = sum(step[5] * step[6] for step in steps)
                above += sum(step[4] * step[5] * step[6] for step in steps) @ total_score
                below += total_score @ total_score
            return above / below if below else 0.0
        return {"none": 0.0, "value": value(t), time_squared: float(t) ** 2}[baseline]

    terms = np.array([d * s * (g - b(env, number, t)) for env, number, t, _, g, d, s in used])
    scale = sum(np.abs(d * s) * (abs(g) + abs(b(env, number, t))) for env, number, t, _, g, d, s in used)
    denominator = n_steps * n_envs if n_steps else (n_episodes if normalize_by == "episodes" else len(used))
    return terms.sum(axis=0) / denominator, scale / denominator


def assert_step_is(model, before, expected, scale):
    """To float32 precision of what is summed up in each parameter; a wrong weight of one step would show as 1e-2."""
    moved = step_of(model, before)
    ours = np.append(moved["action_net.weight"].ravel(), moved["action_net.bias"])
    assert (np.abs(ours - expected) <= 2e-5 * scale + 1e-5).all(), (ours, expected)


@pytest.mark.filterwarnings("ignore:Episodes that n_steps cuts")
@pytest.mark.filterwarnings("ignore:normalize_by='episodes' has no effect")
@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("truncate", [False, True])
@pytest.mark.parametrize("reward_to_go", [False, True])
@pytest.mark.parametrize(
    ("n_steps", "n_episodes", "normalize_by", "n_rollouts"),
    [(16, None, "steps", 1), (7, None, "episodes", 3), (None, 9, "steps", 1), (None, 6, "episodes", 1)],
)
@pytest.mark.parametrize("baseline", ["none", "mean", "time_mean", "leave_one_out", "value", "optimal", time_squared])
def test_the_step_is_the_formula(
    baseline, n_steps, n_episodes, normalize_by, n_rollouts, reward_to_go, truncate, n_envs
):
    arguments = dict(
        baseline=baseline, n_steps=n_steps, n_episodes=n_episodes, normalize_by=normalize_by,
        reward_to_go=reward_to_go, discount_scores=truncate == reward_to_go,
    )  # fmt: skip
    model, before, logs = learn(n_rollouts, n_envs, truncate, **arguments)
    assert_step_is(model, before, *formula(before, logs, n_rollouts=n_rollouts, **arguments))


@pytest.mark.parametrize("gae_lambda", [0.0, 0.9, 1.0])
@pytest.mark.parametrize("mode", [{"n_steps": 16, "n_episodes": None}, {"n_steps": None, "n_episodes": 9}])
def test_the_step_is_the_formula_with_the_critic_before_this_rollout_trained_it(mode, gae_lambda):
    arguments = dict(baseline="value", reward_to_go=True, discount_scores=False, normalize_by="steps", **mode)
    model, before, logs = learn(1, 4, True, critic_learning_rate=0.5, gae_lambda=gae_lambda, **arguments)
    assert_step_is(model, before, *formula(before, logs, n_rollouts=1, lam=gae_lambda, **arguments))
    assert np.abs(model.policy.value_net.weight.detach().numpy() - before["value_net.weight"]).max() > 1


@pytest.mark.filterwarnings("ignore:Episodes that n_steps cuts")
@pytest.mark.parametrize("discount_scores", [True, False])
def test_normalized_advantages_have_mean_zero_and_deviation_one(discount_scores):
    """The step with normalization is the step of weights shifted and scaled, before the factor γ^t."""
    arguments = dict(baseline="none", n_steps=16, reward_to_go=True, discount_scores=discount_scores)
    plain, before, _ = learn(1, 4, normalize_advantage=True, **arguments)
    used = plain.rollout.used.numpy()
    weights = plain.rollout_buffer.advantages[used].astype(np.float64)
    weights = (weights - weights.mean()) / weights.std(ddof=1)
    weights *= GAMMA ** (plain.rollout.timesteps.numpy()[used] * discount_scores)
    actions = plain.rollout_buffer.actions[used].ravel()
    observations = plain.rollout_buffer.observations[used]
    logits = observations @ before["action_net.weight"].T + before["action_net.bias"]
    scores = np.eye(2)[actions] - np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    expected = (weights[:, None] * scores).T @ observations / (16 * 4)
    np.testing.assert_allclose(step_of(plain, before)["action_net.weight"], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("mode", [{"n_steps": 16}, {"n_episodes": 4}, {"n_episodes": 4, "normalize_by": "episodes"}])
def test_the_entropy_bonus_raises_the_entropy_over_the_same_denominator(mode):
    """The steps with and without it differ by ent_coef · Σ m_t ∇H / denominator, H the entropy at each used step."""
    plain, before, _ = learn(1, 4, baseline="none" if "n_episodes" in mode else "value", **mode)
    model, _, _ = learn(1, 4, baseline="none" if "n_episodes" in mode else "value", ent_coef=1e4, **mode)
    ours = step_of(model, before)["action_net.weight"] - step_of(plain, before)["action_net.weight"]
    rollout = model.rollout
    weight = th.tensor(before["action_net.weight"], requires_grad=True)
    logits = rollout.observations[rollout.used].double() @ weight.T + th.tensor(before["action_net.bias"])
    entropy = -(logits.softmax(1) * logits.log_softmax(1)).sum()
    expected = 1e4 * th.autograd.grad(entropy, weight)[0] / rollout.denominator
    np.testing.assert_allclose(ours, expected, atol=1e-3 * float(expected.abs().max()))
    assert model.logger.name_to_value["train/entropy_loss"] == pytest.approx(-entropy.item() / len(logits), rel=1e-5)


class SharedExtractor(FlattenExtractor):
    """A linear extractor that actor and critic share."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.linear = th.nn.Linear(N_OBS, N_OBS, bias=False)

    def forward(self, observations):
        return self.linear(super().forward(observations))


def test_a_shared_extractor_descends_the_critics_error_too():
    """The steps at two weights of the error differ by (difference of the weights) · ∇ mean (G − V)²."""
    steps, model = [], None
    for vf_coef in (0.0, 0.25):
        env = make_vec_env(lambda: Corridor((N_OBS,), reward=lambda t, action: float(t + action)), 2, seed=0)
        kwargs = {"net_arch": [], "features_extractor_class": SharedExtractor, "optimizer_class": th.optim.SGD}
        model = REINFORCE(
            "MlpPolicy", env, learning_rate=1.0, critic_learning_rate=0.0, vf_coef=vf_coef, n_steps=6,
            max_grad_norm=None, policy_kwargs=kwargs, seed=0, device="cpu",
        )  # fmt: skip
        extractor = model.policy.features_extractor.linear.weight
        before = extractor.detach().clone()
        model.learn(12)
        steps.append(extractor.detach() - before)
    weight = before.clone().requires_grad_()
    features = th.as_tensor(model.rollout_buffer.observations).flatten(0, 1)
    values = features @ weight.T @ model.policy.value_net.weight.T + model.policy.value_net.bias
    error = (th.as_tensor(model.rollout_buffer.returns).flatten() - values.flatten()).square().mean()
    th.testing.assert_close(steps[1] - steps[0], -0.25 * th.autograd.grad(error, weight)[0], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("max_grad_norm", [None, 0.1])
@pytest.mark.parametrize("extent", [{"n_steps": 8}, {"n_episodes": 9}], ids=str)
def test_a_pass_of_the_critic_descends_its_error(extent, max_grad_norm):
    """One pass in one batch at rate 1 is −∇ mean (G − V)², clipped to the norm allowed; G and b are from before."""
    arguments = dict(n_critic_updates=1, batch_size=100, max_grad_norm=max_grad_norm, **extent)
    model, before, _ = learn(1, 4, critic_learning_rate=1.0, **arguments)
    used = model.rollout.used
    assert used.all() == ("n_steps" in extent)
    weight, bias = (th.tensor(before[f"value_net.{name}"], dtype=th.float32) for name in ("weight", "bias"))
    buffer = model.rollout_buffer
    weight.requires_grad_()
    values = (th.as_tensor(buffer.observations)[used] @ weight.T + bias).flatten()
    returns = th.as_tensor(buffer.returns)[used]
    np.testing.assert_allclose(buffer.values[used], values.detach(), rtol=1e-5)
    np.testing.assert_allclose(buffer.advantages[used], returns - values.detach(), rtol=1e-4, atol=1e-3)
    error = (returns - values).square().mean()
    assert model.logger.name_to_value["train/value_loss"] == pytest.approx(error.item(), rel=1e-4)
    expected = -th.autograd.grad(error, weight)[0]
    moved = (model.policy.value_net.weight - weight).detach()
    if max_grad_norm is None:
        th.testing.assert_close(moved, expected, rtol=1e-4, atol=1e-3)
    else:
        bias_moved = model.policy.value_net.bias.detach() - bias
        assert th.cat([moved.flatten(), bias_moved]).norm().item() == pytest.approx(max_grad_norm, rel=1e-3)
        th.testing.assert_close(moved / moved.norm(), expected / expected.norm())
    variance = 1 - (returns - values.detach()).var() / returns.var()
    assert model.logger.name_to_value["train/explained_variance"] == pytest.approx(variance.item(), abs=1e-5)


def test_the_logged_loss_is_the_surrogate_at_the_policy_that_has_acted():
    """−Σ (G − b) log π / denominator."""
    model, before, _ = learn(1, 2, n_episodes=3, baseline="none")
    rollout = model.rollout
    logits = rollout.observations[rollout.used].double() @ th.tensor(before["action_net.weight"]).T
    log_probs = (logits + th.tensor(before["action_net.bias"])).log_softmax(1)
    log_prob = log_probs.gather(1, rollout.actions[rollout.used].long())[:, 0]
    expected = -float(log_prob @ rollout.returns[rollout.used]) / int(rollout.used.sum())
    assert model.logger.name_to_value["train/policy_loss"] == pytest.approx(expected, rel=1e-4)
    assert model.logger.name_to_value["train/n_updates"] == 1


@pytest.mark.parametrize("n", [1, 3, 32, 777])
def test_standardized_weights(n):
    """Divided by their deviation, not its square, unless it is 0 but for rounding, which must not be blown up."""
    same = th.full((n,), 123.4567)
    assert th.equal(standardize(same), same)
    assert standardize(th.tensor([1.0, 7.0])).tolist() == pytest.approx([-(0.5**0.5), 0.5**0.5])


@pytest.mark.parametrize("max_grad_norm", [0.5, 3.0])
def test_clipping_keeps_the_direction(max_grad_norm):
    clipped, before, _ = learn(1, 1, baseline="none", n_episodes=4, max_grad_norm=max_grad_norm)
    free, _, _ = learn(1, 1, baseline="none", n_episodes=4)
    step, whole = (np.append(*map(np.ravel, step_of(model, before).values())) for model in (clipped, free))
    assert np.linalg.norm(step) == pytest.approx(max_grad_norm, rel=1e-4)
    np.testing.assert_allclose(step / max_grad_norm, whole / np.linalg.norm(whole), atol=1e-5)
    assert clipped.logger.name_to_value["train/grad_norm"] == pytest.approx(np.linalg.norm(whole), rel=1e-5)


def test_the_entropy_bonus_raises_the_entropy_of_a_squashed_gaussian():
    """
    H(tanh x) = H(x) + E log(1 − tanh² x) has no closed form, and E ∇ log π = 0: −log π has the right mean, but not the
    right gradient. The derivative by a common shift of log σ is taken by differences with the same noise.
    """
    env = make_vec_env(lambda: Corridor((1,), action_space=spaces.Box(-1, 1, (1,))), 1)
    policy_kwargs = {"squash_output": True, "net_arch": [], "log_std_init": 0.0}
    policy = REINFORCE("MlpPolicy", env, use_sde=True, policy_kwargs=policy_kwargs, seed=0, device="cpu").policy
    obs = th.ones(200_000, 1)
    with th.no_grad():
        distribution = policy.get_distribution(obs).distribution
        mean, std, noise = distribution.mean, distribution.stddev, th.randn(200_000, 1)

        def entropy(shift):
            x = (mean + std * math.exp(shift) * noise).double()
            return float((shift + th.log1p(-x.tanh().square())).mean())

        policy.reset_noise(200_000)
        actions = policy.get_distribution(obs).get_actions()
    _, found, _ = evaluate(policy, obs, actions)
    (gradient,) = th.autograd.grad(found.mean(), [policy.log_std])
    expected = (entropy(0.01) - entropy(-0.01)) / 0.02
    assert abs(expected) > 0.1
    assert gradient.sum().item() == pytest.approx(expected, abs=0.02)
    # The entropy of the Gaussian is log σ + (1 + log 2π) / 2
    gaussian = float(std.log().mean()) + (1 + math.log(2 * math.pi)) / 2
    assert found.mean().item() == pytest.approx(gaussian + entropy(0.0), abs=0.02)
