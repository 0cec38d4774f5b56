"""Utilities on a plane, estimators at one θ, and the pictures of what was measured."""

import importlib
import math
import sys
from functools import partial

import numpy as np
import pytest
import torch as th
from callbacks import Record
from enumeration import make_model, true_gradient
from environments import Corridor, Scales, Tree, Wrapper
from gymnasium import spaces
from stable_baselines3 import A2C
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import compare_baselines, compare_estimators, estimator_comparison, landscape, plots
from sb3_reinforce.diagnostics.estimator_comparison import likelihood_ratio
from sb3_reinforce.diagnostics.landscapes import CandidateUtility, filter_normalized
from sb3_reinforce.diagnostics.tables import Estimate, Table
from sb3_reinforce.estimation.perturbations import default_delta_std
from sb3_reinforce.policies.evaluation import set_temperature


def bandit(algorithm=REINFORCE, n_envs=8, **kwargs):
    """Action 1 is worth 1, action 0 nothing: U = π(1), whatever the observation."""
    env = make_vec_env(lambda: Corridor((1,), lambda t, action: float(action)), n_envs, seed=0)
    return algorithm("MlpPolicy", env, policy_kwargs={"net_arch": []}, device="cpu", seed=0, **kwargs)


@pytest.mark.parametrize("is_later", [False, True])
def test_the_utility_is_that_of_the_sampling_policy_at_its_temperature(is_later):
    temperature = 0.2
    model = bandit(n_envs=40, temperature=1.0 if is_later else temperature)
    utility = CandidateUtility(model, 1000, seed=0)
    set_temperature(model.policy, temperature)
    thetas = utility.theta + th.tensor([0.0, 1.0, -1.0])[:, None] * th.tensor([0.0, 0.0, 0.0, 2.0 * temperature])
    with th.no_grad():
        expected = float(model.policy.get_distribution(th.ones(1, 1)).distribution.logits.diff())
    expected = [1 / (1 + np.exp(-expected - 2.0 * x)) for x in (0, 1, -1)]
    np.testing.assert_allclose(utility(thetas).numpy(), expected, atol=0.06)
    assert utility.n_steps >= 3000
    assert utility(thetas.reshape(1, 3, -1)).shape == (1, 3)


def test_the_likelihood_ratio_is_the_gradient_of_the_tree():
    """Asked of a model with γ = ½, which is set aside."""
    gradients, n_steps = likelihood_ratio(make_model(env=DummyVecEnv([Tree] * 40)), 2000)
    truth = true_gradient(Tree().trajectories(), lambda episode: sum(reward for _, _, reward in episode))
    assert gradients.shape == (2000, 6)
    assert n_steps == 4000
    error = gradients.mean(0) - truth.T.flatten()
    assert (error.abs() <= 4.5 * gradients.std(0) / 2000**0.5).all()


def test_the_likelihood_ratio_has_the_mean_of_the_others_as_baseline():
    """Without it a return of 1000 or 1001 would leave gradients of some hundreds."""
    env = make_vec_env(lambda: Corridor((1,), lambda t, action: 1000.0 + action), 4, seed=0)
    model = REINFORCE("MlpPolicy", env, policy_kwargs={"net_arch": []}, device="cpu", seed=0)
    assert likelihood_ratio(model, 200)[0].std(0).max() < 2


def test_pictures_without_matplotlib_say_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "sb3_reinforce.diagnostics.plots", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'sb3-reinforce\[plots\]'"):
        importlib.import_module("sb3_reinforce.diagnostics.plots")


@pytest.mark.parametrize(
    ("perturbation", "sentence"),
    [
        (lambda k, n, generator: th.randn(k, n, generator=generator), None),
        (lambda k, n, generator: th.randn(k, n + 1, generator=generator), "perturbation must return a tensor of shape"),
    ],
)
def test_the_estimators_take_the_perturbations_that_a_search_takes(perturbation, sentence):
    if sentence is None:
        assert len(compare_estimators(bandit(), 4, 3, perturbation=perturbation)) == 4
    else:
        with pytest.raises(ValueError, match=sentence):
            compare_estimators(bandit(), 4, 3, perturbation=perturbation)


