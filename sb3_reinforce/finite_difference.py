"""FiniteDifference as an algorithm of Stable-Baselines3."""

import math
import warnings
from functools import partial
from typing import Any, ClassVar, TypeVar, cast

import torch as th
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_reinforce.common import optimization
from sb3_reinforce.common.arguments import check_function
from sb3_reinforce.common.base import BasePolicyGradient
from sb3_reinforce.common.distribution import together
from sb3_reinforce.common.interruptions import uninterrupted
from sb3_reinforce.common.settings import (
    FINITE_DIFFERENCE_ARGUMENTS,
    INSTEAD_OF_ON_POLICY,
    check_finite_difference,
    check_learn,
    check_named,
)
from sb3_reinforce.common.tensors import ROUNDING
from sb3_reinforce.envs.guards import guarded
from sb3_reinforce.estimation.estimators import (
    ESTIMATORS,
    Estimator,
    GradientEstimate,
    central_difference,
    check_tensor,
    fit_quality,
)
from sb3_reinforce.estimation.perturbations import (
    PERTURBATIONS,
    Perturbation,
    default_delta_std,
    default_n_delta,
    new_generator,
    sample_deltas,
)
from sb3_reinforce.policies import parameters
from sb3_reinforce.policies.linear import LinearPolicy
from sb3_reinforce.policies.masks import MaskedPolicy
from sb3_reinforce.sampling.normalization import frozen
from sb3_reinforce.sampling.utility import EpisodicUtility, Stopped

SelfFiniteDifference = TypeVar("SelfFiniteDifference", bound="FiniteDifference")


