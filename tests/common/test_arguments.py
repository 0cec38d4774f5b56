"""Each argument is checked at construction and by learn; the error names it."""

from contextlib import suppress
from copy import deepcopy
from functools import partial
from inspect import signature

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from callbacks import Record
from models import KINDS, both, both_extents, make, plain
from sb3_contrib.common.envs import InvalidActionEnvDiscrete
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.sac.policies import SACPolicy

from sb3_reinforce import REINFORCE, ActionMaskObservation, FiniteDifference
from sb3_reinforce.common import arguments
from sb3_reinforce.common.settings import LEARN_ARGUMENTS
from sb3_reinforce.estimation import BASELINES, ESTIMATORS
from sb3_reinforce.recurrent import MaskedLstmPolicy, RecurrentREINFORCE

NAN, INF = float("nan"), float("inf")
TABLES = {algorithm: algorithm._arguments for algorithm in (REINFORCE, FiniteDifference)}
NO_NUMBERS = ["x", True, [1], 1j, None]
WRONG = {
    "check_number": [*NO_NUMBERS, NAN, INF, -INF],
    "CheckedSchedule": [*NO_NUMBERS, -1, NAN, INF, lambda p: NAN, lambda p: -1.0, lambda p: "x", lambda p: np.ones(2)],
    "check_integer": [*NO_NUMBERS, NAN, INF, 2.5, 2**63],
    "check_verbose": ["x", [1], None, 2.5, -1],
    "check_flag": ["no", 1, None],
    "check_choice": ["batch", 3, None],
    "check_kind": [3, [1], None, b"mean"],
    "check_named": [3, [1], None, b"mean", "men"],
    "check_subclass": [3, "x", dict],
    "check_device": ["gpu9", 3],
    "check_callback": [3, "x", [3], BaseCallback, [BaseCallback]],
}


COUNTS = (
    "n_steps", "n_episodes", "episodes_per_start", "n_critic_updates", "batch_size", "max_episode_steps",
    "stats_window_size", "n_delta", "n_eval_episodes", "n_top", "log_interval",
)  # fmt: skip
# Numbers just outside the range of each argument
OUTSIDE = dict.fromkeys(COUNTS, (0, -1)) | {
    **dict.fromkeys(("gamma", "gae_lambda"), (-0.01, 1.01)),
    **dict.fromkeys(("ent_coef", "vf_coef", "target_kl"), (-1e-9,)),
    **dict.fromkeys(("learning_rate", "critic_learning_rate", "min_std"), (-1e-9, 1.1e6)),
    **dict.fromkeys(("temperature", "delta_std"), (0, 1.1e6)),
    "max_grad_norm": (0, -1),
    "total_timesteps": (-1,),
    "seed": (-1, 2**32),
    "sde_sample_freq": (-2,),
    "verbose": (-1,),
}
HAVE_RANGES = {"check_number", "CheckedSchedule", "check_integer", "check_verbose"}


def kind_of(check):
    """The name of the function that checks an argument, and whether None passes."""
    inner = getattr(check, "keywords", {}).get("check")
    named = check if inner is None else inner
    return getattr(named, "func", named).__name__, inner is not None


def wrong_values(name, check):
    """What an argument must refuse: values of other types, and numbers just out of its range."""
    kind, takes_none = kind_of(check)
    values = [value for value in WRONG[kind] if not (value is None and takes_none)]
    if name == "max_grad_norm":
        values.remove(INF)
    return [*values, *OUTSIDE.get(name, ())]


def test_every_number_has_a_range():
    tables = TABLES[REINFORCE] | TABLES[FiniteDifference] | LEARN_ARGUMENTS
    assert {name for name, check in tables.items() if kind_of(check)[0] in HAVE_RANGES} == OUTSIDE.keys()


def test_the_tables_name_all_arguments():
    for algorithm, table in TABLES.items():
        assert signature(algorithm).parameters.keys() == table.keys() | {"env", "_init_setup_model"}
        assert list(signature(algorithm.learn).parameters)[1:] == list(LEARN_ARGUMENTS)


