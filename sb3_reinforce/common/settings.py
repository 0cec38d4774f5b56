"""The arguments of both algorithms: one table of checks for each, and what arguments must satisfy together."""

import math
import os
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy, MultiInputActorCriticPolicy

from sb3_reinforce.common.arguments import (
    Check,
    CheckedSchedule,
    check_choice,
    check_device,
    check_flag,
    check_function,
    check_integer,
    check_kind,
    check_number,
    check_subclass,
    optional,
    unknown_name,
)
from sb3_reinforce.common.processes import rank_and_size
from sb3_reinforce.common.spaces import check_noise

# A larger step can take a parameter out of the range of float32
MAX_LEARNING_RATE = 1e6
# What NumPy takes
MAX_SEED = 2**32 - 1
# At this temperature float32 logits prefer no action
MAX_TEMPERATURE = 1e6
# Noise this strong drowns a mean or a parameter
MAX_STD = 1e6
COMPARE_EPISODES = ("time_mean", "leave_one_out", "optimal")
USE_RECURRENT = "a memory needs sb3_reinforce.recurrent.RecurrentREINFORCE; VecFrameStack may be enough instead"
USE_MASKED_POLICY = "use MaskedPolicy and wrap the environment in ActionMaskObservation"
RECURRENT = ("MlpLstmPolicy", "CnnLstmPolicy", "MultiInputLstmPolicy", "RecurrentActorCriticPolicy")
CONTRIB_POLICIES = dict.fromkeys(RECURRENT, USE_RECURRENT) | {"MaskableActorCriticPolicy": USE_MASKED_POLICY}
CONTRIB_POLICIES["MaskedLstmPolicy"] = USE_RECURRENT.partition(";")[0]
NO_CLIPPING = "it takes one policy step per rollout, bounded by max_grad_norm, or with step='natural' by target_kl"
USE_POLICY_KWARGS = "set policy_kwargs=dict(optimizer_class=..., optimizer_kwargs=...)"
# Arguments of PPO and A2C, and what REINFORCE has instead
INSTEAD_OF_PPO = {
    "n_epochs": "it takes one policy step per rollout; n_critic_updates is the number of the critic's passes",
    "clip_range": NO_CLIPPING,
    "clip_range_vf": "the critic's loss is not clipped; max_grad_norm bounds the gradient of each of its steps",
    "use_rms_prop": USE_POLICY_KWARGS,
    "rms_prop_eps": USE_POLICY_KWARGS,
}
UNDISCOUNTED = "it maximizes the undiscounted return of whole episodes, without a critic"
NO_BUFFER = "it keeps the returns of its episodes, and no steps"
NO_PROBABILITIES = "it perturbs the parameters, and does not need the probabilities of actions"
# Arguments of the on-policy algorithms, and what FiniteDifference has instead
INSTEAD_OF_ON_POLICY = {
    "n_steps": "each candidate plays n_eval_episodes whole episodes, and n_delta is the number of perturbations",
    "n_epochs": "it takes one step per update",
    "normalize_advantage": "set standardize_utilities=True",
    **dict.fromkeys(("use_rms_prop", "rms_prop_eps"), USE_POLICY_KWARGS),
    **dict.fromkeys(("gamma", "gae_lambda", "vf_coef"), UNDISCOUNTED),
    **dict.fromkeys(("batch_size", "rollout_buffer_class", "rollout_buffer_kwargs"), NO_BUFFER),
    **dict.fromkeys(("ent_coef", "clip_range", "clip_range_vf", "target_kl"), NO_PROBABILITIES),
    **dict.fromkeys(("use_sde", "sde_sample_freq"), NO_PROBABILITIES),
}


def check_policy_name(policy: str | type, known: Mapping[str, Any]) -> None:
    """Check that the algorithm knows the name of a policy, or can train its class."""
    if policy in known or policy in known.values():
        return
    names = [policy] if isinstance(policy, str) else [each.__name__ for each in policy.__mro__]
    for name in names:
        if name in CONTRIB_POLICIES:
            raise ValueError(f"policy must be one that this algorithm trains, got {names[0]}: {CONTRIB_POLICIES[name]}")
    if isinstance(policy, str):
        raise unknown_name("policy", "a class or one of", known, policy)


def check_callback(name: str, value: Any) -> Any:
    """Return a callback, a function, a list of callbacks or None."""
    is_function = callable(value) and not isinstance(value, type)
    callbacks = value if isinstance(value, list) else [value]
    if not (value is None or is_function or all(isinstance(each, BaseCallback) for each in callbacks)):
        raise TypeError(f"{name} must be a callback, a list of callbacks, a function or None, got {value!r}")
    return value


