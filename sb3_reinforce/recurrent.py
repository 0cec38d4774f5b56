"""REINFORCE with a memory, for tasks in which one observation does not say enough."""

from collections.abc import Collection
from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_reinforce.common.tensors import concatenate, flatten, select, shaped_like, take
from sb3_reinforce.estimation.returns import Bools
from sb3_reinforce.policies.critic import next_values_of
from sb3_reinforce.policies.recurrent import CnnLstmPolicy, MaskedLstmPolicy, MlpLstmPolicy, MultiInputLstmPolicy
from sb3_reinforce.policies.sequences import RecurrentPolicy, rows_of
from sb3_reinforce.reinforce import REINFORCE
from sb3_reinforce.sampling.collection import Columns
from sb3_reinforce.sampling.recurrent_actors import RecurrentActor, make_recurrent_actor

__all__ = ["CnnLstmPolicy", "MaskedLstmPolicy", "MlpLstmPolicy", "MultiInputLstmPolicy", "RecurrentREINFORCE"]

# What sb3-contrib's policies compute for one step, and what computes it for whole sequences
SEQUENCE_METHODS = {
    "forward": "sequence_distribution",
    "evaluate_actions": "sequence_distribution",
    "get_distribution": "sequence_distribution",
    "predict_values": "sequence_values",
    "extract_features": "row_features",
    "_process_sequence": "remember",
}


