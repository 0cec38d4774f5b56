# %% [markdown]
# # How large should a difference be?
#
# The oldest way to measure a slope: move a little, and see what changes. Policy and simulator may be black boxes. Along
# a perturbation $\delta$ of the parameters,
#
# $$\text{forward: } \delta^T \hat g \approx U(\theta + \delta) - U(\theta), \qquad
#   \text{central: } 2 \delta^T \hat g \approx U(\theta + \delta) - U(\theta - \delta).$$
#
# For a single parameter $\delta$ is a number. For $n$ parameters these take $n + 1$ and $2n$ evaluations of $U$.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch as th

from sb3_reinforce.estimation import central_difference, fit_quality, forward_difference, regression_gradient

seed = 0
th.manual_seed(seed)

# %% [markdown]
# ## A gradient that is known
#
# Test an estimator where you know the answer: $U(\theta) = -\theta^2$ has the gradient $-2 \theta$. The forward
# difference is off by $\frac{\delta}{2} U'' = -\delta$, whatever $\theta$ is; the central difference is exact, as it is
# for all quadratic utilities.


# %%
def bowl(thetas):
    """−‖θ‖², of candidates of any shape (..., n)."""
    return -thetas.square().sum(-1)


theta = th.tensor([0.5, -0.2, 1.1], dtype=th.float64)
deltas = 0.01 * th.eye(3, dtype=th.float64)
print("truth  ", (-2 * theta).tolist())
print("forward", forward_difference(bowl, theta, deltas).tolist())
print("central", central_difference(bowl, theta, deltas).tolist())
th.testing.assert_close(forward_difference(bowl, theta, deltas), -2 * theta - 0.01)
th.testing.assert_close(central_difference(bowl, theta, deltas), -2 * theta)

# %% [markdown]
# ## Curvature against noise
#
# A utility is a mean of random returns, so each evaluation carries noise. Let $U(x) = x^2$, with the slope wanted at
# $x = 2$. Each evaluation has an independent error of standard deviation $\sigma = 0.1$. The root mean square error of
# the forward difference is then
#
# $$\sqrt{\left(\tfrac{\delta}{2} U''\right)^2 + 2 \sigma^2 / \delta^2}:$$
#
# a long step sees the curvature, a short one divides the noise by a small number. The best step is in between, at
# $\delta^4 = 8 \sigma^2 / U''^2$. The central difference errs by $\sigma / (\sqrt 2 \, \delta)$: a quadratic
# utility adds no error from its curvature, so here the longest step is best. A third derivative would change that.

# %%
sigma, repetitions = 0.1, 1000
steps = np.geomspace(0.02, 2, 13)


def noisy(thetas):
    """x², measured."""
    return thetas.square().sum(-1) + sigma * th.randn(thetas.shape[:-1], dtype=th.float64)


def error(estimator, delta):
    """The root mean square error of the slope at 2."""
    at, along = th.tensor([2.0], dtype=th.float64), th.tensor([[delta]], dtype=th.float64)
    return np.sqrt(np.mean([(estimator(noisy, at, along).item() - 4) ** 2 for _ in range(repetitions)]))


forward = np.array([error(forward_difference, delta) for delta in steps])
central = np.array([error(central_difference, delta) for delta in steps])
theory = np.sqrt(steps**2 + 2 * sigma**2 / steps**2)
best = (8 * sigma**2 / 4) ** 0.25
print(f"best forward step: {steps[forward.argmin()]:.2f} of those tried, {best:.2f} by the formula")
assert 1 / 1.6 < steps[forward.argmin()] / best < 1.6
# The root mean square of 1000 samples is known to 2.2 %
assert np.allclose(forward, theory, rtol=0.1) and np.allclose(central, sigma / steps / 2**0.5, rtol=0.1)

figure, ax = plt.subplots(figsize=(6, 3.6), layout="constrained")
ax.loglog(steps, forward, "o", color="#0072B2", label="forward")
ax.loglog(steps, theory, color="#0072B2", label="forward, by formula")
ax.loglog(steps, central, "s", color="#D55E00", label="central")
ax.loglog(steps, sigma / steps / 2**0.5, color="#D55E00", label="central, by formula")
ax.axvline(best, color="grey", linestyle=":", label="best forward step, by formula")
ax.set(title="Slope of x² at 2, noise 0.1 in each evaluation", xlabel="step δ")
ax.set_ylabel(f"error of the slope (RMS of {repetitions})")
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# ## A signal below its noise
#
# Means of 50 returns with standard deviation 1 have the standard error $1 / \sqrt{50} = 0.14$. At $\delta = 0.01$ two
# of them, 4.23 and 4.41, give the slope 18, with the standard error $0.14 \sqrt 2 / 0.01 = 20$: it may be all noise.
# Ten times the step would have a tenth of the noise.

# %%
slope, standard_error = (4.41 - 4.23) / 0.01, 2**0.5 / 50**0.5 / 0.01
print(f"slope {slope:.0f}, standard error {standard_error:.0f}")
assert round(slope) == 18 and round(standard_error) == 20

# %% [markdown]
# ## A regression knows its errors
#
# The regression gradient perturbs all parameters at once, $k$ times, and fits a plane to the utilities. The rule of
# thumb is $k = 2n$. What the plane does not explain is noise or curvature, so the fit comes with a standard error for
# each component. Here the utility is linear and its noise Gaussian, so errors divided by their standard errors follow
# Student's $t$.

# %%
slopes = th.tensor([2.0, -1.0, 0.5], dtype=th.float64)


def fit(k):
    """The errors of the slopes, and their standard errors."""
    deltas = th.randn(k, 3, dtype=th.float64)
    utilities = (theta + deltas) @ slopes + th.randn(k, dtype=th.float64)
    # The utilities are drawn once: fit_quality must see the same noise
    gradient = regression_gradient(lambda thetas: utilities, theta, deltas)
    return th.stack([gradient - slopes, fit_quality(theta + deltas, utilities, gradient).standard_error])


sizes = {}
# The 97.5 % quantiles of Student's t with k - 4 degrees of freedom: k utilities, less 3 slopes and a level
for k, quantile in {6: 4.303, 12: 2.306, 24: 2.086}.items():
    errors, standard_errors = th.stack([fit(k) for _ in range(300)], dim=1)
    sizes[k] = standard_errors.mean().item()
    share = (errors.abs() < quantile * standard_errors).double().mean().item()
    print(f"k = {k:2d}: mean standard error {sizes[k]:.2f}, {share:.1%} of the truths within the 95 % interval")
    assert abs(share - 0.95) < 0.035
assert sizes[6] > sizes[12] > sizes[24]