class FiniteDifference(BasePolicyGradient):
    """
    Search in the space of a policy's parameters, by a gradient that is estimated from returns alone.

    One optimizer step per update, from ĝ ≈ ∇θ U(θ), where U(θ) = E[Σ_t r_t] is the expected return of an episode:

        ``central:     2Δ ĝ ≈ U(θ+Δ) − U(θ−Δ)``
        ``forward:      Δ ĝ ≈ U(θ+Δ) − U(θ)``
        ``regression: [1 Δ] [u₀ ĝ]ᵀ ≈ U(θ+Δ)``

    (Peters and Schaal, 2008, section 3.1). No derivative of the policy is used, and returns are undiscounted. θ is the
    actor's parameters, those that the action for an observation near 0 is computed from; ``log_std`` is not searched,
    nor is the critic unless ``predict`` evaluates it. Different candidates act in different environments of one VecEnv:
    plain MLPs in one batched forward pass, other policies one after the other.

    The statistics of VecNormalize are frozen during an update, so that candidates are compared on one scale. The
    observations of an update are added to them afterwards. The first update uses the statistics of the first reset.
    Utilities are sums of unscaled rewards. A wrapper above VecNormalize gets unscaled rewards too.

    :param policy: The policy model to use (LinearPolicy, MlpPolicy, CnnPolicy, MultiInputPolicy, MaskedPolicy, or a
        subclass of ``ActorCriticPolicy``)
    :param env: The environment to learn from (if registered in Gymnasium, can be str)
    :param learning_rate: The learning rate, it can be a function of the progress that remains (from 1 to 0)
    :param estimator: ``"regression"``, ``"central"``, ``"forward"``, or a function of a utility, θ of shape ``(n,)``
        and perturbations of shape ``(k, n)`` that returns a gradient of shape ``(n,)``
    :param perturbation: ``"gaussian"``, ``"sphere"``, ``"rademacher"``, ``"coordinate"``, or a function of k, n and a
        ``torch.Generator`` that returns a tensor of shape ``(k, n)``, which ``delta_std`` multiplies
    :param n_delta: k, the perturbations per update. None: ``min(2n, 64)`` up to n = 42 and ``min(n / 2, 64)``
        beyond, at least ``n_top``; differences along coordinates have ``min(n, 64)``. It is chosen at construction:
        set ``model.n_delta = None`` after layers are frozen
    :param delta_std: The scale of the perturbations: the standard deviation of the change of each parameter, or with
        ``"coordinate"`` the change of the one parameter that is perturbed. A float or a schedule. None: 1 % of ‖θ‖, at
        least 0.05
    :param n_eval_episodes: Episodes per candidate, whose utility is their mean return
    :param common_random_numbers: Let candidates that are compared start from the same seeds. It removes the noise of
        the start from differences, but environments that wait for the longest episode of a round go on: their steps
        are counted and not used
    :param n_top: With ``"central"``, use only the ``n_top`` perturbations with the best candidates, as ARS does
    :param standardize_utilities: Divide the gradient by the standard deviation of all utilities (ARS: of those that
        ``n_top`` leaves) and multiply it by ``delta_std``: the step then does not depend on the scale of the rewards,
        and hardly on ``delta_std`` where perturbations, not starts or noise, cause most of that deviation
    :param deterministic: Whether candidates take their most likely actions, or sample
    :param max_grad_norm: Bound on the norm of a step's gradient; None or inf for no bound
    :param max_episode_steps: The length beyond which an episode raises an error
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
        "LinearPolicy": LinearPolicy,
        **A2C.policy_aliases,
        "MaskedPolicy": MaskedPolicy,
    }
    policy: ActorCriticPolicy
    _arguments = FINITE_DIFFERENCE_ARGUMENTS | {
        "estimator": partial(check_named, functions=ESTIMATORS),
        "perturbation": partial(check_named, functions=PERTURBATIONS),
    }
    _identifying_argument = "standardize_utilities"
    _instead = INSTEAD_OF_ON_POLICY
    # The keys of the on-policy algorithms, which ask nothing else of self
    dump_logs = cast(Any, OnPolicyAlgorithm.dump_logs)
    _maybe_recommend_cpu = cast(Any, OnPolicyAlgorithm._maybe_recommend_cpu)

    def __init__(
        self,
        policy: str | type[ActorCriticPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 0.05,
        estimator: str | Estimator = "regression",
        perturbation: str | Perturbation = "gaussian",
        n_delta: int | None = None,
        delta_std: float | Schedule | None = None,
        n_eval_episodes: int = 1,
        common_random_numbers: bool = True,
        n_top: int | None = None,
        standardize_utilities: bool = True,
        deterministic: bool = True,
        max_grad_norm: float | None = None,
        max_episode_steps: int = 100_000,
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
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self.estimator = estimator
        self.perturbation = perturbation
        self.n_delta = n_delta
        self.delta_std = delta_std
        self.n_eval_episodes = n_eval_episodes
        self.common_random_numbers = common_random_numbers
        self.n_top = n_top
        self.standardize_utilities = standardize_utilities
        self.deterministic = deterministic
        self.max_grad_norm = max_grad_norm
        self.max_episode_steps = max_episode_steps
        self._generator: th.Generator | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        check_finite_difference(self)
        self._setup_lr_schedule()
        super().set_random_seed(self.seed)
        policy_class = cast(type[ActorCriticPolicy], self.policy_class)
        policy = policy_class(self.observation_space, self.action_space, self.lr_schedule, **self.policy_kwargs)
        self.policy = policy.to(self.device)
        if policy_class in (ActorCriticPolicy, LinearPolicy):
            self._maybe_recommend_cpu(policy_class.__name__)
        self._check_arguments()
        if self._generator is None:
            self._generator = new_generator()

    def _check_arguments(self) -> list[th.nn.Parameter]:
        """Check the arguments as they are now, and choose ``n_delta`` if it is open; return what is searched."""
        check_finite_difference(self)
        # Also where n_delta is given: an error if there is nothing to search
        searched = parameters.searched_parameters(self.policy)
        if self.n_delta is None:
            n_parameters = sum(parameter.numel() for parameter in searched)
            n_delta = default_n_delta(n_parameters, self.estimator, self.perturbation)
            self._choose("n_delta", max(n_delta, self.n_top or 0))
        return searched

    def set_random_seed(self, seed: int | None = None) -> None:
        """Seed the global generators and the environments, and with a seed the perturbations too."""
        super().set_random_seed(seed)
        if seed is not None:
            self._generator = new_generator()

    @property
    def theta(self) -> th.Tensor:
        """θ, a copy of the actor's trainable parameters, shape ``(n,)``, float64."""
        return parameters.read(parameters.searched_parameters(self.policy))

    @property
    def n_parameters(self) -> int:
        """n, the number of parameters that are searched."""
        return sum(parameter.numel() for parameter in parameters.searched_parameters(self.policy))

    @guarded
    @together
    def learn(
        self: SelfFiniteDifference,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfFiniteDifference:
        """
        Train until at least ``total_timesteps`` environment steps are made.

        :param total_timesteps: Environment steps, of all environments together; the last update is finished
        :param callback: Called at each step of the environments; ``model.policy`` is then the center θ
        :param log_interval: Updates between two entries of the log; None for no log
        :param tb_log_name: The name of the run for tensorboard; None for the name of the class
        :param reset_num_timesteps: Whether to start the counts of steps and episodes from zero
        :param progress_bar: Display a progress bar using tqdm and rich
        :return: The trained model
        :raises TypeError: If an argument is of the wrong type
        :raises ValueError: If an argument is out of its range, the model has no environment, PyTorch is in inference
            mode, its default device is not the CPU, processes under torchrun have different arguments, nothing is left
            to search, a user's estimator or perturbation returns another shape, a perturbation, reward, observation or
            action is not finite, all perturbations are zero (for ``"regression"``: equal), an episode does not end, or
            with common random numbers the environments cannot be seeded one by one; and as in ``train``. The policy is
            the last good one
        :raises ConnectionError: If a worker of a ``SubprocVecEnv`` dies
        :raises RuntimeError: If another process under torchrun has stopped or died; the policy is the last good one
        """
        check_learn(self.env, total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        if th.is_inference_mode_enabled():
            raise ValueError(
                "learn cannot run in th.inference_mode, whose tensors the optimizer cannot change later: leave the "
                "block, or use th.no_grad"
            )
        # Before the counters are reset
        self._check_arguments()
        tb_log_name = type(self).__name__ if tb_log_name is None else tb_log_name
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        n = self.n_parameters
        if self.estimator == "regression" and cast(int, self.n_delta) <= n:
            warnings.warn(
                f"n_delta={self.n_delta} perturbations do not determine the gradient of {n} parameters and an "
                f"intercept: the regression returns the one of least norm. Set n_delta to {2 * n} or more, use "
                "estimator='central', or search fewer parameters",
                stacklevel=4,
            )
        callback.on_training_start(locals(), globals())
        iteration = 0
        while self.num_timesteps < total_timesteps:
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            estimate = self.estimate_gradient(callback)
            if estimate is None:
                break
            self.train(estimate)
            iteration += 1
            if log_interval is not None and iteration % log_interval == 0:
                self.dump_logs(iteration)
        callback.on_training_end()
        return self

    def estimate_gradient(self, callback: BaseCallback) -> GradientEstimate | None:
        """
        Perturb θ, evaluate the candidates and estimate ∇U(θ). θ does not change. The policy is left in evaluation mode.
        It advances the counts of steps and episodes and the generator of the perturbations, and updates the statistics
        of VecNormalize.

        ``learn`` calls it. If you call it yourself with common random numbers, all environments have the seed of the
        last candidates afterwards. ``learn`` gives them other seeds; before other uses seed them again (``env.seed``).

        :param callback: Called at each step and at both ends of the rollout; call its ``init_callback`` first
        :return: ĝ, and the evaluations that it was estimated from; None if the callback stopped them
        :raises ValueError: As ``learn``, or if ``learn`` was never called, or not since the model was loaded; then call
            ``learn(0)``, for a loaded model with ``reset_num_timesteps=False``
        """
        if self.ep_info_buffer is None or not hasattr(self, "logger"):
            raise ValueError(
                "estimate_gradient needs the counters and the log that learn creates: call learn(0) first, for a "
                "loaded model with reset_num_timesteps=False"
            )
        callback.on_rollout_start()
        # The user or a callback may have changed arguments
        searched = self._check_arguments()
        self.start_round()
        self.is_collecting = True
        try:
            theta = parameters.read(searched)
            n = len(theta)
            n_delta = cast(int, self.n_delta)
            generator = cast(th.Generator, self._generator)
            delta_std = default_delta_std(theta) if self.delta_std is None else self._scheduled("delta_std")
            perturbation = check_function("perturbation", self.perturbation, PERTURBATIONS)
            deltas = sample_deltas(perturbation, n_delta, n, delta_std, generator)
            estimator = check_function("estimator", self.estimator, ESTIMATORS)
            if self.n_top is not None:
                estimator = partial(central_difference, n_top=self.n_top)
            first_seed = int(th.randint(2**31, (), generator=generator))
            self.policy.set_training_mode(False)
            with frozen(self.env) as observed:
                utility = EpisodicUtility(self, searched, callback, observed, first_seed)
                try:
                    gradient = check_tensor("estimator", estimator(utility, theta, deltas), (n,))
                except Stopped:
                    return None
                if not utility.values:
                    raise ValueError("estimator must call the utility at least once: it has evaluated no candidate")
        finally:
            self.is_collecting = False
            # The environments are in the middle of episodes, and are reset before they are used again
            self._last_obs = None
        if self._processes is not None:
            self.end_round(None)
        callback.update_locals(locals())
        callback.on_rollout_end()
        columns = th.cat(utility.columns) if self.common_random_numbers else None
        return GradientEstimate(
            gradient, th.cat(utility.candidates), th.cat(utility.values), delta_std, searched, columns
        )

    def collect_part(self, callback: BaseCallback) -> None:
        # The utility evaluates this process's part of the perturbations, which all processes draw alike
        self.estimate_gradient(callback)

    @uninterrupted
    def train(self, estimate: GradientEstimate) -> None:
        """
        One optimizer step uphill.

        :param estimate: What ``estimate_gradient`` returned
        :raises ValueError: If the gradient or a parameter is not finite. The parameters are those before the step; a
            non-finite parameter also clears the optimizer's state
        """
        gradient = estimate.gradient
        searched = estimate.parameters
        utilities = estimate.utilities
        fit = fit_quality(estimate.candidates, utilities, gradient, estimate.columns)
        utility_std = float(utilities.std(correction=0))
        self._update_learning_rate(self.policy.optimizer)
        if self.standardize_utilities:
            # Equal utilities, sums of rewards in another order, may differ by rounding
            are_equal = utility_std <= ROUNDING * float(utilities.abs().max())
            gradient = gradient * (0.0 if are_equal else estimate.delta_std / utility_std)
        # The optimizer descends: here, and only here, the sign turns
        loss_gradient = [part[0] for part in parameters.split(-gradient[None], searched)]
        with optimization.kept_finite(self.policy.optimizer, searched, "policy"):
            grad_norm = optimization.step(self.policy.optimizer, searched, loss_gradient, self.max_grad_norm, "utility")
        self._n_updates += 1

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/delta_std", estimate.delta_std)
        self.logger.record("train/grad_norm", grad_norm)
        self.logger.record("train/r_squared", fit.r_squared)
        if not math.isnan(fit.residual_std):
            self.logger.record("train/residual_std", fit.residual_std)
        # Forward differences share the noise of U(θ), n_top selects by noise, and other estimators are not known
        has_standard_error = self.estimator in ("regression", "central") and self.n_top is None
        if has_standard_error and fit.standard_error is not None:
            self.logger.record("train/standard_error", float(fit.standard_error.mean()))
        self.logger.record("rollout/utility_mean", float(utilities.mean()))
        self.logger.record("rollout/utility_std", utility_std)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], []
