"""
Action masks as part of the observation: no algorithm, callback or VecEnv has to know of them.

The mask stands behind the features, bypasses the layers of the actor, and meets the logits at the end.
"""

from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    MlpExtractor,
    NatureCNN,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

KEY = "action_mask"
# The key of an observation that was no dict before the mask was added
OBSERVATION = "observation"
# The logit of a masked action: its probability is 0 at any temperature. With −∞ a divergence's gradient can be NaN
FORBIDDEN = -1e30

Part = TypeVar("Part")


class ActionMaskObservation(gym.Wrapper[dict[str, Any], Any, Any, Any]):
    """
    Adds the mask of an environment's ``action_masks()`` to its observations, under the key ``"action_mask"``.

    An observation that is not a dict becomes ``{"observation": ..., "action_mask": ...}``. The mask is an int8 array of
    shape ``(n,)``, 1 where an action is allowed: n is the number of actions for ``Discrete``, and for
    ``MultiDiscrete`` the sum of the numbers of each dimension, one dimension after the other. This is the contract of
    sb3-contrib's ``MaskablePPO``, so its environments with these actions can be wrapped as they are, and so can its
    ``ActionMasker``. In a terminal state the environment is not asked, and the mask is 0.

    ``MaskedPolicy`` obeys the mask; other policies take it for a feature. ``VecNormalize`` needs ``norm_obs_keys``,
    since a mask cannot be normalized, and frames are stacked below this wrapper, not by ``VecFrameStack``.

    :param env: An environment with a method ``action_masks()`` that returns n booleans
    :raises TypeError: If the environment has no such method
    :raises ValueError: If actions are neither ``Discrete`` nor ``MultiDiscrete``, or observations already have a mask;
        in ``reset`` and ``step``, if the mask is not n zeros and ones, or allows nothing before the episode is over
    """

    def __init__(self, env: gym.Env[Any, Any]):
        super().__init__(env)
        sizes = sizes_of(env.action_space)
        if not (env.has_wrapper_attr("action_masks") and callable(env.get_wrapper_attr("action_masks"))):
            raise TypeError(f"env must have a method action_masks() that says which actions are allowed, got {env}")
        space = env.observation_space
        self._has_dicts = isinstance(space, spaces.Dict)
        parts = space.spaces if isinstance(space, spaces.Dict) else {OBSERVATION: space}
        if KEY in parts:
            raise ValueError(f"The observations of env must not have the key {KEY!r} yet, got {space}")
        self._n_actions = sum(sizes)
        self._first_actions = np.cumsum([0, *sizes[:-1]])
        self.observation_space = spaces.Dict({**parts, KEY: spaces.MultiBinary(self._n_actions)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        """As ``gymnasium.Env.reset``, with the mask in the observation."""
        obs, info = self.env.reset(seed=seed, options=options)
        return self._with_mask(obs, self._allowed(is_over=False)), info

    def step(self, action: Any) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """As ``gymnasium.Env.step``, with the mask in the observation."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        # An environment need not know the actions of a terminal state
        mask = np.zeros(self._n_actions, dtype=bool) if terminated else self._allowed(is_over=truncated)
        return self._with_mask(obs, mask), reward, terminated, truncated, info

    def _allowed(self, is_over: bool) -> NDArray[np.bool_]:
        """The mask of the present state."""
        masks = self.env.get_wrapper_attr("action_masks")()
        try:
            numbers = np.ravel(masks)
        except ValueError:
            # Lists of different lengths
            numbers = np.empty(0)
        # A mask that is added to logits (0 = allowed) would be read the other way round
        if len(numbers) != self._n_actions or not np.isin(numbers, (0, 1)).all():
            raise ValueError(
                f"action_masks() must return {self._n_actions} booleans in a row for {self.action_space}, got {masks!r}"
            )
        mask = numbers.astype(bool)
        if not is_over and not np.logical_or.reduceat(mask, self._first_actions).all():
            each = " in each dimension" if isinstance(self.action_space, spaces.MultiDiscrete) else ""
            raise ValueError(
                f"action_masks() must allow an action{each} of {self.action_space} until the episode is over, "
                f"got {masks!r}"
            )
        return mask

    def _with_mask(self, obs: Any, mask: NDArray[np.bool_]) -> dict[str, Any]:
        """An observation with a mask."""
        parts = obs if self._has_dicts else {OBSERVATION: obs}
        return {**parts, KEY: mask.astype(np.int8)}


def sizes_of(action_space: spaces.Space[Any]) -> list[int]:
    """The number of actions in each dimension of a Discrete or MultiDiscrete space."""
    if isinstance(action_space, spaces.Discrete):
        return [int(action_space.n)]
    if isinstance(action_space, spaces.MultiDiscrete):
        return [int(n) for n in action_space.nvec.flat]
    raise ValueError(f"action_space must be Discrete or MultiDiscrete for its actions to be masked, got {action_space}")


def without_mask(parts: dict[str, Part]) -> Part | dict[str, Part]:
    """Undo ``ActionMaskObservation``: the observation without its mask, or the same for spaces."""
    rest = {key: part for key, part in parts.items() if key != KEY}
    return rest[OBSERVATION] if rest.keys() == {OBSERVATION} else rest


def split_mask(features: th.Tensor, n_actions: int) -> tuple[th.Tensor, th.Tensor]:
    """Features ``(..., n_features)`` and the mask ``(..., n_actions)`` that is appended to them."""
    return features[..., :-n_actions], features[..., -n_actions:]


class MaskedExtractor(BaseFeaturesExtractor):
    """The features and the mask behind them, ``(n, features_dim + n_actions)``; ``features_dim`` sizes the layers."""

    def __init__(self, space: spaces.Dict, extractor: BaseFeaturesExtractor):
        super().__init__(space, int(extractor.features_dim))
        self.extractor = extractor

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        features = self.extractor(without_mask(observations))
        return th.cat([features, observations[KEY].to(features)], dim=1)


class MaskedMlpExtractor(nn.Module):
    """The latents of the actor with the mask behind them, and the critic's latents without it."""

    def __init__(self, extractor: MlpExtractor, n_actions: int):
        super().__init__()
        self.extractor = extractor
        self.n_actions = n_actions
        self.latent_dim_pi = extractor.latent_dim_pi
        self.latent_dim_vf = extractor.latent_dim_vf

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        features, mask = split_mask(features, self.n_actions)
        return th.cat([self.extractor.forward_actor(features), mask], dim=-1)

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return self.extractor.forward_critic(split_mask(features, self.n_actions)[0])


class MaskedLogits(nn.Module):
    """``logits(s, a)`` where a is allowed, else ``FORBIDDEN``; in a dimension where nothing is allowed, all is."""

    def __init__(self, action_net: nn.Module, sizes: list[int]):
        super().__init__()
        self.action_net = action_net
        self.sizes = sizes

    def forward(self, latent: th.Tensor) -> th.Tensor:
        latent, mask = split_mask(latent, sum(self.sizes))
        # A mask that allows nothing, as in terminal states, allows all: with all logits FORBIDDEN, log π would be 0
        allowed = [part | ~part.any(-1, keepdim=True) for part in th.split(mask.bool(), self.sizes, dim=-1)]
        logits: th.Tensor = self.action_net(latent)
        return logits.masked_fill(~th.cat(allowed, dim=-1), FORBIDDEN)


class MaskedPolicy(ActorCriticPolicy):
    """
    An ``ActorCriticPolicy`` that never takes a masked action, for REINFORCE, FiniteDifference, A2C, PPO and TRPO.

    π is the softmax over the actions that ``observation["action_mask"]`` allows (see ``ActionMaskObservation``);
    log π, its gradient and the entropy belong to that distribution. Where the mask allows nothing, as in terminal
    states, all actions are allowed. The critic and the features do not see the mask. A2C, PPO and TRPO need action
    spaces that start at 0.

    :param observation_space: A ``Dict`` with the key ``"action_mask"`` and at least one more
    :param action_space: ``Discrete`` or ``MultiDiscrete``
    :param lr_schedule: Learning rate schedule
    :param features_extractor_class: Extracts the features of the observation without the mask: of the array under
        ``"observation"`` if nothing else is there, else of the dict. None for the extractor of MlpPolicy, CnnPolicy or
        MultiInputPolicy, whichever fits
    :param kwargs: As for ``ActorCriticPolicy``
    :raises ValueError: If the observation or action space does not have this form
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        **kwargs: Any,
    ):
        n_actions = sum(sizes_of(action_space))
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {}
        if parts.get(KEY) != spaces.MultiBinary(n_actions) or len(parts) == 1:
            raise ValueError(
                f"MaskedPolicy needs an observation_space that is a Dict with {KEY!r}: MultiBinary({n_actions}) and at "
                f"least one more key, got {observation_space}: wrap the environment in ActionMaskObservation"
            )
        if features_extractor_class is None:
            features_extractor_class = extractor_class_for(without_mask(parts))
        super().__init__(
            observation_space, action_space, lr_schedule, features_extractor_class=features_extractor_class, **kwargs
        )

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Make a features extractor that leaves the mask alone."""
        space: Any = self.observation_space
        rest = without_mask(space.spaces)
        inner = self.features_extractor_class(
            spaces.Dict(rest) if isinstance(rest, dict) else rest, **self.features_extractor_kwargs
        )
        return MaskedExtractor(space, inner)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # Not in _build_mlp_extractor, which users override
        sizes = sizes_of(self.action_space)
        self.mlp_extractor = MaskedMlpExtractor(self.mlp_extractor, sum(sizes))  # type: ignore[assignment]
        self.action_net = MaskedLogits(self.action_net, sizes)

    def obs_to_tensor(self, observation: Any) -> tuple[PyTorchObs, bool]:
        """As for any policy, with an error for an observation without a mask."""
        if not isinstance(observation, dict) or KEY not in observation:
            raise ValueError(
                f"observation must be a dict with the key {KEY!r}, got {observation!r}: wrap this environment in "
                "ActionMaskObservation too"
            )
        return super().obs_to_tensor(observation)


def extractor_class_for(space: spaces.Space[Any] | dict[str, spaces.Space[Any]]) -> type[BaseFeaturesExtractor]:
    """The features extractor that Stable-Baselines3's policies use by default."""
    if isinstance(space, dict):
        return CombinedExtractor
    return NatureCNN if is_image_space(space) else FlattenExtractor