@pytest.mark.parametrize(("algorithm", "name"), [(each, name) for each, table in TABLES.items() for name in table])
def test_a_wrong_argument_is_named_with_its_value(algorithm, name):
    for value in wrong_values(name, TABLES[algorithm][name]):
        with pytest.raises((TypeError, ValueError), match=name) as error:
            algorithm(**{"policy": "MlpPolicy", "env": "CartPole-v1", "device": "cpu", name: value})
        assert callable(value) or str(value) in str(error.value)


USED_BEFORE = {
    "policy", "policy_kwargs", "tensorboard_log", "stats_window_size", "verbose", "seed", "device", "use_sde",
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        (kind, name)
        for kind, table in zip(("steps", "search"), TABLES.values(), strict=True)
        for name in sorted(table.keys() - USED_BEFORE)
    ],
)
@pytest.mark.parametrize("at", ["before", "rollout_start"])
def test_a_wrong_value_that_is_set_later_is_named_before_it_is_used(kind, name, at):
    model = make(kind).learn(16)
    before, n_steps = deepcopy(model.get_parameters()), model.num_timesteps
    values = wrong_values(name, TABLES[type(model)][name])
    # One of another kind and the last, for numbers one out of range: all are tried at construction
    for value in (values[0], values[-1]):
        given = getattr(model, name)
        change = Record(lambda model, value=value: setattr(model, name, value), "rollout_start")
        if at == "before":
            setattr(model, name, value)
        with pytest.raises((TypeError, ValueError), match=name):
            model.learn(64, callback=change)
        assert model.num_timesteps == (n_steps if at == "before" else 0)
        setattr(model, name, given)
    assert plain(model.get_parameters()) == plain(before)


@pytest.mark.parametrize(("first", "second"), [((64, None), (None, 4)), ((None, 4), (64, None))])
def test_a_callback_may_change_the_kind_of_rollout_at_its_start(first, second):
    def change(model):
        model.n_steps, model.n_episodes = second

    model = make("steps", n_steps=first[0], n_episodes=first[1], seed=0)
    used = Record(lambda model: "rollout/used_fraction" in model.logger.name_to_value)
    model.learn(300, callback=[Record(change, "rollout_start"), used], log_interval=1)
    assert used.records[-1] == (second[0] is None)


@both
@pytest.mark.parametrize("name", LEARN_ARGUMENTS)
def test_a_wrong_argument_of_learn_is_named_and_changes_nothing(kind, name):
    model = make(kind)
    for value in wrong_values(name, LEARN_ARGUMENTS[name]):
        with pytest.raises((TypeError, ValueError), match=name):
            model.learn(**{"total_timesteps": 8, name: value})
    assert model._last_obs is None and model.num_timesteps == 0


WITH_MASKS = ActionMaskObservation(InvalidActionEnvDiscrete(8))
RECURRENT, MASKABLE = (
    type(name, (ActorCriticPolicy,), {"__doc__": "Has the name of sb3-contrib's."})
    for name in ("RecurrentActorCriticPolicy", "MaskableActorCriticPolicy")
)


