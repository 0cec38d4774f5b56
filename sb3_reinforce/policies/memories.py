"""The recurrent networks that a policy may remember with, and checks of their arguments."""

from typing import Any, TypeAlias

import torch as th
from torch import nn

from sb3_reinforce.common.arguments import check_choice, check_integer

State: TypeAlias = tuple[th.Tensor, th.Tensor]


class AsLstm(nn.RNNBase):
    """The interface of an LSTM for a network without a cell state: both halves of its state are the hidden state."""

    def forward(self, x: Any, state: State | None = None) -> tuple[Any, State]:
        outputs, hidden = super().forward(x, None if state is None else state[0])
        return outputs, (hidden, hidden)


class GRU(AsLstm, nn.GRU):  # type: ignore[misc]
    """A GRU (Cho et al., 2014)."""


class RNN(AsLstm, nn.RNN):  # type: ignore[misc]
    """An Elman network (1990)."""


MEMORIES: dict[str, Any] = {"lstm": nn.LSTM, "gru": GRU, "rnn": RNN}


def check_memory(memory: Any, lstm_kwargs: Any, **kwargs: Any) -> None:
    """Check the arguments of a recurrent policy that sb3-contrib does not know or check."""
    check_choice("memory", memory, tuple(MEMORIES))
    for name in ("lstm_hidden_size", "n_lstm_layers"):
        check_integer(name, kwargs.get(name, 1), 1)
    allowed = {"bias", "dropout"} | ({"nonlinearity"} if memory == "rnn" else set())
    if lstm_kwargs is not None and not (isinstance(lstm_kwargs, dict) and lstm_kwargs.keys() <= allowed):
        raise ValueError(f"lstm_kwargs must be a dict with some of {', '.join(sorted(allowed))}, got {lstm_kwargs!r}")


def initialize(part: nn.Module, n_hidden: int) -> None:
    """Orthogonal weights for each gate, as Stable-Baselines3's other layers have, and zero biases."""
    for name, parameter in part.named_parameters():
        if "weight" in name:
            for gate in th.split(parameter.data, n_hidden):
                nn.init.orthogonal_(gate)
        else:
            nn.init.zeros_(parameter)
