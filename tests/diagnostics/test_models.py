"""Which models the lab accepts, and that it leaves them and their training as they were."""

import subprocess
import sys

import numpy as np
import pytest
import torch as th
from callbacks import Record
from environments import Corridor, Tree
from gymnasium import spaces
from models import Dropping, Normalized, Threshold, plain
from stable_baselines3 import A2C, DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_reinforce import REINFORCE, FiniteDifference
from sb3_reinforce.diagnostics import (
    GradientQualityCallback,
    PitfallCallback,
    check_gradient,
    compare_baselines,
    compare_estimators,
    compare_starts,
    landscape,
    sample,
)


def lab():
    """Every function that measures a model, at its cheapest."""
    return {
        "check_gradient": lambda model: check_gradient(model, 2),
        "compare_baselines": lambda model: compare_baselines(model, 4, n_resamples=2),
        "compare_estimators": lambda model: compare_estimators(model, 4, 3, n_delta=2, n_resamples=2),
        "likelihood_ratio": lambda model: compare_estimators(model, 4, estimators="likelihood_ratio", n_resamples=2),
        "compare_starts": lambda model: compare_starts(model, 4, n_resamples=2),
        "landscape": lambda model: landscape(model, n_points=2, n_episodes=1),
        "sample": lambda model: sample(model, 2),
    }


def starts_with_an_episode(rollout):
    """In a Corridor, whose observation is the timestep."""
    return not rollout.timesteps[0].any() and bool((rollout.observations[0].argmax(-1) == 0).all())


callbacks = {"pitfalls": PitfallCallback, "quality": lambda: GradientQualityCallback(1)}


def trained(callback=None, **kwargs):
    return REINFORCE("MlpPolicy", make_vec_env("CartPole-v1", 4, seed=0), seed=0, device="cpu", **kwargs).learn(
        512, callback
    )


def not_shared(extractor):
    return {"policy_kwargs": {"features_extractor_class": extractor, "share_features_extractor": False}}


@pytest.mark.parametrize(
    "kwargs",
    [{}, {"baseline": "leave_one_out", "n_episodes": 6}, not_shared(Normalized), not_shared(Dropping)],
    ids=["steps", "episodes", "batch normalization", "dropout"],
)
def test_training_is_the_same_with_a_callback(kwargs):
    """Also when it goes on, in which the random numbers that a callback has drawn would show."""

    def found(callback):
        model = trained(callback, **kwargs)
        first = plain(model.policy.state_dict()), model.policy.training
        model.learn(256, reset_num_timesteps=False)
        return first, plain(model.policy.state_dict()), model.num_timesteps

    expected = found(None)
    for make_callback in callbacks.values():
        assert found(make_callback()) == expected


@pytest.mark.parametrize("measure", lab().values(), ids=lab())
def test_a_model_is_as_it_was_and_goes_on(measure):
    env = VecNormalize(make_vec_env(lambda: Corridor((3, 7), action_space=spaces.Box(-1, 1, (1,))), 2, seed=0))
    model = REINFORCE("MlpPolicy", env, n_steps=8, seed=0, device="cpu").learn(16)

    def state():
        counts = env.obs_rms.count, env.ret_rms.count, len(model.ep_info_buffer), env.training
        logged = dict(model.logger.name_to_value)
        names = ("n_steps", "n_episodes", "episodes_per_start", "baseline", "gamma", "gae_lambda", "max_grad_norm")
        kept = [getattr(model, name) for name in (*names, "num_timesteps", "logger", "rollout")]
        optimizers = plain([each.state_dict() for each in (model.policy.optimizer, model.critic_optimizer)])
        return kept, model.policy.optimizer, optimizers, counts, logged

    before, parameters = state(), {name: value.clone() for name, value in model.policy.state_dict().items()}
    measure(model)
    assert state() == before
    assert all(th.equal(value, parameters[name]) for name, value in model.policy.state_dict().items())
    model.learn(16, reset_num_timesteps=False)
    assert model.num_timesteps == 32
    assert starts_with_an_episode(model.rollout)


def measuring(measure, at):
    """A callback that measures the model in the second rollout, or between it and the next."""
    return Record(lambda model: measure(model) if model.num_timesteps >= 16 else None, at)


@pytest.mark.parametrize("measure", lab().values(), ids=lab())
def test_a_measurement_that_would_cut_a_rollout_is_refused(measure):
    model = REINFORCE("MlpPolicy", Corridor((7,)), n_steps=16, seed=0, device="cpu")
    with pytest.raises(ValueError, match="model is collecting a rollout"):
        model.learn(48, measuring(measure, "step"))
    assert starts_with_an_episode(model.learn(16, reset_num_timesteps=False).rollout)


@pytest.mark.parametrize("where", ["rollout_start", "rollout_end"])
@pytest.mark.parametrize("measure", lab().values(), ids=lab())
def test_a_callback_may_measure_between_rollouts(where, measure):
    model = REINFORCE("MlpPolicy", Corridor((7,)), n_steps=16, seed=0, device="cpu")
    rollout = model.learn(32 if where == "rollout_start" else 48, measuring(measure, where)).rollout
    assert starts_with_an_episode(rollout)
    assert rollout.timesteps.flatten().tolist() == [t % 7 for t in range(16)]


