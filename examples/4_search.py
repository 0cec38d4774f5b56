# %% [markdown]
# # Can a policy learn without a single derivative?
#
# `FiniteDifference` perturbs the parameters of a policy, looks at the returns of each perturbed policy and fits a plane
# to them. The slope of the plane estimates the gradient of the utility, smoothed over the perturbations. The slope is
# divided by the standard deviation of the returns and multiplied by the standard deviation of the perturbations, so
# that the scale of the rewards does not matter, and Adam takes the step. The search needs no $\nabla \log \pi$, so the
# policy may be deterministic.

# %%
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_reinforce import FiniteDifference
from sb3_reinforce.diagnostics import CandidateUtility, gradient_statistics
from sb3_reinforce.estimation import PERTURBATIONS, central_difference

seed = 0
th.set_num_threads(1)


# %%
class Print(BaseCallback):
    """One line for each update, with what the algorithm logged of it."""

    def _on_step(self):
        return True

    def _on_rollout_start(self):
        self.print_update()

    def _on_training_end(self):
        self.print_update()

    def print_update(self):
        logged = self.logger.name_to_value
        if "train/r_squared" in logged:
            mean_return, r_squared = logged["rollout/utility_mean"], logged["train/r_squared"]
            print(f"update {logged['train/n_updates']:2d}: mean return {mean_return:5.1f}, R² {r_squared:.2f}")


model = FiniteDifference("LinearPolicy", make_vec_env("CartPole-v1", seed=seed), seed=seed, device="cpu")
print(f"{model.n_parameters} parameters, {model.n_delta} perturbations per update")
model.learn(30_000, callback=Print(), log_interval=None)
mean, std = evaluate_policy(model, make_vec_env("CartPole-v1", 20, seed=1000 + seed), n_eval_episodes=20)
print(f"Mean return of 20 episodes after {model.num_timesteps:,} steps: {mean:.1f} ± {std:.1f}")
assert mean > 450, mean

# %% [markdown]
# There are twice as many perturbations as parameters. Each parameter changes with a standard deviation of 1 % of
# $\|\theta\|$, but at least 0.05. R² is the share of the variance of the returns that the plane explains. All
# candidates start alike and take their most likely actions, so the rest is not noise: the returns curve and jump. Even
# pure noise would have an R² of $n / (k - 1) = 0.53$ on average, with $k = 16$ points and $n = 8$ slopes. If all
# candidates earn the same, R² is NaN.
#
# ## Coordinates or random directions?
#
# Perturb one parameter at a time ("coordinate"), or all at once? Then each change may be normal ("gaussian"), $\pm 1$
# ("rademacher"), or the perturbation has a fixed length ("sphere"). For a linear utility whose halved differences
# $(U(\theta + \delta) - U(\theta - \delta)) / 2$ have independent noise of variance 1, the variance of $\hat g$ is the
# trace of $(\Delta^T \Delta)^{-1}$, where the rows of $\Delta$ are the perturbations. At $k = n$ random directions can
# be almost singular and the mean over draws is infinite, so the table shows the median of 200 draws.

# %%
n, generator = 10, th.Generator().manual_seed(seed)


def variance(name, k):
    """tr (ΔᵀΔ)⁻¹ = Σ 1 / s², with the singular values s of Δ: the median of 200 draws."""
    draws = [PERTURBATIONS[name](k, n, generator) for _ in range(200)]
    return th.stack([th.linalg.svdvals(deltas).pow(-2).sum() for deltas in draws]).median().item()


print("  k   " + "".join(f"{name:>12s}" for name in PERTURBATIONS))
for k in (10, 20, 40):
    print(f"{k:3d}   " + "".join(f"{variance(name, k):12.2f}" for name in PERTURBATIONS))
for name in ("gaussian", "sphere", "rademacher"):
    assert variance(name, 10) > 2 * variance("coordinate", 10)
    assert variance(name, 20) < variance("coordinate", 20) / 2
    # Scaled to the length of coordinates
    assert variance(name, 40) * n > variance("coordinate", 40)

# %% [markdown]
# Ten random directions are nearly dependent, and the solution blows the noise up: for forward or central differences
# with $k = n$ take coordinates. At $k = 2n$ random directions are better, as each measures all parameters at once. The
# price is curvature: they are $\sqrt n$ times as long. Scaled to the length of coordinates, they lose their advantage.
#
# ## Common starts
#
# Each episode of Pendulum starts at another angle, and the start decides much of the return. If all candidates of a
# difference start alike, as they do by default (`common_random_numbers=True`), this luck largely cancels.
# `CandidateUtility` samples the actions; with a small standard deviation most of the noise is in the starts. On
# CartPole starts hardly differ. With several environments common starts only cost steps there, since environments wait
# for each other's episodes: turn them off.

# %%
env = make_vec_env("Pendulum-v1", 8, seed=seed)
pendulum = FiniteDifference("LinearPolicy", env, seed=seed, device="cpu", policy_kwargs={"log_std_init": -1.0})
utility = CandidateUtility(pendulum, 1, seed)


def own_starts(thetas):
    """Each call of ``utility`` has new starts, so a call for each candidate gives each its own."""
    candidates = thetas.reshape(-1, 1, thetas.shape[-1])
    return th.cat([utility(candidate) for candidate in candidates]).reshape(thetas.shape[:-1])


variances = {}
deltas = th.eye(3, dtype=th.float64)
for name, function in (("common starts", utility), ("own starts", own_starts)):
    gradients = th.stack([central_difference(function, utility.theta, deltas) for _ in range(16)])
    variances[name] = gradient_statistics(gradients).variance
    print(f"{name:14s} variance of the gradient {variances[name]}")
print(f"ratio {variances['own starts'].value / variances['common starts'].value:.1f}")
assert variances["own starts"].low > variances["common starts"].high
