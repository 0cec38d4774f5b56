"""
A ``gymnasium.vector.VectorEnv`` as a ``VecEnv`` of Stable-Baselines3.

Some environments step all their copies in one array operation, far faster than one copy after the other. Any algorithm
of Stable-Baselines3 can train on them through this adapter.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.vector import AutoresetMode, VectorEnv
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_reinforce.returns import Bools

Restart: TypeAlias = Callable[[Any, Bools], Any]


def restart_by_mask(env: VectorEnv[Any, Any, Any], ended: Bools) -> Any:
    """
    Start new episodes by Gymnasium's ``reset_mask``.

    :param env: An environment that does not reset itself
    :param ended: Which copies to reset, shape ``(n_envs,)``
    :return: The observations of all copies
    """
    return env.reset(options={"reset_mask": ended})[0]


def restart_cart_pole(env: Any, ended: Bools) -> Any:
    """
    Start new episodes at once, which Gymnasium's vectorised CartPole would only do in place of the next step.

    :param env: The environment
    :param ended: Which copies to reset, shape ``(n_envs,)``
    :return: The observations of all copies
    """
    env.state[:, ended] = env.np_random.uniform(env.low, env.high, (4, ended.sum()))
    env.steps[ended] = 0
    env.prev_done[ended] = False
    return env.state.T.astype(np.float32)


def restart_of(env: VectorEnv[Any, Any, Any]) -> Restart | None:
    """
    How copies whose episode has ended start a new one within the same step, as Stable-Baselines3 expects.

    :param env: The environment
    :return: A function that resets them; None if the environment does it by itself
    :raises ValueError: If it resets them in place of the next step. An action would then be ignored and its transition
        would lead from one episode into the next
    """
    mode = env.metadata.get("autoreset_mode")
    if mode is AutoresetMode.SAME_STEP:
        return None
    if mode is AutoresetMode.DISABLED:
        return restart_by_mask
    if type(env) is CartPoleVectorEnv:
        return restart_cart_pole
    raise ValueError(
        f"{env} has autoreset_mode {mode}, with which transitions would lead from one episode into the next: it must "
        "be SAME_STEP or DISABLED, for instance "
        "gym.make_vec(..., vectorization_mode='sync', vector_kwargs={'autoreset_mode': 'SameStep'})"
    )


class GymnasiumVecEnv(VecEnv):
    """
    The adapter: autoreset within the step, ``terminal_observation`` and ``TimeLimit.truncated`` in the infos.

    ``VecMonitor`` on top of it records the episodes that ``rollout/ep_rew_mean`` is made from.

    :param env: A vector environment that resets its copies in the same step, or not by itself, or Gymnasium's natively
        vectorised CartPole
    :raises TypeError: If ``env`` is not a vector environment
    :raises ValueError: If it resets its copies one step late
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]):
        if not isinstance(env, VectorEnv):
            raise TypeError(f"env must be a gymnasium.vector.VectorEnv, got {env!r} of type {type(env).__name__}")
        self.env, self.restart = env, restart_of(env)
        self.actions: Any = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Reset all copies; copy i gets the seed s + i after ``seed(s)``, if the vector environment seeds that way."""
        obs, _ = self.env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        observations: VecEnvObs = copy(obs)
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """
        Take the actions of the next step.

        :param actions: Shape ``(n_envs, *action_space.shape)``
        """
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Make the step."""
        obs, rewards, terminated, truncated, env_infos = self.env.step(self.actions)
        infos = [{"TimeLimit.truncated": cut} for cut in (truncated & ~terminated).tolist()]
        dones = terminated | truncated
        # A copy that has reset itself tells its last step's observation and infos apart from those of the reset
        last_obs, last_infos = env_infos.pop("final_obs", obs), env_infos.pop("final_info", env_infos)
        distribute(env_infos, infos, ~dones)
        if dones.any():
            distribute(last_infos, infos, dones)
            for i in np.flatnonzero(dones):
                infos[i]["terminal_observation"] = copy(one_of(last_obs, int(i)))
            obs = obs if self.restart is None else self.restart(self.env, dones)
        return copy(obs), rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """
        An attribute of each copy, or what all share where the vector environment has no copies of its own.

        :param attr_name: Its name
        :param indices: Of which copies
        """
        if hasattr(self.env.unwrapped, "get_attr") and attr_name != "render_mode":
            values = self.env.unwrapped.get_attr(attr_name)
        else:
            values = [getattr(self.env, attr_name)] * self.num_envs
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """
        Set an attribute of all copies.

        :param attr_name: Its name
        :param value: Its value
        :param indices: All copies: vector environments cannot set it for some of them
        :raises ValueError: If ``indices`` names some copies only
        """
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"indices must be None to set {attr_name!r} in a vector environment, got {indices}")
        if hasattr(self.env.unwrapped, "set_attr"):
            self.env.unwrapped.set_attr(attr_name, value)
        else:
            setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """
        Call a method of the copies.

        :param method_name: Its name
        :param method_args: Its arguments
        :param indices: Of which copies
        :param kwargs: Its keyword arguments
        :raises NotImplementedError: If the vector environment has no copies in this process that could be called
        """
        copies = getattr(self.env.unwrapped, "envs", None)
        if copies is None:
            raise NotImplementedError(f"{self.env} has no single copies to call {method_name!r} on")
        calls = [copies[i].get_wrapper_attr(method_name) for i in self._get_indices(indices)]
        return [call(*method_args, **kwargs) for call in calls]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """
        Whether copies are wrapped in a wrapper.

        :param wrapper_class: The wrapper
        :param indices: Of which copies
        """
        copies = getattr(self.env.unwrapped, "envs", None)
        return [copies is not None and is_wrapped(copies[i], wrapper_class) for i in self._get_indices(indices)]

    def get_images(self) -> list[np.ndarray | None]:
        """A picture of each copy."""
        pictures: Any = self.env.render() or [None] * self.num_envs
        return list(pictures)


def one_of(obs: Any, i: int) -> Any:
    """
    The observation of one copy.

    :param obs: Observations of all copies, an array or a dict of arrays
    :param i: Which copy
    """
    return {key: part[i] for key, part in obs.items()} if isinstance(obs, dict) else obs[i]


def copy(obs: Any) -> Any:
    """
    Observations that the environment does not write into later.

    :param obs: An array or a dict of arrays
    """
    return {key: np.array(part) for key, part in obs.items()} if isinstance(obs, dict) else np.array(obs)


def distribute(env_infos: dict[str, Any], infos: list[dict[str, Any]], which: Bools) -> None:
    """
    Gymnasium's dict of arrays, in which ``_key`` masks ``key``, into a dict for each copy.

    :param env_infos: The infos of a vector environment
    :param infos: A dict for each copy, to add to
    :param which: Which copies to add to, shape ``(n_envs,)``
    """
    for key, values in env_infos.items():
        if not key.startswith("_"):
            for i in np.flatnonzero(which & env_infos.get(f"_{key}", True)):
                infos[i][key] = one_of(values, int(i))
