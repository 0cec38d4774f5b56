"""What the arguments of REINFORCE must satisfy, alone and together, and what those left open become."""

from collections.abc import Mapping
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_reinforce.common.arguments import (
    as_integers,
    check_choice,
    check_flag,
    check_function,
    check_kind,
    check_number,
)
from sb3_reinforce.common.common_settings import check_basics_of
from sb3_reinforce.estimation.baselines import BASELINES

DEFAULT_N_STEPS = 32
DEFAULT_N_EPISODES = 16


def check_reinforce(model: Any) -> None:
    """
    Check a model's arguments, and choose between fixed rollouts and whole episodes where the user has not.

    Called at construction and again by ``load``, which may bring other arguments and another action space.

    :param model: A ``REINFORCE`` with its arguments as attributes
    :raises TypeError: If an argument is of the wrong kind
    :raises ValueError: If an argument is out of its range, or does not go with another
    """
    check_basics_of(model)
    check_function("baseline", model.baseline, BASELINES)
    if model.n_steps is None and model.n_episodes is None:
        model.n_steps = DEFAULT_N_STEPS if model.has_critic else None
        model.n_episodes = None if model.has_critic else DEFAULT_N_EPISODES
    if model.n_steps is not None and model.n_episodes is not None:
        raise ValueError(
            f"n_steps={model.n_steps!r} and n_episodes={model.n_episodes!r} are both given: a rollout is either a "
            "number of steps or a number of whole episodes, so set one of them to None"
        )
    least = {"n_critic_updates": 1, "batch_size": 1, "max_episode_steps": 1, "sde_sample_freq": -1}
    if model.n_steps is None:
        least["n_episodes"] = 2 if model.baseline in ("leave_one_out", "optimal") else 1
    else:
        least["n_steps"] = 1
    as_integers(model, least)
    for name in ("reward_to_go", "discount_scores", "normalize_advantage", "use_sde"):
        check_flag(name, getattr(model, name))
    check_kind("rollout_buffer_kwargs", model.rollout_buffer_kwargs, (Mapping,))
    buffer_class = model.rollout_buffer_class
    if buffer_class is not None and not (isinstance(buffer_class, type) and issubclass(buffer_class, RolloutBuffer)):
        raise TypeError(f"rollout_buffer_class must be a subclass of RolloutBuffer, got {buffer_class!r}")
    check_number("gamma", model.gamma, 0, 1)
    check_number("gae_lambda", model.gae_lambda, 0, 1)
    check_number("vf_coef", model.vf_coef, 0)
    check_number("min_std", model.min_std, 0)
    if model.max_grad_norm is not None:
        check_number("max_grad_norm", model.max_grad_norm, 0, above=True)
    check_choice("normalize_by", model.normalize_by, ("steps", "episodes"))
    if model.gae_lambda < 1 and not (model.has_critic and model.reward_to_go):
        raise ValueError(
            f"gae_lambda={model.gae_lambda} needs baseline='value' and reward_to_go=True, got "
            f"baseline={model.baseline!r} and reward_to_go={model.reward_to_go!r}"
        )
    if isinstance(model.action_space, spaces.Box):
        if model.temperature != 1:
            raise ValueError(f"temperature={model.temperature!r} is for discrete actions, not for {model.action_space}")
    elif model.min_std > 0:
        raise ValueError(f"min_std={model.min_std!r} is for Box action spaces, not for {model.action_space}")
