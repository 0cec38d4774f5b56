"""
A ``gymnasium.vector.VectorEnv`` as a ``VecEnv`` of Stable-Baselines3.

Some environments step all their copies in one array operation, far faster than one copy after the other.
"""

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.envs.classic_control.cartpole import CartPoleVectorEnv
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.wrappers.vector import NormalizeReward, RecordEpisodeStatistics
from numpy.typing import NDArray
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_reinforce.common.interruptions import uninterrupted
from sb3_reinforce.common.tensors import take
from sb3_reinforce.envs.checks import BadData, check_observation, checked_batch, copied


class GymnasiumVecEnv(VecEnv):
    """
    A vector environment of Gymnasium for the algorithms of Stable-Baselines3.

    Each copy is reset within the step that ends its episode; its infos then have ``terminal_observation`` and
    ``TimeLimit.truncated``, as with ``DummyVecEnv``. Observations and rewards are checked for their form at each reset
    and step. Wrap it in ``VecMonitor`` to record the episodes from which ``rollout/ep_rew_mean`` is computed.
    ``seed(s)`` gives copy ``i`` the seed ``s + i`` at the next reset, where the vector environment seeds that way.
    Attributes can only be set for all copies at once, and methods can only be called where each copy is an environment.

    :param env: A vector environment with ``autoreset_mode`` ``SAME_STEP`` or ``DISABLED``, or Gymnasium's vectorized
        CartPole, which is then reset within the step
    :raises TypeError: If ``env`` is not a ``gymnasium.vector.VectorEnv``
    :raises ValueError: If it resets its copies in place of the next step (``NEXT_STEP``), or is ``DISABLED`` below
        Gymnasium's ``RecordEpisodeStatistics`` or ``NormalizeReward``, which then forget the episodes that go on
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]):
        if not isinstance(env, VectorEnv):
            raise TypeError(f"env must be a gymnasium.vector.VectorEnv, got {env!r} of type {type(env).__name__}")
        self.env = env
        self.restart = find_restart(env)
        self.copies: Any = getattr(env.unwrapped, "envs", None)
        self.actions: Any = None
        # A signal that cut a call would leave answers of other processes unread
        self.finishes_calls: Any = uninterrupted if isinstance(env.unwrapped, AsyncVectorEnv) else nullcontext()
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> VecEnvObs:
        """Reset all copies with the pending seed and options; the options must be equal for all copies."""
        first = self._options[0]
        if not all(options is first or data_equivalence(options, first, exact=True) for options in self._options):
            raise ValueError(f"set_options must give all copies of a vector environment the same, got {self._options}")
        with self.finishes_calls:
            obs, infos = self.env.reset(seed=self._seeds[0], options=first or None)
        observations: VecEnvObs = checked_batch(self.observation_space, obs, self.num_envs)
        self.reset_infos = [info_of(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Set the actions of the next step, shape ``(n_envs, *action_space.shape)``."""
        self.actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Make the step; malformed observations and rewards are refused."""
        with self.finishes_calls:
            obs, rewards, terminated, truncated, env_infos = self.env.step(self.actions)
        rewards = np.asarray(rewards)
        # Integers would not mask, but index the copies 0 and 1
        terminated = np.asarray(terminated, dtype=bool)
        truncated = np.asarray(truncated, dtype=bool)
        if rewards.shape != (self.num_envs,) or rewards.dtype.kind not in "biuf":
            raise BadData(f"The rewards must be {self.num_envs} numbers, one per environment, got {rewards.tolist()}")
        obs = checked_batch(self.observation_space, obs, self.num_envs)
        dones = terminated | truncated
        ended = np.flatnonzero(dones).tolist()
        if self.restart is None and ended and "final_obs" not in env_infos:
            raise ValueError(
                f"{self.env} has autoreset_mode SAME_STEP, but its infos have no 'final_obs' where an episode ended: "
                "return it from step, or use autoreset_mode DISABLED"
            )
        # A copy that has reset itself returns the last step's observation and infos in separate entries
        last_obs = env_infos.pop("final_obs", obs)
        last_infos = env_infos.pop("final_info", env_infos)
        for mask in ("_final_obs", "_final_info"):
            env_infos.pop(mask, None)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if env_infos or last_infos:
            infos = [info_of(last_infos if done else env_infos, i) for i, done in enumerate(dones)]
        for info, is_cut in zip(infos, (truncated & ~terminated).tolist(), strict=True):
            info["TimeLimit.truncated"] = is_cut
        if ended:
            # Gymnasium's RecordEpisodeStatistics puts an episode that has ended beside the infos of the next one
            episodes = {key: values for key, values in env_infos.items() if key in ("episode", "_episode")}
            for i in ended:
                infos[i] |= info_of(episodes, i)
                check_observation(self.observation_space, take(last_obs, i), i)
                infos[i]["terminal_observation"] = copied(self.observation_space, take(last_obs, i))
            reset_infos = env_infos
            if self.restart is not None:
                with self.finishes_calls:
                    obs, reset_infos = self.restart(self.env, dones)
                obs = checked_batch(self.observation_space, obs, self.num_envs)
            for i in ended:
                self.reset_infos[i] = info_of(reset_infos, i)
        return obs, rewards.astype(np.float32), dones, infos

    def close(self) -> None:
        """Close the vector environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of each copy, or of the vector environment where it has no copies."""
        if self.copies is not None:
            values = [single.get_wrapper_attr(attr_name) for single in self.copies]
        elif hasattr(self.env.unwrapped, "get_attr"):
            with self.finishes_calls:
                values = self.env.unwrapped.get_attr(attr_name)
        else:
            values = [getattr(self.env.unwrapped, attr_name)] * self.num_envs
        return [values[i] for i in self._get_indices(indices)]

    def has_attr(self, attr_name: str) -> bool:
        """Whether the copies have an attribute."""
        if isinstance(self.env.unwrapped, AsyncVectorEnv):
            # Gymnasium closes processes that are asked for an attribute that they lack
            with self.finishes_calls:
                return all(self.env.unwrapped.call("has_wrapper_attr", attr_name))
        return super().has_attr(attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all copies; ``indices`` must be None or name all of them."""
        if {*self._get_indices(indices)} != {*range(self.num_envs)}:
            raise ValueError(f"indices must be None to set {attr_name!r} in a vector environment, got {indices}")
        if hasattr(self.env.unwrapped, "set_attr"):
            with self.finishes_calls:
                self.env.unwrapped.set_attr(attr_name, [value] * self.num_envs)
        else:
            setattr(self.env.unwrapped, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the copies; a NotImplementedError says where there are none that could be called."""
        wanted = list(self._get_indices(indices))
        if self.copies is not None:
            calls = [self.copies[i].get_wrapper_attr(method_name) for i in wanted]
            return [call(*method_args, **kwargs) for call in calls]
        if isinstance(self.env.unwrapped, AsyncVectorEnv) and method_name == "reset":
            with self.finishes_calls:
                return reset_copies(self.env.unwrapped, wanted, **kwargs)
        if wanted == list(range(self.num_envs)) and hasattr(self.env.unwrapped, "call"):
            with self.finishes_calls:
                return list(self.env.unwrapped.call(method_name, *method_args, **kwargs))
        raise NotImplementedError(f"{self.env} has no single copies to call {method_name!r} on")

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper[Any, Any, Any, Any]], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Whether each copy is wrapped in a ``wrapper_class``; in other processes by its name, without subclasses."""
        found = [False] * self.num_envs
        if self.copies is not None:
            found = [is_wrapped(single, wrapper_class) for single in self.copies]
        elif isinstance(self.env.unwrapped, AsyncVectorEnv):
            with self.finishes_calls:
                found = [f"<{wrapper_class.__name__}<" in text for text in self.env.unwrapped.call("__str__")]
        return [found[i] for i in self._get_indices(indices)]

    def get_images(self) -> list[np.ndarray | None]:
        """A picture of each copy; None where there is none."""
        with self.finishes_calls:
            pictures: Any = self.env.render()
        return [None] * self.num_envs if pictures is None else list(pictures)


def find_restart(env: VectorEnv[Any, Any, Any]) -> Callable[[Any, NDArray[np.bool_]], Any] | None:
    """A function that starts new episodes in copies whose episode has ended; None if the environment does it itself."""
    # The metadata may belong to the class, so the attribute comes first
    mode = getattr(env.unwrapped, "autoreset_mode", env.metadata.get("autoreset_mode"))
    if mode is AutoresetMode.SAME_STEP:
        return None
    if mode is AutoresetMode.DISABLED:
        wrapper = env
        while isinstance(wrapper, VectorWrapper):
            # A reset by mask clears what they know of all copies
            for forgetful, instead in ((RecordEpisodeStatistics, "VecMonitor"), (NormalizeReward, "VecNormalize")):
                if isinstance(wrapper, forgetful):
                    raise ValueError(
                        f"{forgetful.__name__} with autoreset_mode DISABLED clears the statistics of all copies when "
                        f"one of them is reset: leave it out of {env}, and wrap the GymnasiumVecEnv in {instead}"
                    )
            wrapper = wrapper.env
        return restart_by_mask
    if type(env) is CartPoleVectorEnv:
        return restart_cart_pole
    raise ValueError(
        f"{env} has autoreset_mode {mode}, with which transitions would lead from one episode into the next: it must "
        "be SAME_STEP or DISABLED, for instance "
        "gym.make_vec(..., vectorization_mode='sync', vector_kwargs={'autoreset_mode': 'SameStep'})"
    )


def restart_by_mask(env: VectorEnv[Any, Any, Any], ended: NDArray[np.bool_]) -> Any:
    """Start new episodes where ``ended`` (n_envs,) by Gymnasium's ``reset_mask``."""
    return env.reset(options={"reset_mask": ended})


def restart_cart_pole(env: Any, ended: NDArray[np.bool_]) -> Any:
    """Start new episodes where ``ended`` (n_envs,), which CartPole would do in place of the next step."""
    env.state[:, ended] = env.np_random.uniform(env.low, env.high, (4, ended.sum()))
    env.steps[ended] = 0
    env.prev_done[ended] = False
    return env.state.T.astype(np.float32), {}


def reset_copies(env: AsyncVectorEnv, wanted: list[int], seed: int | None = None, options: Any = None) -> list[Any]:
    """The observation and info of each of the ``wanted`` copies, reset in their processes by ``reset_mask``."""
    mask = np.isin(np.arange(env.num_envs), wanted)
    obs, infos = env.reset(seed=[seed] * env.num_envs, options={**(options or {}), "reset_mask": mask})
    return [(take(obs, i), info_of(infos, i)) for i in wanted]


def info_of(env_infos: dict[str, Any], i: int) -> dict[str, Any]:
    """The info of copy ``i`` from Gymnasium's dict of arrays, in which ``_key`` masks ``key``."""
    info = {}
    masks = {f"_{key}" for key in env_infos}
    for key, values in env_infos.items():
        if key not in masks and (f"_{key}" not in env_infos or env_infos[f"_{key}"][i]):
            info[key] = info_of(values, i) if isinstance(values, dict) else values[i]
    return info