@pytest.mark.parametrize("measure", lab().values(), ids=lab())
def test_generators_of_gpus_are_left_alone(measure, monkeypatch):
    monkeypatch.setattr(th.cuda, "manual_seed_all", lambda seed: pytest.fail("all GPUs were seeded"))
    measure(REINFORCE("MlpPolicy", Tree(), device="cpu"))


@pytest.mark.filterwarnings("ignore:The gradient is mostly noise:UserWarning")
@pytest.mark.parametrize("callback", callbacks)
def test_a_callback_survives_frozen_parameters(callback):
    """One of the actor's in the third rollout, all of them in the fifth, none from the seventh on."""

    def freeze(model):
        n, policy = model.num_timesteps // 16, model.policy
        policy.action_net.bias.requires_grad_(not 2 <= n < 6)
        for module in (policy.action_net.weight, policy.mlp_extractor.policy_net):
            module.requires_grad_(not 4 <= n < 6)

    model = REINFORCE("MlpPolicy", Corridor((3, 7)), n_steps=16, seed=0, device="cpu")
    model.learn(16 * 60, [Record(freeze, "rollout_start"), callbacks[callback]()])
    assert model.num_timesteps == 16 * 60


@pytest.mark.parametrize("measure", lab().values(), ids=lab())
def test_a_model_without_environments_is_refused(measure):
    model = REINFORCE("MlpPolicy", Tree(), device="cpu")
    model.env = None
    with pytest.raises(ValueError, match="set_env"):
        measure(model)


def test_a_threshold_in_the_actor_has_no_likelihood_ratio_to_compare():
    kwargs = {"net_arch": [4], "activation_fn": Threshold}
    model = FiniteDifference("MlpPolicy", "CartPole-v1", device="cpu", n_delta=2, policy_kwargs=kwargs)
    with pytest.raises(ValueError, match="needs the gradient of log π for all parameters"):
        compare_estimators(model, 4, 3, n_delta=2, n_resamples=2)


REFUSING = ("check_gradient", "compare_baselines", "compare_estimators", "compare_starts", "sample")
REFUSING_CALLBACKS = [lambda model, make=make: model.learn(10, make()) for make in callbacks.values()]


@pytest.mark.parametrize("measure", [*(lab()[name] for name in REFUSING), *REFUSING_CALLBACKS])
def test_other_models_are_refused(measure):
    with pytest.raises(TypeError, match=r"must be a REINFORCE.*set_parameters\(\.\.\., exact_match=False\)"):
        measure(A2C("MlpPolicy", "CartPole-v1", device="cpu"))


def test_a_sample_without_values_has_monte_carlo_returns():
    """λ weights values, and a sample with another baseline has none."""
    model = REINFORCE("MlpPolicy", Corridor((5,)), gae_lambda=0.5, gamma=1.0, device="cpu")
    assert sample(model, 2, baseline="none").returns[:5, 0].tolist() == [5, 4, 3, 2, 1]


def test_a_landscape_needs_an_actor_critic_policy():
    with pytest.raises(TypeError, match="actor-critic policy"):
        landscape(DQN("MlpPolicy", "CartPole-v1", device="cpu", buffer_size=10))


def test_episodes_that_share_the_noise_of_gsde_are_no_samples():
    model = REINFORCE("MlpPolicy", Corridor(action_space=spaces.Box(-1, 1, (1,))), use_sde=True, device="cpu")
    quality = {"callback": GradientQualityCallback(1), "total_timesteps": 64}
    for measure in (compare_baselines, compare_estimators, compare_starts, lambda model: model.learn(**quality)):
        with pytest.raises(ValueError, match="use_sde=True and sde_sample_freq=-1"):
            measure(model)


def called(name):
    """A constant baseline of that name."""

    def function(rollout):
        return th.full_like(rollout.returns, 0.5)

    function.__name__ = name
    return function


def learn_with_quality(model, **kwargs):
    model.learn(1, GradientQualityCallback(**kwargs))


