"""REINFORCE as an algorithm of Stable-Baselines3."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch as th
from stable_baselines3 import A2C
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import explained_variance, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv
from torch.nn import functional as F

from sb3_reinforce.common import optimization
from sb3_reinforce.common.arguments import check_function
from sb3_reinforce.common.base import BasePolicyGradient
from sb3_reinforce.common.distribution import together
from sb3_reinforce.common.interruptions import uninterrupted
from sb3_reinforce.common.settings import (
    INSTEAD_OF_PPO,
    REINFORCE_ARGUMENTS,
    check_learn,
    check_named,
    check_reinforce,
    check_starts,
)
from sb3_reinforce.envs.guards import guarded
from sb3_reinforce.envs.starts import has_given_seeds, start_episodes, start_groups
from sb3_reinforce.estimation import BASELINES, Baseline, Rollout
from sb3_reinforce.estimation.rollout import Running, in_finished_episode
from sb3_reinforce.estimation.weights import Batch, complete_rollout, training_batch
from sb3_reinforce.policies.critic import fit_critic, rollout_values
from sb3_reinforce.policies.evaluation import (
    Parameters,
    acting_log_prob,
    calls,
    evaluate,
    floor_std,
    sampled_divergence,
    set_temperature,
    some_steps,
    trainable,
)
from sb3_reinforce.policies.groups import ParameterGroups
from sb3_reinforce.policies.masks import MaskedPolicy
from sb3_reinforce.policies.natural import DEFAULT_TARGET_KL, check_distribution, natural_step
from sb3_reinforce.policies.plain_mlp import plain_actor
from sb3_reinforce.sampling.actors import Actor, make_actor
from sb3_reinforce.sampling.collection import (
    Columns,
    Extent,
    check_rollout_data,
    collect,
    keep_fractions,
    warn_of_own_methods,
)
from sb3_reinforce.sampling.columns import gather

SelfREINFORCE = TypeVar("SelfREINFORCE", bound="REINFORCE")


class REINFORCE(BasePolicyGradient, OnPolicyAlgorithm):
    """
    REINFORCE, the likelihood-ratio policy gradient, with a choice of returns, baselines and rollouts.

    One step per rollout, by an optimizer (Adam by default) or along the natural gradient, from the estimate

        ``ĝ = Σ_episodes Σ_t  m_t · γ^t · ∇θ log πθ(a_t|s_t) · (G_t − b_t)  /  denominator``

    (Williams, 1992, section 5 and theorem 2, for the total return; Sutton et al., 2000, for G_t; γ^t only with
    ``discount_scores`` and ``reward_to_go``). m_t is 1 for used steps and 0 for the others. Used steps have a known
    return and, with ``n_episodes``, belong to an episode that counts. The denominator is ``n_steps * n_envs`` for fixed
    rollouts; for whole episodes see ``normalize_by``. E[ĝ] is exactly ∇θ E[G_0] with ``n_episodes``,
    ``normalize_by="episodes"``, ``discount_scores=True``, ``ent_coef=0``, the baseline ``"none"``, ``"leave_one_out"``
    or ``"optimal"``, and without ``normalize_advantage`` and clipping. gSDE is an exception: its steps share noise, and
    Stable-Baselines3 cuts the gradient where the noise depends on the features. So are dropout, batch normalization and
    noisy layers, with which the policy that is trained is not the one that acts, as in A2C, and a ``VecNormalize`` that
    is still learning. Episodes must not influence each other.

    Unfinished episodes: with ``baseline="value"`` the critic's V is added at a time limit and where ``n_steps`` cuts an
    episode. Without a critic a time limit counts as the end of the episode, and an episode that ``n_steps`` cuts is
    left out, since its return is not known. Without a critic the value network is evaluated only in policies with
    hooks, or with their own ``forward``, ``evaluate_actions`` or ``extract_features``.

    The critic has a separate optimizer of the policy's ``optimizer_class``, for the parameters that only V depends on.
    A features extractor that actor and critic share (the default of CnnPolicy) is not trained by the critic's passes,
    which would move the policy a second time. The policy step trains it: ``vf_coef`` times the critic's squared error
    is then part of its loss. The natural step leaves this out, so that the critic does not train the extractor.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, MultiInputPolicy, MaskedPolicy, or a class)
    :param env: The environment to learn from (if registered in Gymnasium, can be str)
    :param learning_rate: The learning rate, it can be a function of the progress that remains (from 1 to 0)
    :param n_steps: Steps per environment and rollout, as in A2C. If ``n_steps`` and ``n_episodes`` are both None: 32
        steps with ``baseline="value"``, else 16 episodes, or one per environment if there are more than 16
        environments. With ``episodes_per_start`` above 1 it is always one episode per environment
    :param gamma: Discount factor
    :param gae_lambda: λ of the λ-return G_t: 1 is the Monte Carlo return, 0 the one-step return r_t + γ V(s_{t+1}).
        Below 1 only with ``baseline="value"`` and ``reward_to_go=True``
    :param ent_coef: Weight of the gradient of the entropy at the visited states, it can be a schedule
    :param vf_coef: Weight of the critic's squared error in the optimizer's step, where a features extractor is shared
    :param max_grad_norm: Bound on the norm of a step's gradient, separately for actor and critic; None or inf for
        no bound
    :param baseline: b_t: ``"none"``, ``"mean"``, ``"time_mean"``, ``"leave_one_out"``, ``"value"``, ``"optimal"``, or a
        function of a ``Rollout`` that returns a tensor of shape ``(n_steps, n_envs)``
    :param n_episodes: Whole episodes per rollout, instead of ``n_steps``. Between rollouts all environments are reset,
        unless all of them have just ended an episode. Each environment contributes a number of episodes that is fixed
        beforehand, and some contribute none if there are more environments than episodes. Steps after these episodes
        are counted, but not used
    :param episodes_per_start: m > 1 lets the episodes of m neighboring environments start from the same seed, and
        ``"time_mean"``, ``"leave_one_out"`` and ``"optimal"`` compare these only (Kool et al., 2019). It pays where
        much of the variance of the return lies between starts: ask ``diagnostics.compare_starts``. A rollout is then
        one episode of each environment
    :param reward_to_go: G_t is the sum of the discounted rewards from t on; if False, the total return G_0, which is
        discounted from the start of the episode and never takes the factor γ^t
    :param discount_scores: Use the factor γ^t of the exact gradient of E[G_0]; off by default, as in A2C and PPO
    :param normalize_by: The denominator for whole episodes: ``"steps"``, the number of used steps (the direction is
        in general biased where lengths differ), or ``"episodes"``, the number of episodes (unbiased)
    :param n_critic_updates: Passes of the critic over each rollout
    :param batch_size: Minibatch size of the critic's passes
    :param critic_learning_rate: The critic's learning rate or schedule; None for ``learning_rate``
    :param temperature: τ in π(a|s) ∝ exp(logits / τ), for discrete actions; below 0.001 it acts as 0.001. It can be a
        schedule: if it falls to 0, training ends with nearly the deterministic policy that ``evaluate_policy`` measures
        by default
    :param min_std: Floor under the standard deviation of a Gaussian policy (with gSDE, of its noise weights), restored
        after each step; 0 for no floor. It can be a schedule: if it falls to 0, the policy explores at first, and its
        noise may shrink later
    :param max_episode_steps: With ``n_episodes``, the length beyond which an episode raises an error
    :param use_sde: Whether to use generalized State Dependent Exploration (gSDE) instead of action noise
    :param sde_sample_freq: Sample a new noise matrix every n steps when using gSDE; -1: only before each rollout
    :param rollout_buffer_class: Rollout buffer class to use. Its arrays are written in place: ``add``, ``get`` and
        ``compute_returns_and_advantage`` are not called
    :param rollout_buffer_kwargs: Keyword arguments to pass to the rollout buffer on creation
    :param normalize_advantage: Scale G_t − b_t to mean 0 and standard deviation 1 per rollout; skipped below two
        samples and where the deviation is 0
    :param step: ``"optimizer"``, a step of the policy's optimizer, or ``"natural"``, along the natural gradient F⁻¹ ĝ
        (Kakade, 2001) as far as ``target_kl`` allows: without a learning rate and without clipping. Use rollouts of at
        least 1,000 steps in all environments together. Policies whose log π differs in training mode, as with dropout,
        are refused
    :param target_kl: With ``step="natural"``, the target for the rollout's mean KL(π_before ‖ π_after), or a schedule.
        Steps are shortened until it is at most 1.2 times the target, before ``min_std`` and ``temperature`` are
        applied. None for 0.01
    :param stats_window_size: Window size for the rollout logging, in episodes
    :param tensorboard_log: The log location for tensorboard (if None, no logging)
    :param policy_kwargs: Additional arguments to be passed to the policy on creation; the dictionary is not modified
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    :raises TypeError: If an argument is of the wrong kind
    :raises ValueError: If an argument is out of its range, or does not go with another; the message names it
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        **A2C.policy_aliases,
        "MaskedPolicy": MaskedPolicy,
    }
    #: Whether a rollout is by default whole episodes, also with a critic
    prefers_episodes: ClassVar[bool] = False
    _arguments = REINFORCE_ARGUMENTS | {"baseline": partial(check_named, functions=BASELINES)}
    _identifying_argument = "reward_to_go"
    _instead = INSTEAD_OF_PPO

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 2e-3,
        n_steps: int | None = None,
        gamma: float = 0.99,
        gae_lambda: float = 1.0,
        ent_coef: float | Schedule = 0.0,
        vf_coef: float = 0.5,
        max_grad_norm: float | None = 0.5,
        baseline: str | Baseline = "value",
        n_episodes: int | None = None,
        episodes_per_start: int = 1,
        reward_to_go: bool = True,
        discount_scores: bool = False,
        normalize_by: str = "steps",
        n_critic_updates: int = 4,
        batch_size: int = 256,
        critic_learning_rate: float | Schedule | None = None,
        temperature: float | Schedule = 1.0,
        min_std: float | Schedule = 0.0,
        max_episode_steps: int = 100_000,
        use_sde: bool = False,
        sde_sample_freq: int = -1,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        normalize_advantage: bool = False,
        step: str = "optimizer",
        target_kl: float | Schedule | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            needs_env=_init_setup_model,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=use_sde,
            sde_sample_freq=sde_sample_freq,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.baseline = baseline
        self.n_episodes = n_episodes
        self.episodes_per_start = episodes_per_start
        self.reward_to_go = reward_to_go
        self.discount_scores = discount_scores
        self.normalize_by = normalize_by
        self.n_critic_updates = n_critic_updates
        self.batch_size = batch_size
        self.critic_learning_rate = critic_learning_rate
        self.temperature = temperature
        self.min_std = min_std
        self.max_episode_steps = max_episode_steps
        self.normalize_advantage = normalize_advantage
        self.step = step
        self.target_kl = target_kl
        #: The last rollout; None before the first one, while one is collected, and after an interrupted one
        self.rollout: Rollout | None = None
        self._state: th.Tensor | None = None
        self._running = Running.none(1)
        if _init_setup_model:
            self._setup_model()
            check_starts(self)

    @property
    def has_critic(self) -> bool:
        """Whether a critic is trained and used."""
        return check_function("baseline", self.baseline, BASELINES) is BASELINES["value"]

    def _critic_rate(self) -> float:
        if self.critic_learning_rate is None:
            return self.lr_schedule(self._current_progress_remaining)
        return self._scheduled("critic_learning_rate")

    def _setup_model(self) -> None:
        check_reinforce(self)
        # Stable-Baselines3 sizes the buffer here; for whole episodes each rollout resizes it
        n_steps = self.n_steps
        self.n_steps = n_steps or 1
        super()._setup_model()
        self.n_steps = n_steps
        warn_of_own_methods(self.rollout_buffer)
        optimization.fuse(self.policy.optimizer)
        self._make_critic_optimizer()
        self._groups = ParameterGroups()
        self._apply_temperature_and_floor()

    def _make_critic_optimizer(self) -> None:
        """An optimizer over all parameters, of which only the critic's get gradients."""
        self.critic_optimizer = self.policy.optimizer_class(
            self.policy.parameters(),
            lr=self._critic_rate(),  # type: ignore[call-arg]
            **self.policy.optimizer_kwargs,
        )
        optimization.fuse(self.critic_optimizer)

    def _sort_parameters(self, rollout: Rollout, batch: Batch) -> tuple[Parameters, Parameters, Parameters]:
        """Parameters of the actor, of the critic alone and of both; without a critic the last two are empty."""
        if rollout.values is None:
            return trainable(self.policy), [], []
        held = {parameter for group in self.critic_optimizer.param_groups for parameter in group["params"]}
        if not held.issuperset(self.policy.parameters()):
            self._make_critic_optimizer()
        return self._groups.sort(self.policy, batch.observations, batch.actions)

    def _apply_temperature_and_floor(self) -> None:
        set_temperature(self.policy, self._scheduled("temperature"))
        floor_std(self.policy, self._scheduled("min_std"))

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int | None
    ) -> bool:
        """
        Collect a rollout with the current policy and compute the weights of its steps.

        :param env: The model's environments
        :param callback: Called at each step, and at the beginning and end of the rollout
        :param rollout_buffer: Filled as by A2C, but ``values`` can be 0 without a critic and ``log_probs`` without a
            callback. ``advantages`` is G_t − b_t, and ``returns`` what the critic is fitted to, or without a critic
            G_t; both are 0 at steps that are not used. ``rewards`` do not include γ V at time limits
        :param n_rollout_steps: Steps per environment, None for whole episodes
        :return: False if the callback stopped the collection; the rollout is then dropped
        :raises TypeError: If an argument of the model has been changed to a wrong type, or a baseline returns no tensor
        :raises ValueError: If an argument has been changed to a wrong value, a baseline returns a tensor of another
            shape, a reward, an observation, an action or a baseline is not finite, no episode ended in a rollout that
            needs one, an episode does not end, or the environments of ``episodes_per_start`` ignore their seed. The
            parameters have not changed. Environments that stopped in the middle of episodes are reset before the next
            rollout
        """
        self.policy.set_training_mode(False)
        self._apply_temperature_and_floor()
        n_steps = self.n_steps
        callback.on_rollout_start()
        # The user or a callback may have changed the environments, the policy and arguments
        env = cast(VecEnv, self.env)
        check_reinforce(self)
        check_starts(self)
        self.policy.set_training_mode(False)
        self._apply_temperature_and_floor()
        if self.use_sde:
            self.policy.reset_noise(env.num_envs)
        if self.n_steps != n_steps:
            n_rollout_steps = self.n_steps
        self.start_round()
        self.rollout = None
        # The last rollout may have the columns of several processes
        rollout_buffer.n_envs = env.num_envs
        rollout_buffer.reset()
        self._start_episodes(env, n_rollout_steps is None)
        keep_fractions(rollout_buffer, self._last_obs, self.action_space)
        if n_rollout_steps is None:
            n_episodes = self.share_of(cast(int, self.n_episodes))
            extent = Extent.whole_episodes(n_episodes, env.num_envs, self.max_episode_steps)
        else:
            extent = Extent.fixed(n_rollout_steps, env.num_envs)
        baseline = check_function("baseline", self.baseline, BASELINES)
        is_collected = False
        self.is_collecting = True
        try:
            collected = collect(self, env, callback, rollout_buffer, extent, self.has_critic, self._make_actor)
            if collected is None:
                return False
            check_rollout_data(rollout_buffer, self._last_obs, collected.terminal_obs)
            columns = gather(self, rollout_buffer, replace(collected, state=self._state))
            if columns is not None:
                self.rollout = self._complete(rollout_buffer, columns, baseline, n_rollout_steps is not None)
            is_collected = True
        except Exception:
            # The cause may be a number that is not finite: then that is reported instead
            check_rollout_data(rollout_buffer, self._last_obs, {})
            raise
        finally:
            self.is_collecting = False
            if not is_collected or self.env is not env or has_given_seeds(env):
                # The environments stopped in the middle of episodes, are others than in this rollout, or may draw the
                # same random numbers: they are reset before they are used
                self._last_obs = None
        # A process that has sent its part to process 0 has no rollout
        if columns is None or self.rollout is None:
            return True
        self.logger.record("rollout/complete_fraction", float(in_finished_episode(columns.dones).mean()))
        if n_rollout_steps is None:
            self.logger.record("rollout/used_fraction", float(self.rollout.used.double().mean()))
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _start_episodes(self, env: VecEnv, are_whole: bool) -> None:
        """Reset the environments where the next rollout does not continue their episodes."""
        shares_starts = self.episodes_per_start > 1
        # A measurement that failed in a callback leaves no observation
        is_needed = self._last_obs is None or (are_whole and not np.all(self._last_episode_starts))
        if not (is_needed or shares_starts):
            return
        # Set last: if an error or Ctrl-C comes before, the environments are reset again
        self._last_obs = None
        obs = start_groups(env, self.episodes_per_start) if shares_starts else start_episodes(env, None)
        self._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        self._last_obs = obs

    def _complete(self, buffer: RolloutBuffer, columns: Columns, baseline: Baseline, is_fixed: bool) -> Rollout:
        """The rollout with the weights of its steps, which the buffer gets too."""
        self._running = self._running.restarted(where=buffer.episode_starts[0].astype(bool))
        next_values = None
        if baseline is BASELINES["value"]:
            buffer.values, next_values = self._evaluate_critic(buffer, columns)
        rollout, buffer.advantages, buffer.returns = complete_rollout(
            buffer,
            self.policy,
            columns.dones,
            None if is_fixed else columns.quota,
            self._running,
            next_values,
            columns.state,
            baseline=baseline,
            gamma=self.gamma,
            gae_lambda=self.gae_lambda,
            reward_to_go=self.reward_to_go,
            discount_scores=self.discount_scores,
            normalize_by=self.normalize_by,
            episodes_per_start=self.episodes_per_start,
        )
        self._running = self._running.after(buffer.rewards, columns.dones, self.gamma)
        return rollout

    def collect_part(self, callback: BaseCallback) -> None:
        self.collect_rollouts(cast(VecEnv, self.env), callback, self.rollout_buffer, self.n_steps)

    def adopt(self, state: dict[str, Any]) -> None:
        super().adopt(state)
        self._apply_temperature_and_floor()

    def _make_actor(self, calls_forward: bool, with_log_prob: bool) -> Actor:
        return make_actor(self.policy, calls_forward, self.n_envs, with_log_prob)

    def _evaluate_critic(self, buffer: RolloutBuffer, columns: Columns) -> tuple[np.ndarray, np.ndarray]:
        """V(s_t) and V(s_{t+1}), both of shape ``(n_steps, n_envs)``."""
        return rollout_values(
            self.policy, columns.has_values, buffer, columns.dones, columns.last_obs, columns.terminal_obs
        )

    @uninterrupted
    def train(self) -> None:
        """
        One policy step along ĝ, then the critic's passes.

        :raises ValueError: If a gradient or a parameter becomes non-finite, if there is no rollout, or if, with the
            natural step, ``get_distribution`` does not give the log π that is trained or its KL divergence is unknown.
            A step with a non-finite gradient is not taken. After a non-finite parameter the parameters are those before
            the policy's step or before the critic's passes, and the state of the optimizer that made the step is
            cleared. If the critic fails, the policy keeps its step
        """
        rollout = self.rollout
        if rollout is None:
            raise ValueError("train needs a rollout: call learn, which collects one")
        ent_coef = self._scheduled("ent_coef")
        self._update_learning_rate(self.policy.optimizer)
        critic_rate = self._critic_rate()
        batch = training_batch(rollout, self.rollout_buffer, self.normalize_advantage)
        actor, critic, shared = self._sort_parameters(rollout, batch)
        self.policy.set_training_mode(True)

        # The natural step bounds the policy's change, and the critic's error has no part in that
        trains_values = bool(shared) and self.step == "optimizer"
        # log π is learned by the method that acted, which may compute V too
        with_values = trains_values or (batch.values is not None and calls(self.policy, "evaluate_actions", True))
        log_prob, entropy, values = evaluate(self.policy, batch.observations, batch.actions, with_values)
        # L = −Σ_t [w_t log π(a_t|s_t) + ent_coef · H(π(·|s_t))] / D: the first term has the gradient −ĝ
        # (Williams, 1992, section 5)
        policy_loss = -(batch.weights * log_prob).sum() / rollout.denominator
        loss = policy_loss - ent_coef * entropy.sum() / rollout.denominator
        if trains_values and values is not None:
            # + vf_coef · mean_t (G_t − V(s_t))², for the features extractor that actor and critic share
            loss = loss + self.vf_coef * F.mse_loss(values, batch.returns.to(values))
        grad_norm = 0.0
        kl = 0.0
        # An actor may be frozen while its critic warms up
        if actor and loss.requires_grad:
            gradients = th.autograd.grad(loss, actor, allow_unused=True)
            # Divergences are those of the policy that acts: dropout and batch normalization in evaluation mode
            self.policy.set_training_mode(False)
            grad_norm, kl = self._step_policy(batch, actor, gradients, log_prob.detach())
            self.policy.set_training_mode(True)
        # load applies the temperature of this progress, and a model that is saved now must act as the loaded one
        self._apply_temperature_and_floor()
        self._n_updates += 1

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/entropy_loss", -entropy.mean().item())
        self.logger.record("train/policy_loss", policy_loss.item())
        self.logger.record("train/grad_norm", grad_norm)
        self.logger.record("train/kl", kl)
        if hasattr(self.policy, "log_std"):
            self.logger.record("train/std", th.exp(self.policy.log_std).mean().item())
        if batch.values is not None:
            last_gradients = [parameter.grad for parameter in actor]
            self._train_critic(batch, batch.values, critic, bool(shared), critic_rate)
            # The critic's passes clear them, and a callback may log them
            for parameter, gradient in zip(actor, last_gradients, strict=True):
                parameter.grad = gradient

    def _step_policy(
        self, batch: Batch, actor: Parameters, gradients: Sequence[th.Tensor | None], log_prob: th.Tensor
    ) -> tuple[float, float]:
        """Step against the gradients; return their norm and the divergence. ``log_prob`` is log π before the step."""
        obs, actions = batch.observations, batch.actions
        if self.step == "natural":
            target_kl = DEFAULT_TARGET_KL if self.target_kl is None else self._scheduled("target_kl")
            check_distribution(self.policy, obs, actions, log_prob)
            # As after an optimizer's step, for a callback
            for parameter, gradient in zip(actor, gradients, strict=True):
                parameter.grad = gradient
            return natural_step(self.policy, obs, actor, gradients, target_kl)
        if plain_actor(self.policy) is None:
            # Passes over images take long, and log π in training mode may differ, as with dropout
            obs, actions = some_steps(self.policy, obs, actions)
            log_prob = acting_log_prob(self.policy, obs, actions)
        with optimization.kept_finite(self.policy.optimizer, actor, "policy"):
            grad_norm = optimization.step(self.policy.optimizer, actor, gradients, self.max_grad_norm, "policy")
        return grad_norm, sampled_divergence(self.policy, obs, actions, log_prob)

    def _train_critic(self, batch: Batch, values: th.Tensor, critic: Parameters, is_shared: bool, rate: float) -> None:
        """The critic's passes over the rollout; ``values`` are V(s_t) before them."""
        if is_shared:
            # Passes in training mode would move shared batch statistics, a second step of the policy
            self.policy.set_training_mode(False)
        if self.policy.share_features_extractor:
            self.policy.features_extractor.eval()
        update_learning_rate(self.critic_optimizer, rate)
        value_loss = float(F.mse_loss(values, batch.returns.cpu().to(values)))
        if critic:
            value_loss = fit_critic(
                self.policy,
                self.critic_optimizer,
                critic,
                batch.observations,
                batch.actions,
                batch.returns,
                self.n_critic_updates,
                self.batch_size,
                self.max_grad_norm,
            )
        self.logger.record("train/value_loss", value_loss)
        self.logger.record("train/explained_variance", explained_variance(values.numpy(), batch.returns.cpu().numpy()))

    @guarded
    @together
    def learn(
        self: SelfREINFORCE,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 10,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfREINFORCE:
        """
        Train until at least ``total_timesteps`` environment steps are made.

        :param total_timesteps: Environment steps, of all environments together; the last rollout is finished
        :param callback: Called at each step of the environments
        :param log_interval: Rollouts between two entries of the log; None for no log
        :param tb_log_name: The name of the run for tensorboard; None for the name of the class
        :param reset_num_timesteps: Whether to reset the count of steps, and the environments; whole episodes always
            begin with a reset
        :param progress_bar: Display a progress bar using tqdm and rich
        :return: The trained model
        :raises TypeError: If an argument is of the wrong type
        :raises ValueError: If ``total_timesteps`` or ``log_interval`` is out of its range, the model has no
            environment, PyTorch's gradients are turned off, its default device is not the CPU, or processes under
            torchrun have different arguments; and as in ``collect_rollouts`` and ``train``
        :raises ConnectionError: If a worker of a ``SubprocVecEnv`` dies
        :raises RuntimeError: If another process under torchrun has stopped or died; the policy is the last good one
        """
        check_learn(self.env, total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        if not th.is_grad_enabled() or th.is_inference_mode_enabled():
            raise ValueError(
                "learn needs gradients, and PyTorch's are turned off: leave the block of th.no_grad or "
                "th.inference_mode, or undo th.set_grad_enabled(False)"
            )
        # Before the counters are reset
        check_reinforce(self)
        check_starts(self)
        tb_log_name = type(self).__name__ if tb_log_name is None else tb_log_name
        if reset_num_timesteps:
            # If the reset fails or is interrupted, the next call of learn resets
            self._last_obs = None
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        goes_on = self._last_obs is not None
        total_timesteps, callback = super()._setup_learn(*args, **kwargs)
        if self.n_steps is None and goes_on:
            # The environments may have been used since their last episodes ended
            self._last_obs = None
        # The first rollout has the temperature of the start, not the final one of an earlier run
        self._update_current_progress_remaining(self.num_timesteps, max(1, total_timesteps))
        return total_timesteps, callback

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_groups", "rollout"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer", "critic_optimizer"], []