def check_verbose(name: str, value: Any) -> int:
    """Return a level of output. True counts as 1, as in Stable-Baselines3."""
    return check_integer(name, int(value) if isinstance(value, bool) else value, 0)


check_count = partial(check_integer, low=1)
# The classes add the arguments that name functions
COMMON_ARGUMENTS: dict[str, Check] = {
    "policy": partial(check_kind, kinds=(str, type), allowed="a name or a class"),
    "learning_rate": partial(CheckedSchedule, high=MAX_LEARNING_RATE),
    # SB3 users also write inf for no clipping
    "max_grad_norm": optional(partial(check_number, low=0, high=math.inf, above=True)),
    "max_episode_steps": check_count,
    "stats_window_size": check_count,
    "tensorboard_log": optional(partial(check_kind, kinds=(str, os.PathLike), allowed="a path")),
    "policy_kwargs": optional(partial(check_kind, kinds=(Mapping,), allowed="a dict")),
    "verbose": check_verbose,
    "seed": optional(partial(check_integer, low=0, high=MAX_SEED)),
    "device": check_device,
}
REINFORCE_ARGUMENTS: dict[str, Check] = COMMON_ARGUMENTS | {
    "n_steps": optional(check_count),
    "gamma": partial(check_number, low=0, high=1),
    "gae_lambda": partial(check_number, low=0, high=1),
    "ent_coef": CheckedSchedule,
    "vf_coef": partial(check_number, low=0),
    "n_episodes": optional(check_count),
    "episodes_per_start": check_count,
    "reward_to_go": check_flag,
    "discount_scores": check_flag,
    "normalize_by": partial(check_choice, choices=("steps", "episodes")),
    "n_critic_updates": check_count,
    "batch_size": check_count,
    "critic_learning_rate": optional(partial(CheckedSchedule, high=MAX_LEARNING_RATE)),
    "temperature": partial(CheckedSchedule, above=True, may_reach_zero=True, high=MAX_TEMPERATURE),
    "min_std": partial(CheckedSchedule, high=MAX_STD),
    "use_sde": check_flag,
    "sde_sample_freq": partial(check_integer, low=-1),
    "rollout_buffer_class": optional(partial(check_subclass, base=RolloutBuffer)),
    "rollout_buffer_kwargs": optional(partial(check_kind, kinds=(Mapping,), allowed="a dict")),
    "normalize_advantage": check_flag,
    "step": partial(check_choice, choices=("optimizer", "natural")),
    "target_kl": optional(CheckedSchedule),
}
FINITE_DIFFERENCE_ARGUMENTS: dict[str, Check] = COMMON_ARGUMENTS | {
    "n_delta": optional(check_count),
    "delta_std": optional(partial(CheckedSchedule, above=True, high=MAX_STD)),
    "n_eval_episodes": check_count,
    "common_random_numbers": check_flag,
    "n_top": optional(check_count),
    "standardize_utilities": check_flag,
    "deterministic": check_flag,
}
LEARN_ARGUMENTS: dict[str, Check] = {
    "total_timesteps": partial(check_number, low=0),
    "callback": check_callback,
    "log_interval": optional(check_count),
    "tb_log_name": optional(partial(check_kind, kinds=(str,))),
    "reset_num_timesteps": check_flag,
    "progress_bar": check_flag,
}
# Stable-Baselines3 stores these arguments under other names
ATTRIBUTES = {"policy": "policy_class", "stats_window_size": "_stats_window_size"}


def check_attributes(model: Any) -> None:
    """Check the arguments as the model has them now, and store all but schedules as Python's own types."""
    for name in model._arguments:
        value = model._checked(name)
        if not isinstance(value, CheckedSchedule):
            setattr(model, ATTRIBUTES.get(name, name), value)
    check_subclass("policy", model.policy_class, ActorCriticPolicy)
    space = model.observation_space
    if model.policy_class is MultiInputActorCriticPolicy and not isinstance(space, spaces.Dict):
        raise ValueError(f"policy must be MlpPolicy or CnnPolicy for observations in {space}, got MultiInputPolicy")


