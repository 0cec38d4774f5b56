"""
Recurrent policies on whole sequences: one sequence is one episode, or its part within a fixed rollout.

Such a policy is evaluated on rows: the observation, the number of the sequence that the row belongs to, and the state
from which that sequence starts. Rows of one sequence stand in the order of time, so whole sequences selected from a
batch of rows are a batch of rows again. Sequences are padded and not packed, which is faster on a CPU; the padding
follows the end of a sequence, where nothing depends on it.
"""

from collections.abc import Iterator
from typing import Any, TypeAlias, cast

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn
from torch.nn.utils.rnn import pack_padded_sequence
from torch.utils.checkpoint import checkpoint

from sb3_reinforce.policies.memories import MEMORIES, State, check_memory, initialize

# "observations"; "sequence" of shape (n,); and "state" of shape (n, 2, 2, n_layers, n_hidden), for actor and critic,
# hidden and cell state, unless all sequences start from zero; "features" where they are known already
Rows: TypeAlias = dict[str, Any]
# Floats that the gates of padded sequences may take, 64 MiB
FLOATS = 2**24
# Floats that an LSTM keeps for each hidden unit and step
GATES = 8
LSTM_ARGUMENTS = ("lstm_hidden_size", "n_lstm_layers", "shared_lstm", "enable_critic_lstm")