@pytest.mark.parametrize(
    ("kind", "wrong", "words"),
    [
        ("steps", {"baseline": "average"}, ["baseline", "'average'", "'leave_one_out'", "'optimal'", "'time_mean'"]),
        ("search", {"estimator": "backward"}, ["estimator", "'backward'", "'central'"]),
        ("steps", {"baseline": "leave-one-out"}, ["'leave-one-out': did you mean 'leave_one_out'?"]),
        ("search", {"estimator": "Central"}, ["'Central': did you mean 'central'?"]),
        ("steps", {"normalize_by": "step"}, ["'step': did you mean 'steps'?"]),
        ("steps", {"policy": "MLPPolicy"}, ["policy", "'CnnPolicy'", "'MLPPolicy': did you mean 'MlpPolicy'?"]),
        ("search", {"policy": "NoPolicy"}, ["policy", "'LinearPolicy'", "'CnnPolicy'", "'NoPolicy'"]),
        ("steps", {"policy": "MlpLstmPolicy"}, ["policy", "MlpLstmPolicy", "RecurrentREINFORCE", "VecFrameStack"]),
        ("search", {"policy": RECURRENT}, ["policy", "RecurrentREINFORCE", "VecFrameStack"]),
        ("steps", {"policy": MASKABLE}, ["policy", "MaskedPolicy", "ActionMaskObservation"]),
        ("search", {"env": WITH_MASKS, "policy": "MlpPolicy"}, ["got MlpPolicy", "MaskedPolicy"]),
        (
            "steps",
            {"learning_rate": lambda: 1e-3},
            ["learning_rate (at", "of the remaining progress", "TypeError"],
        ),
        ("steps", {"n_episodes": 4}, ["n_steps=8", "n_episodes=4"]),
        ("steps", {"gae_lambda": 0.9, "baseline": "mean"}, ["gae_lambda=0.9", "'value'", "'mean'"]),
        ("steps", {"gae_lambda": 0.9, "reward_to_go": False}, ["gae_lambda=0.9", "reward_to_go=False"]),
        ("episodes", {"baseline": "optimal", "n_episodes": 1}, ["n_episodes", "at least 2", "'optimal'", "compares"]),
        ("episodes", {"baseline": "leave_one_out", "n_episodes": 1}, ["at least 2", "'leave_one_out'"]),
        ("episodes", {"baseline": BASELINES["time_mean"], "n_episodes": 1}, ["at least 2", "'time_mean'"]),
        ("steps", {"min_std": 0.1}, ["min_std=0.1", "Discrete"]),
        ("steps", {"min_std": lambda progress: 0.0}, ["min_std=<function", "Discrete"]),
        ("steps", {"env": "Pendulum-v1", "temperature": 0.5}, ["temperature", "Box"]),
        ("steps", {"env": "Pendulum-v1", "temperature": lambda progress: 1.0}, ["temperature", "Box"]),
        ("steps", {"target_kl": 0.01}, ["target_kl=0.01", "step='optimizer'", "'natural'"]),
        ("steps", {"use_sde": True}, ["use_sde=True", "Box", "Discrete"]),
        ("search", {"estimator": "regression", "n_delta": 1}, ["n_delta", "at least 2", "'regression'"]),
        ("search", {"estimator": ESTIMATORS["regression"], "n_delta": 1}, ["n_delta", "at least 2", "'regression'"]),
        ("search", {"n_top": 4}, ["n_top must be at most n_delta=2", "got 4"]),
        ("search", {"n_top": 1, "estimator": "forward"}, ["n_top=1", "'central'", "'forward'"]),
        ("search", {"policy": th.nn.Linear}, ["policy", "ActorCriticPolicy", "Linear"]),
        ("steps", {"policy": SACPolicy}, ["policy", "ActorCriticPolicy", "SACPolicy"]),
        ("search", {"env": "Pendulum-v1", "policy_kwargs": {"use_sde": True}}, ["policy_kwargs", "use_sde=True"]),
    ],
)
def test_arguments_that_do_not_go_together(kind, wrong, words):
    with pytest.raises((ValueError, TypeError)) as error:
        make(kind, **wrong)
    assert all(word in str(error.value) for word in words)


@both
@pytest.mark.parametrize("policy", ["MaskedLstmPolicy", MaskedLstmPolicy])
def test_frames_of_masks_are_not_recommended(kind, policy):
    with pytest.raises(ValueError, match=r"got MaskedLstmPolicy: .*RecurrentREINFORCE$"):
        make(kind, policy=policy)


def test_of_several_wrong_arguments_the_same_is_named_in_every_process():
    """Those that Stable-Baselines3 uses at once come first, in the order of the table."""
    wrong = {name: -1 for name in ("seed", "stats_window_size", "ent_coef", "gae_lambda", "gamma", "vf_coef")}
    with pytest.raises(ValueError, match=r"^stats_window_size"):
        make("steps", **wrong)


@both
@pytest.mark.parametrize("other", [A2C, PPO])
def test_what_takes_the_place_of_arguments_of_other_algorithms_is_said(other, kind):
    cls = KINDS[kind][0]
    names = signature(other).parameters.keys() - signature(cls).parameters.keys()
    assert names
    for name in names:
        with pytest.raises(TypeError, match=f"{cls.__name__} has no argument {name}: "):
            make(kind, **{name: 0.2})


