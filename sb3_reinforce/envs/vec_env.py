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

from sb3_reinforce.envs.batches import check_batch, copy, info_of, one_of
from sb3_reinforce.envs.checks import check_observation
from sb3_reinforce.estimation.returns import Bools

Restart: TypeAlias = Callable[[Any, Bools], Any]


def restart_by_mask(env: VectorEnv[Any, Any, Any], ended: Bools) -> Any:
    """
    Start new episodes by Gymnasium's ``reset_mask``.

    :param env: An environment that does not reset itself
    :param ended: Which copies to reset, shape ``(n_envs,)``
    :return: The observations and infos of all copies
    """
    return env.reset(options={"reset_mask": ended})


def restart_cart_pole(env: Any, ended: Bools) -> Any:
    """
    Start new episodes at once, which Gymnasium's vectorised CartPole would only do in place of the next step.

    :param env: The environment
    :param ended: Which copies to reset, shape ``(n_envs,)``
    :return: The observations of all copies, and their infos, which are empty
    """
    env.state[:, ended] = env.np_random.uniform(env.low, env.high, (4, ended.sum()))
    env.steps[ended] = 0
    env.prev_done[ended] = False
    return env.state.T.astype(np.float32), {}


def restart_of(env: VectorEnv[Any, Any, Any]) -> Restart | None:
    """
    How copies whose episode has ended start a new one within the same step, as Stable-Baselines3 expects.

    :param env: The environment
    :return: A function that resets them; None if the environment does it by itself
    :raises ValueError: If it resets them in place of the next step. An action would then be ignored and its transition
        would lead from one episode into the next
    """
    # Environments of one class share their metadata
    mode = getattr(env.unwrapped, "autoreset_mode", env.metadata.get("autoreset_mode"))
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
        """
        Reset all copies; copy i gets the seed s + i after ``seed(s)``, if the vector environment seeds that way.

        :raises ValueError: If ``set_options`` has given the copies different options
        """
        if any(options != self._options[0] for options in self._options):
            raise ValueError(f"set_options must give all copies of a vector environment the same, got {self._options}")
        obs, infos = self.env.reset(seed=self._seeds[0], options=self._options[0] or None)
        self.reset_infos = [info_of(infos, i) for i in range(self.num_envs)]
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
        check_batch(self.observation_space, obs, rewards, self.num_envs)
        dones = terminated | truncated
        if self.restart is None and dones.any() and "final_obs" not in env_infos:
            raise ValueError(f"{self.env} says that it resets its copies in the same step, but gave no final_obs")
        # A copy that has reset itself tells its last step's observation and infos apart from those of the reset
        last_obs, last_infos = env_infos.pop("final_obs", obs), env_infos.pop("final_info", env_infos)
        for mask in ("_final_obs", "_final_info"):
            env_infos.pop(mask, None)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if env_infos or last_infos:
            infos = [info_of(last_infos if done else env_infos, i) for i, done in enumerate(dones)]
            # Gymnasium's RecordEpisodeStatistics tells of an episode that has ended beside the infos of the next one
            episodes = {key: values for key, values in env_infos.items() if key in ("episode", "_episode")}
            for i in np.flatnonzero(dones).tolist():
                infos[i] |= info_of(episodes, i)
        for info, is_cut in zip(infos, (truncated & ~terminated).tolist(), strict=True):
            info["TimeLimit.truncated"] = is_cut
        if dones.any():
            ended = np.flatnonzero(dones).tolist()
            for i in ended:
                check_observation(self.observation_space, one_of(last_obs, i), i)
                infos[i]["terminal_observation"] = copy(one_of(last_obs, i))
            obs, reset_infos = (obs, env_infos) if self.restart is None else self.restart(self.env, dones)
            for i in ended:
                self.reset_infos[i] = info_of(reset_infos, i)
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
        copies = getattr(self.env.unwrapped, "envs", None)
        if copies is not None and attr_name != "render_mode":
            values = [single.get_wrapper_attr(attr_name) for single in copies]
        elif hasattr(self.env.unwrapped, "get_attr") and attr_name != "render_mode":
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
            self.env.unwrapped.set_attr(attr_name, [value] * self.num_envs)
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
        :raises NotImplementedError: If the vector environment has no copies that could be called, or only all at once
        """
        copies, wanted = getattr(self.env.unwrapped, "envs", None), list(self._get_indices(indices))
        if copies is None and wanted == list(range(self.num_envs)) and hasattr(self.env.unwrapped, "call"):
            return list(self.env.unwrapped.call(method_name, *method_args, **kwargs))
        if copies is None:
            raise NotImplementedError(f"{self.env} has no single copies to call {method_name!r} on")
        calls = [copies[i].get_wrapper_attr(method_name) for i in wanted]
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