def check_reinforce(model: Any) -> None:
    """Check the arguments of a REINFORCE, and choose between steps and whole episodes where the user has not."""
    check_attributes(model)
    check_noise(model.use_sde, model.action_space)
    shares_starts = model.episodes_per_start > 1
    if model.n_steps is None and model.n_episodes is None:
        if model.has_critic and not (shares_starts or model.prefers_episodes):
            model._choose("n_steps", 32)
        else:
            n_envs = model.n_envs * rank_and_size()[1]
            model._choose("n_episodes", n_envs if shares_starts else max(16, n_envs))
    if model.n_steps is not None and model.n_episodes is not None:
        given = f"n_steps={model.n_steps!r} and n_episodes={model.n_episodes!r}"
        raise ValueError(f"{given} are both set: a rollout has a length in steps or in episodes. Set one to None")
    # For episodes that share their start, check_starts says what is allowed
    if model.n_episodes == 1 and model.baseline in COMPARE_EPISODES and not shares_starts:
        reason = f"baseline={model.baseline!r}, which compares episodes"
        raise ValueError(f"n_episodes must be at least 2 with {reason}, got 1")
    if model.gae_lambda < 1 and not (model.has_critic and model.reward_to_go):
        got = f"gae_lambda={model.gae_lambda}, baseline={model.baseline!r} and reward_to_go={model.reward_to_go!r}"
        raise ValueError(f"gae_lambda must be 1 unless baseline='value' and reward_to_go=True, got {got}")
    if model.target_kl is not None and model.step != "natural":
        got = f"target_kl={model.target_kl!r} and step={model.step!r}"
        reason = "it bounds the natural step. PPO's target_kl ends epochs, and there are none here"
        raise ValueError(f"target_kl must be None unless step='natural', got {got}: {reason}")
    if isinstance(model.action_space, spaces.Box):
        if model.temperature != 1:
            raise ValueError(f"temperature={model.temperature!r} is for discrete actions, not for {model.action_space}")
    elif model.min_std != 0:
        raise ValueError(f"min_std={model.min_std!r} is for Box action spaces, not for {model.action_space}")


def check_named(name: str, value: Any, functions: Mapping[str, Callable[..., Any]]) -> Any:
    """Return the user's own function, or the name of one of ours, by which other arguments are checked."""
    function = check_function(name, value, functions)
    return next((each for each, known in functions.items() if known is function), function)


def check_starts(model: Any) -> None:
    """Check that the episodes of a rollout can share their starts, as the model and its environments are now."""
    m = model.episodes_per_start
    n_episodes = model.n_envs * rank_and_size()[1]
    if m == 1:
        return
    if model.n_steps is not None or model.n_episodes != n_episodes or model.n_envs % m:
        raise ValueError(
            f"episodes_per_start={m} needs one whole episode of each environment (n_steps=None, and n_episodes=None or "
            f"{n_episodes}) and a number of environments that {m} divides, got n_steps={model.n_steps}, "
            f"n_episodes={model.n_episodes} and n_envs={model.n_envs}"
        )
    if isinstance(model.baseline, str) and model.baseline not in COMPARE_EPISODES:
        raise ValueError(
            f"episodes_per_start={m} needs a baseline that compares the episodes of a start "
            f"({', '.join(map(repr, COMPARE_EPISODES))} or a function), got baseline={model.baseline!r}"
        )


def check_finite_difference(model: Any) -> None:
    """Check the arguments of a FiniteDifference."""
    check_attributes(model)
    if model.policy_kwargs.get("use_sde"):
        raise ValueError("policy_kwargs must not have use_sde=True: FiniteDifference perturbs parameters, not actions")
    if model.n_delta == 1 and model.estimator == "regression":
        raise ValueError("n_delta must be at least 2 with estimator='regression', which fits an intercept too, got 1")
    if model.n_top is not None and model.estimator != "central":
        raise ValueError(f"n_top={model.n_top!r} needs estimator='central', got estimator={model.estimator!r}")
    if model.n_top is not None and model.n_delta is not None and model.n_top > model.n_delta:
        raise ValueError(f"n_top must be at most n_delta={model.n_delta!r}, got {model.n_top!r}")


def check_learn(env: Any, *arguments: Any) -> None:
    """Check the arguments of ``learn``, in their order."""
    if env is None:
        raise ValueError("env is None, and learning needs an environment: pass one to load, or call set_env")
    default = th.get_default_device()
    if default.type != "cpu":
        reset = "leave the block of th.device, or call th.set_default_device('cpu'); give the model device=... instead"
        raise ValueError(f"PyTorch's default device must be the CPU, got {default}: {reset}")
    for (name, check), value in zip(LEARN_ARGUMENTS.items(), arguments, strict=True):
        check(name, value)