def test_a_recurrent_model_takes_n_steps_by_position_as_ppo_does():
    assert RecurrentREINFORCE("MlpLstmPolicy", "CartPole-v1", 3e-4, 128, device="cpu").n_steps == 128


def test_a_subclass_may_have_arguments_of_other_algorithms():
    class Clipped(REINFORCE):
        def __init__(self, *args, clip_range, **kwargs):
            super().__init__(*args, **kwargs)

    class Own(Clipped):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)

    assert isinstance(Own("MlpPolicy", "CartPole-v1", device="cpu", clip_range=0.2), REINFORCE)


@both
def test_an_infinite_gradient_norm_is_no_bound(kind):
    without, infinite = (make(kind, seed=0, max_grad_norm=norm).learn(40) for norm in (None, INF))
    assert all(map(th.equal, without.policy.parameters(), infinite.policy.parameters()))


@pytest.mark.parametrize("policy", ["MlpPolicy", "LinearPolicy"])
def test_the_search_recommends_the_cpu(policy):
    # A device without a GPU, on which nothing can be computed after the warning: PyTorch says so if it validates
    # distributions, which it stops doing once a test has compiled a policy
    with pytest.warns(UserWarning, match=r"on the GPU.*device='cpu'"), suppress(RuntimeError, ValueError):
        make("search", policy=policy, policy_kwargs={}, device="meta")


@pytest.mark.parametrize(
    ("check", "wrong", "allowed"),
    [
        (partial(arguments.check_number, low=0), -1, "finite and >= 0"),
        (partial(arguments.check_number, low=0, above=True), 0, "finite and > 0"),
        (partial(arguments.check_number, low=0, high=1), 2, r"in \[0, 1\]"),
        (partial(arguments.check_number, low=0, high=np.inf, above=True), 0, r"> 0 \(inf or None for no bound\)"),
        (partial(arguments.CheckedSchedule, high=1, above=True), 0.0, r"in \(0, 1\]"),
        (partial(arguments.check_integer, low=2), 1, "at least 2"),
        (partial(arguments.check_integer, low=2, high=5), 6, "at least 2 and at most 5"),
        (arguments.CheckedSchedule, "1e-3", "a number or a schedule"),
        (partial(arguments.check_choice, choices=("a", "b")), "c", "one of 'a', 'b'"),
        (partial(arguments.check_kind, kinds=(int, str)), None, "int or str"),
    ],
)
def test_the_message_says_what_is_allowed(check, wrong, allowed):
    with pytest.raises((TypeError, ValueError), match=f"^x must be {allowed}, got {wrong!r}"):
        check("x", wrong)


@both
def test_verbose_may_be_a_flag(kind, tmp_path):
    assert [make(kind, verbose=value).verbose for value in (True, False, 2)] == [1, 0, 2]
    make(kind).save(tmp_path / "model")
    assert KINDS[kind][0].load(tmp_path / "model", verbose=True).verbose == 1


@both
def test_integers_of_numpy(kind, tmp_path):
    integers = {"seed": 3, "stats_window_size": 5, "max_episode_steps": 600}
    integers |= {"batch_size": 16, "n_steps": 8, "n_critic_updates": 2} if kind == "steps" else {"n_delta": 2}
    model = make(kind, **{name: np.int64(value) for name, value in integers.items()}).learn(16)
    assert model.ep_info_buffer.maxlen == 5
    model.save(tmp_path / "model")
    given = {name: np.int64(value) for name, value in integers.items() if name != "stats_window_size"}
    type(model).load(tmp_path / "model", env=gym.make("CartPole-v1"), **given).learn(16)


@both_extents
@pytest.mark.parametrize("block", [th.no_grad, th.inference_mode])
def test_without_gradients_nothing_is_learned_in_silence(kind, block):
    model = make(kind)
    with block(), th.set_grad_enabled(block is th.inference_mode), pytest.raises(ValueError, match="gradients"):
        model.learn(16)
    assert model.num_timesteps == 0


def test_no_search_in_inference_mode():
    """Adam's moments could not be changed in a later call."""
    model = make("search")
    with th.inference_mode(), pytest.raises(ValueError, match="inference_mode"):
        model.learn(16)
    assert model.num_timesteps == 0
    with th.no_grad():
        model.learn(16)
    model.learn(16)
