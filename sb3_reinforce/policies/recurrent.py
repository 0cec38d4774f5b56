"""The recurrent policies of sb3-contrib, as RecurrentREINFORCE trains them."""

from typing import Any

import torch as th

try:
    from sb3_contrib.common.recurrent.policies import (
        RecurrentActorCriticCnnPolicy,
        RecurrentActorCriticPolicy,
        RecurrentMultiInputActorCriticPolicy,
    )
except ImportError as error:
    raise ImportError(
        f"sb3_reinforce.recurrent needs sb3-contrib ({error}): pip install 'sb3-reinforce[recurrent]', or "
        "pip install -e '.[recurrent]' in a clone of the repository"
    ) from error

from sb3_reinforce.policies.masks import MaskedPolicy, sizes_of, split_mask
from sb3_reinforce.policies.sequences import RecurrentPolicy, Rows


class MlpLstmPolicy(RecurrentPolicy, RecurrentActorCriticPolicy):
    """
    A recurrent policy for observations that are vectors, with the arguments of sb3-contrib's class and one more.

    The arguments below are given as ``policy_kwargs``. With ``ortho_init``, recurrent weights start orthogonal too.

    :param memory: ``"lstm"`` (default), ``"gru"`` (Cho et al., 2014) or ``"rnn"`` (an Elman network, 1990)
    :param lstm_hidden_size: Hidden units of each layer, 256 by default
    :param n_lstm_layers: Number of layers, 1 by default
    :param enable_critic_lstm: Whether the critic has a separate memory, True by default
    :param shared_lstm: Whether the critic reads the actor's memory, without training it; False by default. It needs
        ``enable_critic_lstm=False`` and a shared features extractor
    :param lstm_kwargs: ``bias``, ``dropout``, and ``nonlinearity`` of ``"rnn"``
    :param kwargs: As for ``ActorCriticPolicy``
    :raises AssertionError: If ``shared_lstm`` does not go with the other arguments
    :raises TypeError: If a number of units or layers is not an integer
    :raises ValueError: If ``memory`` or ``lstm_kwargs`` is unknown, or a number is below 1
    """


class CnnLstmPolicy(RecurrentPolicy, RecurrentActorCriticCnnPolicy):
    """A recurrent policy for images, with the arguments of :class:`MlpLstmPolicy`."""


class MultiInputLstmPolicy(RecurrentPolicy, RecurrentMultiInputActorCriticPolicy):
    """A recurrent policy for Dict observations, with the arguments of :class:`MlpLstmPolicy`."""


class MaskedLstmPolicy(MaskedPolicy, RecurrentPolicy, RecurrentActorCriticPolicy):
    """
    A recurrent policy that never takes a masked action.

    :param args: As for :class:`~sb3_reinforce.MaskedPolicy`
    :param kwargs: As for :class:`~sb3_reinforce.MaskedPolicy` and :class:`MlpLstmPolicy`
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.n_actions = sum(sizes_of(self.action_space))
        if self.critic is not None:
            self.critic = BesideMask(self.critic, self.n_actions)

    def remember(self, recurrence: th.nn.RNNBase, features: th.Tensor, rows: Rows) -> th.Tensor:
        """The outputs of a recurrent network for n rows of sequences, with the mask behind them."""
        features, mask = split_mask(features, self.n_actions)
        return th.cat([super().remember(recurrence, features, rows), mask], dim=1)

    def _process_sequence(  # type: ignore[override]
        self, features: th.Tensor, lstm_states: Any, episode_starts: th.Tensor, lstm: th.nn.LSTM
    ) -> tuple[th.Tensor, Any]:
        features, mask = split_mask(features, self.n_actions)
        outputs, states = super()._process_sequence(features, lstm_states, episode_starts, lstm)
        return th.cat([outputs, mask], dim=1), states


class BesideMask(th.nn.Module):
    """A layer whose inputs end with a mask: it computes the rest, and appends the mask to its outputs."""

    def __init__(self, layer: th.nn.Module, n_actions: int):
        super().__init__()
        self.layer = layer
        self.n_actions = n_actions

    def forward(self, features: th.Tensor) -> th.Tensor:
        features, mask = split_mask(features, self.n_actions)
        return th.cat([self.layer(features), mask], dim=1)
