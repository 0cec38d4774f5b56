"""How a recurrent policy acts while a rollout is collected: an LSTM of one layer by NumPy, else by its own methods."""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from torch import nn

from sb3_reinforce.estimation.returns import Bools
from sb3_reinforce.policies.plain_mlp import is_unchanged, linear_operation, numpy_layers
from sb3_reinforce.policies.sequences import RecurrentPolicy
from sb3_reinforce.sampling.actors import Acted, NumpyActor, PolicyActor

# Which of the environments start an episode with the observation at hand
Starts: TypeAlias = Callable[[], Bools]


class RecurrentPolicyActor(PolicyActor):
    """Acts by the policy's own methods, from a state of shape ``(n_envs, 2, n_layers, n_hidden)``."""

    def __init__(self, policy: RecurrentPolicy, state: th.Tensor, starts: Starts, with_log_prob: bool):
        super().__init__(policy, False, with_log_prob)
        self.starts = starts
        self.halves = tuple(state.permute(1, 2, 0, 3).contiguous())

    def distribution(self, obs: Any) -> Distribution:
        """π(·|s) for observations of ``n_envs`` environments, after one more step of the state."""
        policy: Any = self.policy
        episode_starts = th.as_tensor(self.starts(), dtype=th.float32, device=policy.device)
        distribution: Distribution
        distribution, self.halves = policy.get_distribution(obs, self.halves, episode_starts)
        return distribution

    def state(self) -> th.Tensor:
        """The actor's state after its last step, shape ``(n_envs, 2, n_layers, n_hidden)``."""
        return th.stack(self.halves).permute(2, 0, 1, 3)

    def is_current(self, policy: Any) -> bool:
        """Whether the policy would still act as this actor does."""
        return policy is self.policy


class LstmActor(NumpyActor):
    """Acts by NumPy, for an LSTM of one layer between flat observations and a plain MLP."""

    def __init__(
        self, policy: RecurrentPolicy, layers: list[nn.Module], state: th.Tensor, starts: Starts, with_log_prob: bool
    ):
        super().__init__(policy, layers, len(state), with_log_prob, policy.lstm_actor)
        self.starts = starts
        self.lstm = policy.lstm_actor
        self.cell = LstmCell(self.lstm, state)
        self.lstm_addresses = [parameter.data_ptr() for parameter in self.lstm.parameters()]

    def act(self, obs: Any) -> Acted:
        return super().act(self.cell.step(obs, self.starts()))

    def state(self) -> th.Tensor:
        """The actor's state after its last step, shape ``(n_envs, 2, 1, n_hidden)``."""
        return th.as_tensor(np.stack([self.cell.hidden, self.cell.cell], axis=1)[:, :, None])

    def is_current(self, policy: Any) -> bool:
        addresses = [parameter.data_ptr() for parameter in policy.lstm_actor.parameters()]
        return super().is_current(policy) and policy.lstm_actor is self.lstm and addresses == self.lstm_addresses


class LstmCell:
    """An LSTM of one layer for ``n_envs`` environments; its weights are views of the parameters."""

    def __init__(self, lstm: Any, state: th.Tensor):
        self.hidden, self.cell = (half.numpy().copy() for half in state[:, :, 0].unbind(1))
        self.from_obs = linear_operation(lstm.weight_ih_l0, lstm.bias_ih_l0, len(state))
        self.from_hidden = linear_operation(lstm.weight_hh_l0, lstm.bias_hh_l0, len(state))
        # σ(x) = ½ tanh(½ x) + ½ for three gates, and tanh itself for g
        self.scale = np.repeat(np.array([0.5, 0.5, 1.0, 0.5], dtype=np.float32), lstm.hidden_size)
        self.shift = 1 - self.scale

    @np.errstate(all="ignore")
    def step(self, obs: np.ndarray, starts: Bools) -> Any:
        """
        The hidden state after observations of ``n_envs`` environments, shape ``(n_envs, n_hidden)``.

        ``i, f, g, o = W_ih x + W_hh h + b``, then ``c ← σ(f) c + σ(i) tanh g`` and ``h ← σ(o) tanh c`` (Hochreiter and
        Schmidhuber, 1997, with the forget gate of Gers et al., 2000).
        """
        if starts.any():
            self.hidden[starts] = 0
            self.cell[starts] = 0
        x = obs.reshape(len(obs), -1).astype(np.float32, copy=False)
        gates = self.from_obs(x) + self.from_hidden(self.hidden)
        i, f, g, o = np.split(np.tanh(gates * self.scale) * self.scale + self.shift, 4, axis=1)
        self.cell = f * self.cell + i * g
        self.hidden = o * np.tanh(self.cell)
        return self.hidden


RecurrentActor: TypeAlias = RecurrentPolicyActor | LstmActor


def make_recurrent_actor(
    policy: RecurrentPolicy, state: th.Tensor, starts: Starts, with_log_prob: bool
) -> RecurrentActor:
    """The fastest actor that acts as the policy would."""
    layers = numpy_head(policy)
    if layers is not None:
        return LstmActor(policy, layers, state, starts, with_log_prob)
    return RecurrentPolicyActor(policy, state, starts, with_log_prob)


def numpy_head(policy: Any) -> list[nn.Module] | None:
    """The layers after an LSTM that NumPy can compute, or None."""
    lstm = policy.lstm_actor
    if type(lstm) is not nn.LSTM or not is_unchanged(lstm) or lstm.num_layers > 1 or not lstm.bias:
        return None
    return numpy_layers(policy, RecurrentPolicy)