def test_the_steps_of_each_estimator_are_those_of_its_episodes():
    """Episodes have one step. U(θ) of the forward difference costs eight, one of each environment."""
    table = compare_estimators(bandit(), 8, 3, perturbation="sphere", n_delta=16, n_resamples=5)
    expected = {"likelihood_ratio": 1, "forward": 16 + 8, "central": 2 * 16, "regression": 16}
    assert {row.estimator: row.steps for row in table} == expected


def test_the_default_scale_of_perturbations_is_the_rule_of_thumb(monkeypatch):
    model = bandit()
    first_theta = []
    evaluated = []
    evaluate = CandidateUtility.__call__

    def record(utility, thetas):
        first_theta.append(utility.theta)
        evaluated.append(thetas - utility.theta)
        return evaluate(utility, thetas)

    monkeypatch.setattr(CandidateUtility, "__call__", record)
    ones = lambda k, n, generator: th.ones(k, n)  # noqa: E731
    compare_estimators(model, 4, 3, ["central"], ones, n_delta=2, delta_std=None, n_resamples=2)
    first = evaluated[0].flatten(0, -2)[0]
    th.testing.assert_close(first, th.full_like(first, default_delta_std(first_theta[0])))


@pytest.mark.parametrize("algorithm", [REINFORCE, pytest.param(FiniteDifference, marks=pytest.mark.slow)])
def test_all_estimators_see_the_same_gradient(algorithm):
    model = bandit(algorithm)
    table = compare_estimators(model, 200, 60, perturbation="sphere", n_delta=16, delta_std=1.0)
    assert table.names == ["likelihood_ratio", "forward", "central", "regression"]
    assert all(row.cosine.low > 0.8 for row in table)
    assert table["likelihood_ratio"].cosine.low > 0.9
    assert table["likelihood_ratio"].snr_per_step.low > 0
    assert set(table.legend) == {*table.columns[1:], "[a, b]"}


def test_the_signal_to_noise_ratio_is_per_step(monkeypatch):
    figures = Estimate(0.5, 0.4, 0.6), Estimate(6.0, 3.0, 9.0)
    monkeypatch.setattr(estimator_comparison, "compare_to_reference", lambda *_: figures)
    (row,) = compare_estimators(bandit(), 10, 3, "central", progress_bar=True)
    assert row.estimator == "central"
    found = (row.snr_per_step.value, row.snr_per_step.low, row.snr_per_step.high)
    assert row.steps > 1 and found == pytest.approx((6 / row.steps, 3 / row.steps, 9 / row.steps))


@pytest.mark.slow
def test_with_the_default_perturbations_every_estimator_sees_something_on_cartpole():
    env = make_vec_env("CartPole-v1", 8, seed=0)
    model = REINFORCE("MlpPolicy", env, policy_kwargs={"net_arch": {"pi": [], "vf": [64]}}, device="cpu", seed=0)
    for row in compare_estimators(model, n_episodes=50, n_estimates=20):
        assert row.snr_per_step.low > 0, row
        assert row.cosine.low > 0, row


def test_a_landscape_around_zero_has_no_scale():
    model = bandit()
    for parameter in model.policy.parameters():
        parameter.data.zero_()
    with pytest.raises(ValueError, match="parameters are all 0"):
        landscape(model, 10)


def test_a_landscape_rises_along_the_gradient():
    model = bandit()
    with th.no_grad():
        model.policy.action_net.weight.fill_(1.0)
    gradient = likelihood_ratio(model, 200)[0].mean(0)
    across = th.tensor([1.0, 1.0, 0.0, 0.0], dtype=th.float64)
    found = landscape(model, {"ĝ": gradient}, th.stack([gradient, across]), extent=3.0, n_points=5, n_episodes=60)
    span = f"{found.utilities.min():.4g} to {found.utilities.max():.4g}"
    assert str(found) == f"Utilities from {span} at 5 x 5 points, 60 episodes each; plot_landscape draws them"
    assert found.utilities.shape == (5, 5)
    assert (found.utilities[:, -1] > found.utilities[:, 0]).all()
    assert np.ptp(found.utilities.mean(axis=1)) < 0.2
    assert found.steps["ĝ"][0] == pytest.approx(3.0, abs=1e-6)


