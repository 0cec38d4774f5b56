"""What both algorithms inherit: checked arguments, prediction, saving, loading and going on."""

from collections.abc import Iterable, Mapping
from copy import deepcopy
from io import BytesIO
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_reinforce.common import storage
from sb3_reinforce.common.arguments import Check, CheckedSchedule, check_device, check_flag, own_arguments
from sb3_reinforce.common.distribution import Distributed
from sb3_reinforce.common.processes import is_leader, rank_and_size
from sb3_reinforce.common.settings import ATTRIBUTES, check_policy_name
from sb3_reinforce.common.spaces import check_dicts, check_env, check_noise, shift_to_start

Model = TypeVar("Model", bound="BasePolicyGradient")

# Arguments of Stable-Baselines3's ``load`` that are not stored in the model
LOAD_ARGUMENTS = {"print_system_info", "force_reset"}


class BasePolicyGradient(Distributed):
    """What both algorithms share besides the mathematics. Saving and loading change everything or nothing."""

    # The checks of the constructor's arguments, which also build the schedules
    _arguments: ClassVar[Mapping[str, Check]]
    # An argument that no other algorithm saves
    _identifying_argument: ClassVar[str]
    # What to use for arguments of other algorithms
    _instead: ClassVar[Mapping[str, str]] = {}
    _random_state: bytes

    def __new__(cls: type[Model], *args: Any, **kwargs: Any) -> Model:
        # Python would only say that the argument is unexpected; a subclass may have it
        accepted = own_arguments(cls, BasePolicyGradient)
        for name, instead in cls._instead.items():
            if name in kwargs and name not in accepted:
                raise TypeError(f"{cls.__name__} has no argument {name}: {instead}")
        return super().__new__(cls)

    def __init__(self, policy: Any, env: Any, *, needs_env: bool, policy_kwargs: Any, verbose: int, **kwargs: Any):
        verbose = verbose if is_leader() else 0
        kwargs |= {"policy": policy, "policy_kwargs": policy_kwargs, "verbose": verbose}
        # Stable-Baselines3 uses some arguments as soon as it has them
        for name, check in self._arguments.items():
            if name in kwargs:
                check(name, kwargs[name])
        self._check_policy(policy)
        if needs_env or env is not None:
            env = check_env(env, verbose)
            check_noise(kwargs.get("use_sde", False), env.action_space)
            check_dicts(policy, env.observation_space)
        # A copy, which the user's later changes do not reach
        kwargs["policy_kwargs"] = dict(policy_kwargs or {})
        self._schedules: dict[str, CheckedSchedule] = {}
        self._chosen_defaults: dict[str, int] = {}
        #: Whether episodes are being played, so that the environments must be left alone
        self.is_collecting = False
        super().__init__(env=env, **kwargs)

    def _check_policy(self, policy: str | type) -> None:
        check_policy_name(policy, self.policy_aliases)

    def _setup_lr_schedule(self) -> None:
        self.lr_schedule = self._checked("learning_rate")

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        # Another learning rate that a callback has set, unless the user has replaced the schedule itself
        if isinstance(self.lr_schedule, CheckedSchedule):
            self._setup_lr_schedule()
        super()._update_learning_rate(optimizers)

    def _checked(self, name: str) -> Any:
        """Check an argument as it is now, and return it; a schedule only once, since a user's function may be slow."""
        given = getattr(self, ATTRIBUTES.get(name, name))
        if name in self._schedules and self._schedules[name].given is given:
            return self._schedules[name]
        value = self._arguments[name](name, given)
        if isinstance(value, CheckedSchedule):
            self._schedules[name] = value
        return value

    def _choose(self, name: str, value: int) -> None:
        """Set an argument that the user has left open."""
        setattr(self, name, value)
        self._chosen_defaults[name] = value

    def _scheduled(self, name: str) -> float:
        """Return the present value of an argument that may be a schedule."""
        return float(self._checked(name)(self._current_progress_remaining))

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last rollout may overshoot total_timesteps, and must not train at a negative rate
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_schedules", "is_collecting"]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Get the policy's action, as the environment takes it: a Discrete or MultiDiscrete action counts from its start.

        :param observation: One observation, or a batch ``(n_envs, ...)``
        :param state: The last state of a recurrent policy, two arrays ``(n_layers, n_envs, n_hidden)``; None if every
            observation starts an episode. Other policies return it unchanged
        :param episode_start: Which observations start an episode, ``(n_envs,)``, for recurrent policies
        :param deterministic: Whether to return the most likely action instead of a sample
        :return: The action, or the actions ``(n_envs, *action_space.shape)``, and the next state
        """
        actions, state = super().predict(observation, state, episode_start, deterministic)
        return shift_to_start(self.action_space, actions), state

    def save(
        self, path: storage.PathOrFile, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """
        Save the model, with the states of the global random generators. A save that fails leaves the file as it was.

        :param path: The file, to which ``.zip`` is added where it has no suffix; under torchrun process 0 writes it
        :param exclude: Further attributes not to save; the one by which ``load`` recognizes the class is always saved
        :param include: Attributes to save that otherwise are not
        :raises OSError: If the file cannot be written
        """
        self._random_state = storage.generator_states(self.device)
        self._n_processes = rank_and_size()[1]
        buffer = BytesIO()
        # load knows the class by this argument
        super().save(buffer, exclude, {*(include or ()), self._identifying_argument})
        storage.write_whole(path, buffer.getvalue())

    @classmethod
    def load(
        cls: type[Model],
        path: storage.PathOrFile,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        *args: Any,
        restore_random_state: bool = False,
        **kwargs: Any,
    ) -> Model:
        """
        Load a model. This runs code from the file: load only files that you trust (see ``set_parameters``).

        :param path: The file
        :param env: The environment to continue in; None for prediction alone
        :param device: Device on which the model is loaded
        :param custom_objects: What to use instead of saved attributes, by name; these are not unpickled
        :param args: Further arguments of ``load`` in Stable-Baselines3
        :param restore_random_state: Restore the global generators of Python, NumPy and PyTorch (on the CPU and the
            model's device) as they were saved. Training then continues as if it had not been interrupted, from a reset
            of the environments on; the file has neither the environments' state and generators nor the statistics of
            VecNormalize. If False, a model with a seed seeds them: call ``set_random_seed`` to use another
        :param kwargs: Further arguments of ``load``, and arguments that replace the saved ones, except ``policy``,
            ``policy_kwargs`` and ``stats_window_size``. An ``lr_schedule`` that was set by hand is not stored
        :return: The model
        :raises TypeError: If an argument is of the wrong type, unknown, or cannot be replaced
        :raises ValueError: If an argument is out of its range or ``policy_kwargs`` differ, or the file is not valid
        """
        check_device("device", device)
        check_flag("restore_random_state", restore_random_state)
        saved = storage.check_archive(path, ("data", "policy.pth"))
        if cls._identifying_argument not in saved:
            raise ValueError(
                f"{path} was not saved by a {cls.__name__}. If it has the same policy class, make a {cls.__name__} and "
                "call set_parameters with this path and exact_match=False"
            )
        arguments = own_arguments(cls, BasePolicyGradient).keys() - ATTRIBUTES.keys()
        unknown = sorted(kwargs.keys() - arguments - saved.keys() - LOAD_ARGUMENTS)
        if unknown:
            allowed = ", ".join(sorted(arguments))
            raise TypeError(f"load cannot replace {', '.join(unknown)}: a {cls.__name__} has {allowed}")
        if env is not None:
            env = check_env(env, verbose=0)
        n_envs = None if env is None else getattr(env, "num_envs", 1)
        given = {**(custom_objects or {}), **kwargs}
        kwargs |= storage.defaults_to_choose_again(saved, given.keys() - LOAD_ARGUMENTS, n_envs)
        model = super().load(path, env, device, custom_objects, *args, **kwargs)
        if restore_random_state:
            storage.restore_generators(model._random_state, model.device)
        elif given.get("seed") is not None:
            # A generator that was saved continues from the seed before
            model.set_random_seed(model.seed)
        return model

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Continue in another environment.

        :param env: As many environments as before, with the same spaces
        :param force_reset: Whether to reset them before training; whole episodes always begin with a reset
        :raises TypeError: If ``env`` is not an environment, or ``force_reset`` is not a flag
        :raises ValueError: If their number or their spaces differ from the model's
        """
        check_flag("force_reset", force_reset)
        super().set_env(check_env(env, self.verbose, self.n_envs), force_reset)

    def set_parameters(
        self,
        load_path_or_dict: storage.PathOrFile | TensorDict,
        exact_match: bool = True,
        device: th.device | str = "auto",
    ) -> None:
        """
        Take parameters from a file or dictionary, also from another algorithm with the same policy class: all of them,
        or none if anything is wrong.

        From a file only tensors are read (``weights_only``): no code in it is run.

        :param load_path_or_dict: A saved model, or what ``get_parameters`` of a model returns
        :param exact_match: Whether names must be those of ``get_parameters`` here. If False, what is missing stays, and
            unknown parameters and the state of another kind of optimizer are left out, with a warning; so are all
            optimizers' states if the policy's names differ. FiniteDifference ignores ``critic_optimizer``
        :param device: Device on which the parameters are loaded
        :raises TypeError: If an argument is of the wrong type, or a state is not a dict
        :raises ValueError: If names do not match, a number is not finite, or a state belongs to another optimizer or
            to other parameters
        :raises RuntimeError: If parameters of the policy have other shapes, or with ``exact_match`` other names
        """
        check_flag("exact_match", exact_match)
        check_device("device", device)
        states = load_path_or_dict
        if not isinstance(states, dict):
            storage.check_archive(states, ("policy.pth",))
            _, states, _ = load_from_zip_file(states, device=device, load_data=False)
        own = storage.check_states(states, self._get_torch_save_params()[0], exact_match)
        storage.check_finite_state(own, storage.may_be_infinite(self.policy))
        before: Any = deepcopy(self.get_parameters())
        try:
            # First the policy, whose error names parameters. The optimizers' states fit only if all of these are loaded
            if "policy" not in own or storage.load_policy(self.policy, own.pop("policy"), exact_match):
                for name, state in own.items():
                    storage.load_part(recursive_getattr(self, name), name, state, exact_match)
        except BaseException:
            super().set_parameters(before)
            raise
