"""Saving a model, loading it and going on."""

import pickle
import random
from collections.abc import Iterable, Iterator, Mapping
from copy import deepcopy
from inspect import signature
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_reinforce.common.arguments import check_flag
from sb3_reinforce.common.spaces import check_env
from sb3_reinforce.common.storage import Place, check_archive, whole_or_not_at_all

Model = TypeVar("Model", bound="Persistent")


class Persistent(BaseAlgorithm):
    """
    Saving a model, loading it and going on: all of it happens, or nothing.

    What the algorithms inherit, since ``load`` is a method of the class. Each method does what that of its name does in
    Stable-Baselines3, and what its docstring says.
    """

    _random_state: bytes

    def save(self, path: Place, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """
        Save the model, with the states of the global random generators. A save that fails leaves the file as it was.

        :param path: The file, to which ``.zip`` is added where it has no suffix
        :param exclude: Attributes not to save, besides those that never are
        :param include: Attributes to save that otherwise are not
        """
        device = th.cuda.get_rng_state(self.device) if self.device.type == "cuda" else None
        states = random.getstate(), np.random.get_state(), th.get_rng_state(), device
        # As bytes, since Stable-Baselines3 would print each of their numbers into the file
        self._random_state = pickle.dumps(states)
        with whole_or_not_at_all(path) as file:
            super().save(file, exclude, include)

    @classmethod
    def load(
        cls: type[Model],
        path: Place,
        env: GymEnv | None = None,
        *args: Any,
        restore_random_state: bool = False,
        **kwargs: Any,
    ) -> Model:
        """
        Load a model. This runs code from the file: load only what you trust (see ``set_parameters``).

        :param path: The file
        :param env: The environment to go on in; None for prediction alone
        :param args: Further arguments of ``load`` in Stable-Baselines3
        :param restore_random_state: Put the global generators of Python, NumPy and PyTorch (on the CPU and the model's
            device) into the state in which they were when the model was saved. Training then goes on as if it had not
            been interrupted, from a reset of the environments on; their inside, their generators and the statistics of
            VecNormalize are not in the file. A model with a seed seeds them anew here: to seed them otherwise, do so
            after loading
        :param kwargs: Further arguments of ``load``, and arguments of the algorithm that replace the saved ones
        :return: The model
        :raises TypeError: If an argument is of the wrong kind, or the algorithm has none of this name
        :raises ValueError: If an argument is out of its range, or the file is damaged or has no random state
        """
        check_flag("restore_random_state", restore_random_state)
        known = arguments_of(cls) - {"self", "policy", "env", "stats_window_size", "_init_setup_model"}
        unknown = sorted(kwargs.keys() - known - {"device", "custom_objects", "print_system_info", "force_reset"})
        if unknown:
            raise TypeError(
                f"load cannot replace {', '.join(unknown)}: a {cls.__name__} has {', '.join(sorted(known))}"
            )
        if env is not None:
            env = check_env(env, verbose=0)
        if "_random_state" not in check_archive(path, ("data", "policy.pth")) and restore_random_state:
            raise ValueError(f"restore_random_state must be False for {path}, which was saved without a random state")
        model = super().load(path, env, *args, **kwargs)
        if kwargs.get("seed") is not None and not restore_random_state:
            # A generator that was saved goes on from the seed before
            model.set_random_seed(model.seed)
        if restore_random_state:
            python, numpy, torch, device = pickle.loads(model._random_state)
            random.setstate(python)
            np.random.set_state(numpy)
            th.set_rng_state(torch)
            if device is not None and model.device.type == "cuda":
                th.cuda.set_rng_state(device, model.device)
        return model

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Go on in another environment.

        :param env: As many environments as before, with the same spaces
        :param force_reset: Whether to reset them before training
        :raises TypeError: If ``env`` is no environment
        :raises ValueError: If their number or spaces are others
        """
        super().set_env(check_env(env, self.verbose, self.n_envs), force_reset)

    def set_parameters(
        self, load_path_or_dict: Place | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        Take parameters from a file or dictionary, which may be those of another algorithm with the same policy class:
        all of them, or where anything is wrong none.

        From a file tensors alone are read (``weights_only``): no code in it is run.

        :param load_path_or_dict: A saved model, or what ``get_parameters`` of a model returns
        :param exact_match: Whether there must be a state for everything that has one here, and nothing else; if not,
            what this model does not have, such as an optimizer for the critic, is left out
        :param device: Device on which the parameters are loaded
        :raises TypeError: If a state is not a dict
        :raises ValueError: If names do not match, a number is not finite, or a state is that of another optimizer or
            of other parameters
        :raises RuntimeError: If the parameters of the policy have other names or shapes
        """
        states = load_path_or_dict
        if not isinstance(states, dict):
            check_archive(states, ("policy.pth",))
            _, states, _ = load_from_zip_file(states, device=device, load_data=False)
        names = self._get_torch_save_params()[0]
        if exact_match and states.keys() != set(names):
            raise ValueError(f"load_path_or_dict must have {', '.join(names)}, got {', '.join(map(str, states))}")
        own = {name: states[name] for name in names if name in states}
        # A mask that a user's policy adds to its logits may well be infinite
        buffers = {f"policy.{name}" for name, _ in self.policy.named_buffers()}
        for name, state in own.items():
            if not isinstance(state, Mapping):
                raise TypeError(f"load_path_or_dict[{name!r}] must be a dict, as of state_dict(), got {state!r}")
            for key, number in numbers(name, state):
                if th.isnan(number).any() or (key not in buffers and th.isinf(number).any()):
                    raise ValueError(f"load_path_or_dict must have finite numbers, got {number} for {key}")
        before: Any = deepcopy(self.get_parameters())
        try:
            super().set_parameters(own, exact_match, device)
            for name in own:
                if isinstance(part := recursive_getattr(self, name), th.optim.Optimizer):
                    check_optimizer(name, part, before[name])
        except BaseException:
            super().set_parameters(before, device=device)
            raise


def arguments_of(cls: type) -> set[str]:
    """
    The names of the arguments of a class, also of those that it hands on to the class above by ``**kwargs``.

    :param cls: The class
    """
    names: set[str] = set()
    for each in cls.__mro__:
        parameters = signature(each.__init__).parameters.values()  # type: ignore[misc]
        handed_on = {parameter.name for parameter in parameters if parameter.kind is parameter.VAR_KEYWORD}
        names |= {parameter.name for parameter in parameters} - handed_on
        if not handed_on:
            break
    return names


def numbers(name: str, state: Any) -> Iterator[tuple[str, th.Tensor]]:
    """
    The tensors and floats of a state, each with its name.

    :param name: The name of the state
    :param state: As of ``state_dict()``
    """
    if isinstance(state, (th.Tensor, float)):
        yield name, th.as_tensor(state)
    elif isinstance(state, (Mapping, list, tuple)):
        parts = state.items() if isinstance(state, Mapping) else enumerate(state)
        for key, part in parts:
            yield from numbers(f"{name}.{key}", part)


def check_optimizer(name: str, optimizer: th.optim.Optimizer, before: Mapping[str, Any]) -> None:
    """
    Check that an optimizer has kept its settings, and that its moments are those of its parameters: a fused one would
    write beyond moments of another shape.

    :param name: Its name
    :param optimizer: The optimizer with its new state
    :param before: The state that it had
    :raises ValueError: If a setting is missing or of another kind, or moments do not go with the parameters
    """
    other = f"load_path_or_dict[{name!r}] must be the state of a {type(optimizer).__name__} for this policy, but"
    for group in optimizer.param_groups:
        for setting, old in before["param_groups"][0].items():
            if setting not in group:
                raise ValueError(f"{other} it has no {setting}: it is that of another optimizer")
            if isinstance(old, (float, tuple)) and type(group[setting]) not in (type(old), list, int):
                raise ValueError(f"{other} its {setting} is {group[setting]!r}")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for index, moments in optimizer.state_dict()["state"].items():
        # Those of some optimizers have a shape of their own
        known = {key: np.shape(value) for key, value in before["state"].get(index, {}).items()}
        for key in known.keys() | (moments.keys() if optimizer.defaults.get("fused") else ()):
            expected, got = known.get(key, tuple(parameters[index].shape)), np.shape(moments.get(key))
            if key not in moments or (got and got != expected):
                raise ValueError(f"{other} its {key} of parameter {index} must have shape {expected}, got {got}")