def test_the_plane_has_the_scale_of_theta(monkeypatch):
    model = bandit()
    asked = []
    with th.no_grad():
        # The biases are 0: the norm is √2
        model.policy.action_net.weight.fill_(1.0)
    monkeypatch.setattr(CandidateUtility, "__call__", lambda self, x: asked.append(x - self.theta) or x[:, 0])
    landscape(model, directions=th.tensor([[5.0, 0, 0, 0], [0, 0.1, 0, 0]]), extent=2.0, n_points=2)
    assert asked[0][0].tolist() == pytest.approx([-2 * 2**0.5, -2 * 2**0.5, 0, 0])
    landscape(model, n_points=2)
    assert ((asked[1][1] - asked[1][0]) / 2).abs().tolist() == pytest.approx([1, 1, 0, 0])


def test_candidates_share_their_starts_and_calls_do_not():
    env = DummyVecEnv([lambda: Scales(effect=0.0)] * 4)
    utility = CandidateUtility(REINFORCE("MlpPolicy", env, device="cpu"), 1, seed=0)
    found = th.stack([utility(utility.theta.repeat(4, 1)) for _ in range(20)])
    assert (found == found[:, :1]).all() and len(found[:, 0].unique()) == 2
    pairs = utility(utility.theta.repeat(2, 20, 1))
    assert th.equal(pairs[0], pairs[1]) and len(pairs[0].unique()) == 2


class Seeds(Corridor):
    """Keeps the seeds of its resets."""

    def __init__(self):
        super().__init__()
        self.seeds = []

    def reset(self, *, seed=None, options=None):
        self.seeds.append(seed)
        return super().reset(seed=seed, options=options)


def test_neighboring_seeds_share_no_episodes():
    played = []
    for seed in (0, 1):
        env = Seeds()
        landscape(REINFORCE("MlpPolicy", env, device="cpu"), n_points=2, n_episodes=5, seed=seed)
        played.append(set(env.seeds) - {None})
    assert min(map(len, played)) >= 5 and played[0].isdisjoint(played[1])


def test_seeds_go_on_at_zero():
    env = Seeds()
    utility = CandidateUtility(REINFORCE("MlpPolicy", env, device="cpu"), 3, seed=0)
    utility.seed = 2**31 - 2
    for _ in range(2):
        utility(utility.theta[None])
    expected = [2**31 - 2, 2**31 - 1, 0, 1, 2, 3]
    # After each call the environments have new seeds
    assert [seed for seed in env.seeds if seed in expected] == expected


@pytest.mark.parametrize("shape", [(8,), (8, 1), (0, 8), (1, 1, 2, 8)])
def test_candidates_of_another_shape_are_named_before_they_play(shape):
    model = REINFORCE("MlpPolicy", Corridor((2, 9)), policy_kwargs={"net_arch": []}, device="cpu").learn(4)
    before = model._last_obs
    utility = CandidateUtility(model, 1, seed=0)
    n = len(utility.theta)
    wrong = th.zeros([n if size == 8 else size for size in shape])
    with pytest.raises(ValueError, match=rf"thetas must be a finite tensor of shape \(k, {n}\)"):
        utility(wrong)
    assert n > 1 and model._last_obs is before


def test_directions_are_normalized_filter_by_filter():
    like = [th.nn.Parameter(th.randn(3, 4)), th.nn.Parameter(th.randn(3))]
    direction = filter_normalized(th.randn(15, dtype=th.float64), like)
    th.testing.assert_close(direction[:12].reshape(3, 4).norm(dim=1), like[0].double().norm(dim=1).detach())
    th.testing.assert_close(direction[12:].norm(), like[1].double().norm().detach())


def save(ax, path):
    ax.figure.savefig(path)
    plots.plt.close(ax.figure)
    assert path.stat().st_size > 1000