WRONG_BAR = {"progress_bar": "x"}, "progress_bar must be True or False, got 'x'"
MISTAKES = {
    compare_baselines: [
        ({"n_episodes": 2}, "n_episodes must be at least 3, got 2"),
        ({"n_episodes": 10.0}, "n_episodes must be an integer"),
        ({"baselines": ("no_such_baseline",)}, r"baselines must be.*'time_mean'.*got 'no_such_baseline'"),
        ({"baselines": 3}, "baselines must be a name or a callable, got 3"),
        ({"baselines": (lambda r: r.returns, lambda r: 0 * r.returns)}, "'<lambda>' is taken"),
        ({"baselines": called("none")}, "'none' is taken"),
        ({"baselines": called("floor")}, "'floor' is taken"),
        ({"baselines": ("value",)}, "no critic.*'none'"),
        ({"reference": "optimal", "baselines": ("mean",)}, r"reference must be.*'none', 'mean'.*got 'optimal'"),
        ({"n_resamples": 0}, "n_resamples"),
        ({"confidence": 2.0}, "confidence"),
        WRONG_BAR,
    ],
    compare_estimators: [
        ({"n_episodes": 2}, "n_episodes must be at least 3"),
        ({"n_estimates": 1}, "n_estimates must be at least 3"),
        ({"estimators": ("backward",)}, r"estimators must be one of.*'backward'"),
        ({"delta_std": 0.0}, "delta_std"),
        ({"n_delta": 1}, "n_delta must be at least 2"),
        ({"estimators": ()}, "estimators must have at least one name"),
        ({"estimators": ("forward", "forward")}, r"each of them once, got \('forward', 'forward'\)"),
        ({"estimators": 3}, "estimators must be names, got 3"),
        ({"perturbation": "cube"}, "perturbation must be"),
        ({"confidence": 95}, "confidence"),
        WRONG_BAR,
    ],
    landscape: [
        ({"extent": 0}, "extent"),
        ({"n_points": 1}, "n_points"),
        ({"n_episodes": 0}, "n_episodes"),
        ({"directions": th.ones(2, 3)}, r"directions.*\(2, 4\).*\(2, 3\)"),
        ({"gradients": {"g": th.zeros(4)}}, r"gradients\['g'\].*not zero"),
        ({"gradients": {"g": [1.0, 2.0]}}, r"gradients\['g'\] must be a tensor, got \[1.0, 2.0\]"),
        ({"gradients": th.ones(4)}, "gradients must be a dictionary.*Tensor"),
        ({"directions": [1.0, 2.0]}, "directions must be a tensor"),
        WRONG_BAR,
    ],
    compare_starts: [({"n_starts": 3}, "n_starts must be at least 4"), ({"confidence": 95}, "confidence"), WRONG_BAR],
    sample: [({"n_episodes": 2, **WRONG_BAR[0]}, WRONG_BAR[1])],
    check_gradient: [({"n_episodes": 1}, "n_episodes must be at least 2")],
    learn_with_quality: [
        ({"every": 0}, "every must be at least 1, got 0"),
        ({"max_episodes": 1}, "max_episodes must be at least 2, got 1"),
        ({"baselines": ("value",)}, "no critic"),
    ],
}


@pytest.mark.parametrize(
    ("measure", "kwargs", "message"), [(measure, *case) for measure, cases in MISTAKES.items() for case in cases]
)
def test_a_users_mistake_is_named_before_anything_is_sampled(measure, kwargs, message):
    env = Corridor((1,), lambda t, action: pytest.fail("a step was taken"))
    model = REINFORCE("MlpPolicy", env, baseline="none", policy_kwargs={"net_arch": []}, device="cpu")
    model._last_obs = before = model.env.reset()
    with pytest.raises((ValueError, TypeError), match=message):
        measure(model, **kwargs)
    # Nor have its environments been reset, but by training
    assert measure is learn_with_quality or model._last_obs is before


def test_nothing_here_needs_the_extras():
    """Neither training nor the lab, but for its figures, where matplotlib and pandas cannot be imported."""
    script = """
import sys
sys.modules.update({"matplotlib": None, "pandas": None})
from sb3_reinforce import REINFORCE
from sb3_reinforce.diagnostics import GradientQualityCallback, PitfallCallback, check_gradient, compare_baselines
model = REINFORCE("MlpPolicy", "CartPole-v1", device="cpu", seed=0)
model.learn(128, [GradientQualityCallback(1), PitfallCallback()])
print(compare_baselines(model, 5), check_gradient(model).passed)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("True\n")


@pytest.mark.parametrize("training", [True, False])
def test_a_seed_makes_figures_reproducible(training):
    """With episodes drawn by the environment's own generator, and actions by PyTorch's; in both modes of the policy."""
    env = make_vec_env(lambda: Corridor((1, 2, 5), lambda t, action: float(action)), 4, seed=0)
    model = REINFORCE("MlpPolicy", env, policy_kwargs={"net_arch": []}, device="cpu", seed=0)
    model.policy.set_training_mode(training)

    def figures(seed):
        rows = compare_estimators(model, 12, 4, n_resamples=20, seed=seed).to_records()
        return [{key: x for key, x in row.items() if key != "seconds"} for row in rows]

    generator = th.get_rng_state()
    first = figures(3)
    np.testing.assert_equal(figures(np.int64(3)), first)
    assert figures(4)[0]["snr_per_step"] != first[0]["snr_per_step"]
    np.testing.assert_equal(*[landscape(model, n_points=2, seed=seed).utilities for seed in (1, np.int64(1))])
    compare_baselines(model, 5, n_resamples=2, seed=np.int64(0))
    compare_starts(model, 4, n_resamples=2, seed=np.int64(0))
    assert th.equal(th.get_rng_state(), generator)
    assert model.policy.training == training
