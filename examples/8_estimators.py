# %% [markdown]
# # Where do the estimators point?
#
# For $\gamma = 1$, small perturbations and a policy that samples its actions, the likelihood ratio and the finite
# differences estimate the same gradient. (Page 4 took the most likely actions, whose utility is another one.) First:
# are the estimates right? Then: which estimator needs the fewest steps? Last, a picture.

# %%
import matplotlib.pyplot as plt
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import (
    CandidateUtility,
    check_gradient,
    compare_estimators,
    landscape,
    sample,
)
from sb3_reinforce.diagnostics.plots import plot_landscape
from sb3_reinforce.estimation import BASELINES, gradients_by_episode, regression_gradient

seed = 0
th.set_num_threads(1)

# %%
env = make_vec_env("CartPole-v1", n_envs=8, seed=seed)
policy_kwargs = {"net_arch": {"pi": [], "vf": [64]}}
model = REINFORCE("MlpPolicy", env, gamma=1.0, seed=seed, device="cpu", policy_kwargs=policy_kwargs)
model.learn(5_000)

# %% [markdown]
# ## The checklist
#
# If a policy does not learn, check the gradient before anything else: the score against finite differences of $\log
# \pi$, its sign, the returns, the weights, and the step that `train()` takes.

# %%
check = check_gradient(model)
print(check)
assert check.passed

# %% [markdown]
# ## Signal from a step
#
# One estimate is one episode for the likelihood ratio, whose baseline comes from the other episodes. For the others it
# is one episode for each perturbed policy. Each parameter is perturbed alone: by +1 and −1 in a central difference, by
# one of the two at random in a forward one. The error that curvature adds to a forward difference therefore cancels in
# the mean, but is noise in each estimate. A regression would use both signs and solve the equation of the central
# difference, so it is left out. The perturbations are large, since the noise of single episodes drowns smaller
# differences. The cosine is between the *expected* estimate and the likelihood-ratio gradient of 400 other episodes.
# The signal-to-noise ratio is divided by the steps. Perturbed policies that share a start wait for the longest episode
# of their round, and these steps count: with one environment the differences need fewer.

# %%
estimators = ("likelihood_ratio", "forward", "central")
table = compare_estimators(model, n_episodes=400, n_estimates=60, estimators=estimators, seed=seed)
print(table)
likelihood_ratio, forward, central = (row.snr_per_step.value for row in table)
assert likelihood_ratio > 3 * max(forward, central)
assert table["forward"].snr_per_step.high < table["central"].snr_per_step.low

# %% [markdown]
# Use the likelihood ratio if the policy can be differentiated. For other policies the guide to `FiniteDifference`
# recommends a regression up to about 20 parameters, and central differences from 20 to 500.
#
# ## A picture
#
# $U(\theta)$ on a plane through $\theta$: along the gradient of 1000 episodes, and along a random direction at a right
# angle to it. A single estimate is one draw, so eight of each are drawn. The angle of a fan is the noise within the
# plane; the printed cosines count all ten parameters. The fans have 10, 20 and 200 episodes for an estimate. The
# regression changes each parameter with a standard deviation of 0.3. The picture reaches to eight times $\|\theta\|$ on
# each side, since the policy is new and $\theta$ small. Ten times as many perturbations raise the regression's mean
# cosine and narrow its fan. The plane contains the gradient, so fans look closer to it than they are in all ten
# dimensions.


# %%
def score_gradient(baseline, n_episodes):
    """The gradient of some episodes."""
    rollout = sample(model, n_episodes)
    (gradients,) = gradients_by_episode(rollout, rollout.returns - BASELINES[baseline](rollout))
    return gradients.mean(0).double()


utility = CandidateUtility(model, n_episodes=1, seed=seed)
n = len(utility.theta)


def regression(n_delta):
    """A finite-difference regression, with one episode for each perturbed policy."""
    return regression_gradient(utility, utility.theta, 0.3 * th.randn(n_delta, n, dtype=th.float64))


truth = score_gradient("value", 1000)
fans = {
    "REINFORCE, no baseline, 10 episodes": [score_gradient("none", 10) for _ in range(8)],
    "REINFORCE, critic, 10 episodes": [score_gradient("value", 10) for _ in range(8)],
    "regression, 20 perturbations": [regression(20) for _ in range(8)],
    "regression, 200 perturbations": [regression(200) for _ in range(8)],
}
fans = {name: th.stack(fan) for name, fan in fans.items()}
cosines = {name: th.cosine_similarity(fan, truth[None]).mean().item() for name, fan in fans.items()}
for name, cosine in cosines.items():
    print(f"{name:38s} mean cosine to the gradient {cosine:+.2f}")
few, many = (cosines[f"regression, {n_delta} perturbations"] for n_delta in (20, 200))
assert few + 0.15 < many and many > 0.6

# %%
drawn = th.randn(n, dtype=th.float64)
plane = th.stack([truth, drawn - drawn @ truth / (truth @ truth) * truth])
found = landscape(model, fans, plane, extent=8.0, n_points=9, n_episodes=24, seed=seed)
plot_landscape(found)
plt.show()