def test_every_picture_can_be_saved(tmp_path, capsys):
    table = compare_baselines(REINFORCE("MlpPolicy", Tree(), device="cpu"), 20, reference="mean")
    ax = plots.plot_baselines(table)
    assert [label.get_text() for label in ax.get_yticklabels()] == table.names[:-1]
    assert ax.get_xlabel() == "variance / variance of 'mean', on the same resamples"
    assert ax.get_legend().get_title().get_text() == "lines: 95% bootstrap intervals"
    drawn = {line.get_ydata()[0]: line for line in ax.get_lines() if len(line.get_xdata()) == 1}
    for y, row in enumerate(list(table)[:-1]):
        assert drawn[y].get_xdata() == [row.ratio.value]
        assert ax.collections[y].get_segments()[0].tolist() == [[row.ratio.low, y], [row.ratio.high, y]]
        assert (drawn[y].get_markerfacecolor() == "white") == (row.bias != 0)
    floors = [line.get_xdata() for line in ax.get_lines() if len(line.get_xdata()) == 2]
    assert floors == [[table["floor"].ratio.value] * 2]
    save(ax, tmp_path / "baselines.png")
    scores = np.random.rand(5, 8)
    ax = plots.plot_learning_curves({"a": scores, "b": np.random.rand(4, 3, 8)}, np.arange(8), confidence=0.5)
    assert [line.get_label() for line in ax.get_lines()] == ["a (5 runs)", "b (4 runs)"]
    np.testing.assert_allclose(ax.get_lines()[0].get_ydata(), np.sort(scores, axis=0)[1:4].mean(0))
    vertices = ax.collections[0].get_paths()[0].vertices
    _, low, high = plots.interquartile_interval(scores[:, None], 500, 0.5, 0)
    assert {*vertices[vertices[:, 0] == 3, 1]} == {low[3], high[3]}
    save(ax, tmp_path / "curves.png")
    fans = {"one": th.ones(4), "three": th.randn(3, 4)}
    found = landscape(bandit(), fans, n_points=3, n_episodes=2, progress_bar=True)
    assert [steps.shape for steps in found.steps.values()] == [(2,), (3, 2)]
    assert "| 18/18 [" in capsys.readouterr().err
    ax = plots.plot_landscape(found)
    assert ax.images[0].origin == "lower" and np.array_equal(ax.images[0].get_array(), found.utilities)
    assert "3 × 3 points of 2 episodes" in ax.get_title() and ax.get_xlim() == (-1.5, 1.5)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["one (1)", "three (3)"]
    for arrows, steps in zip(ax.collections, found.steps.values(), strict=True):
        drawn_steps = np.stack([arrows.U, arrows.V], axis=1)
        np.testing.assert_allclose(th.cosine_similarity(th.tensor(drawn_steps), th.tensor(np.atleast_2d(steps))), 1)
    save(ax, tmp_path / "landscape.png")
    variances = np.random.rand(3, 4) + 1
    ax = plots.plot_variances({"none": variances}, [2, 4, 8, 16])
    (bars,) = ax.collections
    # The quantile of Student's t for two degrees of freedom
    middle, half = variances.mean(0), 4.302653 * variances.std(0, ddof=1) / 3**0.5
    drawn_bars = np.array([segment[:, 1] for segment in bars.get_segments()])
    np.testing.assert_allclose(drawn_bars, np.stack([middle - half, middle + half], axis=1), rtol=1e-6)
    save(ax, tmp_path / "variances.png")


def test_a_picture_is_drawn_on_the_axes_it_is_given():
    figure, ax = plots.plt.subplots()
    assert plots.plot_learning_curves({"a": np.random.rand(5, 8)}, np.arange(8), ax) is ax
    plots.plt.close(figure)


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    scores = np.array([[-1e9], [2.0], [4.0], [1e9]])
    assert plots.interquartile_interval(scores[:, None], 1, 0.95, 0)[0] == 3
    mean, low, high = plots.interquartile_interval(np.random.randn(40, 2, 3), 200, 0.95, 0)
    assert ((low < mean) & (mean < high)).all()
    assert (high - low < 1).all()


def test_the_runs_of_each_task_are_resampled_separately():
    """Each of eight scores is drawn with a chance of 1/4. Runs that were drawn for both tasks would come in pairs."""
    runs = np.zeros((4, 2, 1))
    runs[0] = 1
    resampled = [plots.interquartile_interval(runs, 1, 0.0, seed)[1].item() for seed in range(400)]
    # If k of eight scores are 1, so are k − 2 of the middle four
    chances = np.array([math.comb(8, k) * 0.25**k * 0.75 ** (8 - k) for k in range(9)])
    expected = chances @ np.clip((np.arange(9) - 2) / 4, 0, 1)
    assert abs(np.mean(resampled) - expected) < 5 * np.std(resampled) / 20


# One run alone, another number of columns, and no rows
UNDRAWN = [np.ones((1, 8)), np.ones((3, 7)), np.ones(8)]