class RecurrentREINFORCE(REINFORCE):
    """
    REINFORCE with the recurrent policies of sb3-contrib (Wierstra et al., 2010, "Recurrent Policy Gradients").

    By default a rollout is a number of whole episodes, and its gradient is exact: it is propagated back through each
    complete episode, and no state is older than the parameters. In fixed rollouts (``n_steps``) the state is carried
    on, and the gradient is cut where the rollout starts, as in sb3-contrib's RecurrentPPO. V at a time limit or at a
    cut comes from one more step of its sequence. The critic's minibatches are whole sequences of about ``batch_size``
    steps.

    ``policy_kwargs`` are the arguments of :class:`~sb3_reinforce.recurrent.MlpLstmPolicy`, such as ``memory="gru"``.

    To predict, pass the returned state and the last ``dones`` to the next call. Without a state each call starts an
    episode:

        >>> obs, state, episode_start = env.reset(), None, None  # doctest: +SKIP
        >>> actions, state = model.predict(obs, state, episode_start)  # doctest: +SKIP
        >>> obs, rewards, episode_start, infos = env.step(actions)  # doctest: +SKIP

    :param policy: MlpLstmPolicy, CnnLstmPolicy, MultiInputLstmPolicy, MaskedLstmPolicy or a subclass of one of them
    :param env: The environment to learn from (if registered in Gymnasium, can be str)
    :param learning_rate: Rate or schedule of the policy, and of the critic without a ``critic_learning_rate``
    :param n_steps: Steps per environment and rollout, instead of ``n_episodes``
    :param n_episodes: Whole episodes per rollout; if ``n_steps`` is None too, 16, or the number of environments if
        larger
    :param batch_size: Steps per minibatch of the critic, at least one whole sequence
    :param kwargs: All other arguments of :class:`~sb3_reinforce.REINFORCE`
    :raises TypeError: If an argument is of the wrong type
    :raises ValueError: If an argument is out of its range, the policy has no memory, or a subclass of a policy
        overrides a method for single steps without the one for sequences, such as ``get_distribution`` without
        ``sequence_distribution``
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpLstmPolicy": MlpLstmPolicy,
        "CnnLstmPolicy": CnnLstmPolicy,
        "MultiInputLstmPolicy": MultiInputLstmPolicy,
        "MaskedLstmPolicy": MaskedLstmPolicy,
    }
    prefers_episodes = True
    policy: RecurrentPolicy

    def __init__(
        self,
        policy: str | type[RecurrentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 2e-3,
        n_steps: int | None = None,
        *,
        n_episodes: int | None = None,
        batch_size: int = 4096,
        **kwargs: Any,
    ):
        # This rollout starts from _state, the next one from _next_state: shape (n_envs, 2 for actor and critic, 2,
        # n_layers, n_hidden), or None where all are zero. _actor is set only while a rollout is collected
        self._actor: RecurrentActor | None = None
        self._next_state: th.Tensor | None = None
        self._are_whole = True
        super().__init__(
            policy, env, learning_rate, n_steps=n_steps, n_episodes=n_episodes, batch_size=batch_size, **kwargs
        )

    def _check_policy(self, policy: str | type) -> None:
        if isinstance(policy, str):
            super()._check_policy(policy)
            return
        if not issubclass(policy, tuple(self.policy_aliases.values())):
            raise ValueError(
                f"policy must be one of {', '.join(self.policy_aliases)} of sb3_reinforce.recurrent or a subclass, got "
                f"{policy.__name__}"
            )
        classes = policy.__mro__[: policy.__mro__.index(RecurrentPolicy)]
        check_sequence_methods(policy, {name for cls in classes for name in vars(cls)})

    def _setup_model(self) -> None:
        fitting = MultiInputLstmPolicy if isinstance(self.observation_space, spaces.Dict) else MlpLstmPolicy
        if self.policy_class in (MlpLstmPolicy, MultiInputLstmPolicy) and self.policy_class is not fitting:
            for_masks = " (MaskedLstmPolicy for action masks)" if fitting is MultiInputLstmPolicy else ""
            raise ValueError(
                f"policy must be {fitting.__name__}{for_masks} for observations in {self.observation_space}, got "
                f"{self.policy_class.__name__}"
            )
        super()._setup_model()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_actor", "_state"]

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int | None
    ) -> bool:
        """
        Collect a rollout as :class:`~sb3_reinforce.REINFORCE` does, and keep the states that the next one goes on from.

        :param env: The model's environments
        :param callback: Called at each step, and at the beginning and end of the rollout
        :param rollout_buffer: Filled as by A2C
        :param n_rollout_steps: Steps per environment, None for whole episodes
        :return: False if the callback stopped the collection
        :raises ValueError: As for :class:`~sb3_reinforce.REINFORCE`
        """
        self._actor = None
        try:
            return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
        finally:
            # Also where a callback fails at the end of the rollout, after which the episodes go on
            if self._last_obs is None or self._are_whole:
                self._next_state = None
            elif self._actor is not None:
                # If Ctrl-C comes before the new states are known, the environments are reset
                self._next_state = None
                self._next_state = self._state_after_rollout().cpu()
            # It cannot be pickled
            self._actor = None

    def _start_episodes(self, env: VecEnv, are_whole: bool) -> None:
        """Reset also where no states were kept: the user or a callback may set n_steps after whole episodes."""
        if self._next_state is None and not np.all(self._last_episode_starts):
            self._last_obs = None
        super()._start_episodes(env, are_whole)
        self._are_whole = are_whole

    def _make_actor(self, calls_forward: bool, with_log_prob: bool) -> RecurrentActor:
        policy = self.policy
        check_sequence_methods(type(policy), vars(policy).keys())
        if self._actor is not None:
            # A callback has changed the policy during the rollout
            state = self._actor.state()
        else:
            starts = th.as_tensor(self._last_episode_starts, device=self.device)
            self._state = None
            if self._next_state is not None and not starts.all():
                self._state = self._next_state[: self.n_envs].to(self.device) * ~starts[..., None, None, None, None]
            state = (policy.zero_state(self.n_envs) if self._state is None else self._state)[:, 0]
        self._actor = make_recurrent_actor(policy, state, lambda: cast(Bools, self._last_episode_starts), with_log_prob)
        return self._actor

    def _state_after_rollout(self) -> th.Tensor:
        """The states at the cut; the critic's come from the rollout, which in process 0 has the columns of all."""
        policy = self.policy
        rollout = self.rollout
        state = policy.zero_state(self.n_envs if rollout is None else rollout.dones.shape[1])
        state[: self.n_envs, 0] = cast(RecurrentActor, self._actor).state()
        if rollout is not None and rollout.values is not None and policy.lstm_critic is not None:
            state[:, 1] = policy.state_after(select(rollout.inputs, rollout.episodes == rollout.episodes[-1]))
        return state

    @th.no_grad()
    def _evaluate_critic(self, buffer: RolloutBuffer, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
        """V(s_t) and V(s_{t+1}); what follows a cut or a time limit is one more row of its sequence."""
        policy = self.policy
        dones = columns.dones
        terminal_obs = columns.terminal_obs
        state = columns.state
        if state is not None and self._next_state is not None:
            goes_on = th.as_tensor(buffer.episode_starts[0] == 0).to(self.device)
            state[:, 1] = self._next_state[: len(state), 1].to(self.device) * goes_on[..., None, None, None]
        rows = rows_of(obs_as_tensor(buffer.observations, self.device), th.as_tensor(dones).to(self.device), state)
        n_steps, n_envs = dones.shape
        steps, envs = np.array([*((n_steps - 1, env) for env in range(n_envs)), *terminal_obs]).T
        following = take(rows, (steps, envs))
        observed = [columns.last_obs, *terminal_obs.values()]
        following["observations"] = concatenate(*(shaped_like(following["observations"], obs) for obs in observed))
        # An episode that has ended with the rollout does not go on in the next observation, whose V is not asked for
        following["sequence"][:n_envs][th.as_tensor(dones[-1])] = -1
        values = policy.sequence_values(concatenate(flatten(rows), following)).flatten().cpu().numpy()
        values, last_values, terminal_values = np.split(values, [n_steps * n_envs, (n_steps + 1) * n_envs])
        values = values.reshape(dones.shape)
        return values, next_values_of(values, dones, last_values, terminal_obs, terminal_values)


def check_sequence_methods(policy: type, own: Collection[str]) -> None:
    """Refuse overridden methods that training, which asks for whole sequences, would not call."""
    for step, sequence in SEQUENCE_METHODS.items():
        if step in own and sequence not in own:
            raise ValueError(
                f"policy={policy.__name__} overrides {step}, which is called for single steps: override {sequence} "
                "too, which is called for whole sequences in training"
            )