class RecurrentPolicy(ActorCriticPolicy):
    """
    What sb3-contrib's recurrent policies lack: a choice of memories, and log π and V of whole sequences.

    It is mixed into one of their classes.
    """

    lstm_actor: Any
    lstm_critic: Any
    critic: Any
    lstm_hidden_state_shape: tuple[int, int, int]

    def __init__(self, *args: Any, memory: str = "lstm", lstm_kwargs: dict[str, Any] | None = None, **kwargs: Any):
        check_memory(memory, lstm_kwargs, **kwargs)
        super().__init__(*args, **kwargs)
        self.memory_arguments = {name: kwargs[name] for name in LSTM_ARGUMENTS if name in kwargs}
        self.memory_arguments |= {"memory": memory, "lstm_kwargs": lstm_kwargs}
        # Replace sb3-contrib's memories, which are LSTMs made without lstm_kwargs
        n_layers, _, n_hidden = self.lstm_hidden_state_shape
        for name in ("lstm_actor", "lstm_critic"):
            if getattr(self, name) is not None:
                make = MEMORIES[memory]
                setattr(self, name, make(self.features_dim, n_hidden, num_layers=n_layers, **(lstm_kwargs or {})))
        if self.ortho_init:
            for part in (self.lstm_actor, self.lstm_critic, self.critic):
                if part is not None:
                    initialize(part, n_hidden)
        rate = self.optimizer.param_groups[0]["lr"]
        self.optimizer = self.optimizer_class(self.parameters(), lr=rate, **self.optimizer_kwargs)  # type: ignore[call-arg]

    def _get_constructor_parameters(self) -> dict[str, Any]:
        # sb3-contrib leaves them out, and a policy that is loaded would have other shapes
        return super()._get_constructor_parameters() | self.memory_arguments

    def _build(self, lr_schedule: Schedule) -> None:
        # For MultiDiscrete observations it is a NumPy integer, which PyTorch's recurrent layers do not take
        self.features_dim = int(self.features_dim)
        super()._build(lr_schedule)

    def set_training_mode(self, mode: bool) -> None:
        """Set the mode; memories without dropout stay in training mode, since cuDNN has no other backward pass."""
        super().set_training_mode(mode)
        for memory in (self.lstm_actor, self.lstm_critic):
            if memory is not None:
                memory.train(mode or not memory.dropout)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the actions and the next state; the arguments are checked first."""
        if isinstance(observation, tuple):
            raise ValueError("observation must not be a tuple: reset returns (observation, info), pass the first only")
        obs, _ = self.obs_to_tensor(observation)
        n_layers, _, n_hidden = self.lstm_hidden_state_shape
        n_envs = len(next(iter(obs.values())) if isinstance(obs, dict) else obs)
        if state is not None:
            shapes = [np.shape(part) for part in state]
            if shapes != [(n_layers, n_envs, n_hidden)] * 2:
                raise ValueError(
                    f"state must be the one that predict returned for these {n_envs} environments, two arrays of shape "
                    f"{(n_layers, n_envs, n_hidden)}, or None where episodes start; got {shapes}"
                )
        n_flags = n_envs if episode_start is None else np.asarray(episode_start).size
        if n_flags != n_envs:
            raise ValueError(f"episode_start must have {n_envs} entries, one for each observation, got {n_flags}")
        return super().predict(observation, state, episode_start, deterministic)

    def zero_state(self, n_envs: int) -> th.Tensor:
        """The state at the start of an episode, shape ``(n_envs, 2, 2, n_layers, n_hidden)``."""
        n_layers, _, n_hidden = self.lstm_hidden_state_shape
        parameter: th.Tensor = next(self.lstm_actor.parameters())
        return parameter.new_zeros(n_envs, 2, 2, n_layers, n_hidden)

    def sequence_distribution(self, rows: Rows) -> Distribution:
        """π(·|o_0, ..., o_t) for each of n rows."""
        latent = self.mlp_extractor.forward_actor(self.actor_memory(rows))
        return self._get_action_dist_from_latent(latent)

    def sequence_values(self, rows: Rows) -> th.Tensor:
        """V(o_0, ..., o_t) for each of n rows, shape ``(n, 1)``."""
        if self.lstm_critic is not None:
            latent = self.remember(self.lstm_critic, self.row_features(rows, self.vf_features_extractor), rows)
        elif self.critic is not None:
            latent = self.critic(self.row_features(rows, self.vf_features_extractor))
        else:
            with th.no_grad():
                latent = self.actor_memory(rows)
        return cast(th.Tensor, self.value_net(self.mlp_extractor.forward_critic(latent)))

    def actor_memory(self, rows: Rows) -> th.Tensor:
        """The actor's memory after each of n rows, shape ``(n, n_hidden)``."""
        return self.remember(self.lstm_actor, self.row_features(rows, self.pi_features_extractor), rows)

    def row_features(self, rows: Rows, extractor: nn.Module) -> th.Tensor:
        """The features of n rows, without padding; the rows may hold them already."""
        if "features" in rows:
            return cast(th.Tensor, rows["features"])
        return BasePolicy.extract_features(self, rows["observations"], extractor)  # type: ignore[arg-type]

    def remember(self, recurrence: nn.RNNBase, features: th.Tensor, rows: Rows) -> th.Tensor:
        """The outputs of a recurrent network for n rows of sequences, shape ``(n, n_hidden)``."""
        index, is_row = padded_index(rows["sequence"])
        longest_first = is_row.sum(0).argsort(descending=True)
        index = index[:, longest_first]
        is_row = is_row[:, longest_first]
        state = initial_state(rows, index[0], recurrence is self.lstm_critic)
        network: Any = recurrence
        if not recurrence.training and th.is_grad_enabled():
            # cuDNN differentiates no pass in evaluation mode
            network = th.backends.cudnn.flags(enabled=False)(lambda *inputs: recurrence(*inputs))
        n_at_once = max(1, FLOATS // (GATES * index.shape[1] * recurrence.hidden_size))
        outputs = []
        for part, is_part in zip(th.split(index, n_at_once), th.split(is_row, n_at_once), strict=True):
            n_running = int(is_part[0].sum())
            part = part[:, :n_running]
            is_part = is_part[:, :n_running]
            if state is not None:
                state = (state[0][:, :n_running].contiguous(), state[1][:, :n_running].contiguous())
            if len(index) <= n_at_once:
                output, state = network(features[part], state)
            else:
                # The gates of long episodes are computed again for the backward pass: exact, in less memory
                output, state = checkpoint(network, features[part], state, use_reentrant=False)
            outputs.append(output[is_part])
        remembered = th.cat(outputs)
        return th.empty_like(remembered).index_copy(0, index[is_row], remembered)

    @th.no_grad()
    def state_after(self, rows: Rows) -> th.Tensor:
        """The critic's state after the last row of each sequence, shape ``(n_sequences, 2, n_layers, n_hidden)``."""
        # Behind the features a mask may stand
        features = self.row_features(rows, self.vf_features_extractor)[:, : self.lstm_critic.input_size]
        index, is_row = padded_index(rows["sequence"])
        packed = pack_padded_sequence(features[index], is_row.sum(0).cpu(), enforce_sorted=False)
        _, state = self.lstm_critic(packed, initial_state(rows, index[0], critic=True))
        return th.stack(state).permute(2, 0, 1, 3)


def padded_index(sequence: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """The row at each place of padded sequences, shape ``(length, n_sequences)``, and which places are not padding."""
    order = sequence.argsort(stable=True)
    lengths = th.unique_consecutive(sequence[order], return_counts=True)[1]
    steps = th.arange(int(lengths.max()), device=sequence.device)[:, None]
    is_row = steps < lengths
    # Where each sequence begins in ``order``
    firsts = lengths.cumsum(0) - lengths
    # Padding takes any row
    index = order[(firsts + steps).clamp(max=len(order) - 1)]
    return index, is_row


def initial_state(rows: Rows, first: th.Tensor, critic: bool) -> State | None:
    """The hidden and the cell state at the first rows, each ``(n_layers, n_sequences, n_hidden)``; None for zeros."""
    if "state" not in rows:
        return None
    hidden, cell = rows["state"][first][:, int(critic)].permute(1, 2, 0, 3).contiguous()
    return hidden, cell


def episode_numbers(dones: th.Tensor) -> th.Tensor:
    """The number of the episode that each step belongs to, from 0 on, shape ``(n_steps, n_envs)``, int64."""
    ended_before = dones.long().cumsum(0) - dones.long()
    n_episodes = ended_before[-1] + 1
    return ended_before + n_episodes.cumsum(0) - n_episodes


def rows_of(obs: Any, dones: th.Tensor, state: th.Tensor | None) -> Rows:
    """
    The rows of a rollout, each tensor starting with ``(n_steps, n_envs)``.

    ``state`` is the one from which the first steps went on, shape ``(n_envs, 2, 2, n_layers, n_hidden)``.
    """
    sequence = episode_numbers(dones)
    rows: Rows = {"observations": obs, "sequence": sequence}
    if state is not None:
        goes_on = sequence == sequence[0]
        rows["state"] = state * goes_on[..., None, None, None, None]
    return rows


def without_memory(rows: Rows) -> Rows:
    """The rows, each as a sequence of one step."""
    return {**rows, "sequence": th.arange(len(rows["sequence"]), device=rows["sequence"].device)}


def sequence_minibatches(sequence: th.Tensor, size: int) -> Iterator[th.Tensor]:
    """Rows of whole sequences, drawn without replacement, about ``size`` at a time and at least one sequence."""
    _, number, lengths = th.unique(sequence, return_inverse=True, return_counts=True)
    order = th.randperm(len(lengths)).to(sequence.device)
    batch = th.empty_like(order)
    # In random order, a sequence belongs to the batch of its last row
    batch[order] = (lengths[order].cumsum(0) - 1) // size
    for each in th.unique(batch):
        yield (batch[number] == each).nonzero().flatten()