@pytest.mark.parametrize(
    ("plot", "arguments", "named"),
    [
        (plots.plot_baselines, (3,), "table must be the Table that compare_baselines returns, got 3"),
        (plots.plot_baselines, (Table("", [Estimate(0.0, 0.0, 0.0)], {}),), "BaselineRow of compare_baselines"),
        (plots.plot_landscape, (3,), "scape must be the Landscape that landscape returns, got 3"),
        (plots.plot_learning_curves, ([1], [1]), "runs must be a dictionary"),
        (plots.plot_learning_curves, ({}, [1]), "runs must have at least one array"),
        *((plots.plot_learning_curves, ({"a": wrong}, np.arange(8)), r"runs\['a'\]") for wrong in UNDRAWN),
        (plots.plot_variances, ({}, [1]), "curves must have at least one array"),
        *((plots.plot_variances, ({"a": wrong}, np.arange(1, 9)), r"curves\['a'\]") for wrong in UNDRAWN),
        (partial(plots.plot_variances, confidence=1), ({"a": np.ones((3, 8))}, np.arange(1, 9)), "confidence must be"),
    ],
)
def test_what_cannot_be_drawn_is_named_and_leaves_no_figure(plot, arguments, named):
    plots.plt.close("all")
    with pytest.raises((TypeError, ValueError), match=named):
        plot(*arguments)
    assert not plots.plt.get_fignums()


def test_baselines_without_variance_are_drawn(tmp_path):
    """Where all rewards are zero, the ratios are unknown, also the reference's."""
    model = REINFORCE("MlpPolicy", Corridor((1,), lambda t, action: 0.0), device="cpu")
    table = compare_baselines(model, 4)
    assert np.isnan(table["none"].ratio.value)
    save(plots.plot_baselines(table), tmp_path / "baselines.png")


def test_the_utility_of_a_policy_with_gsde_has_new_noise_in_each_step():
    """The reward is the action, whose mean is 0: the mean of 1000 returns does not depend on one noise matrix."""
    env = make_vec_env(lambda: Corridor((1,), lambda t, action: float(action[0]), spaces.Box(-1e3, 1e3, (1,))), 8)
    policy_kwargs = {"net_arch": [], "log_std_init": 0.0}
    model = REINFORCE("MlpPolicy", env, use_sde=True, sde_sample_freq=1, policy_kwargs=policy_kwargs, seed=0)
    th.nn.init.zeros_(model.policy.action_net.weight)
    for _ in range(3):
        model.policy.reset_noise(8)
        utility = CandidateUtility(model, 1000, seed=0)
        assert abs(float(utility(utility.theta[None]))) < 4.5 / 1000**0.5


def test_a_measurement_before_a_rollout_leaves_the_noise_of_gsde():
    """Each rollout of A2C is one episode in each environment, so that the reset changes nothing."""
    ends = []
    for measure in (lambda model: None, lambda model: landscape(model, n_points=2, n_episodes=1)):
        env = make_vec_env(lambda: Corridor((3,), action_space=spaces.Box(-1, 1, (1,))), 4)
        model = A2C("MlpPolicy", env, use_sde=True, n_steps=3, seed=0, device="cpu")
        model.learn(36, Record(measure, at="rollout_start"))
        ends.append(dict(model.policy.named_parameters()))
    th.testing.assert_close(*ends)


class Squared(Wrapper):
    """Changes rewards."""

    def step_wait(self):
        obs, rewards, dones, infos = super().step_wait()
        return obs, rewards**2, dones, infos


def test_gradients_and_utilities_are_of_rewards_that_are_neither_clipped_nor_scaled():
    """Also where a wrapper above VecNormalize changes rewards."""
    gradients = []
    utilities = []
    for bound, variance in ((0.5, 1.0), (10.0, 4.0)):
        env = VecNormalize(make_vec_env(lambda: Corridor((2,), lambda t, action: 3.0 * action), 2, seed=0))
        env.clip_reward = bound
        env.ret_rms.var = np.array(variance)
        model = REINFORCE("MlpPolicy", Squared(env), policy_kwargs={"net_arch": []}, device="cpu", seed=0)
        th.manual_seed(0)
        gradients.append(likelihood_ratio(model, 50)[0])
        utility = CandidateUtility(model, 50, seed=0)
        utilities.append(utility(utility.theta[None]))
        assert env.clip_reward == bound
    assert gradients[0].any() and utilities[0].any()
    th.testing.assert_close(*gradients)
    th.testing.assert_close(*utilities)
