"""
Methods that both algorithms have for saving a model, loading it and going on: all of it happens, or nothing.

Each does what the method of this name does in Stable-Baselines3, and what its docstring says.
"""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from inspect import signature
from typing import Any, TypeVar, cast

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, TensorDict

from sb3_reinforce import random_state
from sb3_reinforce.environment_checks import check_env
from sb3_reinforce.storage import Place, check_archive, whole_or_not_at_all

Model = TypeVar("Model", bound=BaseAlgorithm)


def save(self: Any, path: Place, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
    """
    Save the model, with the states of the global random generators. A save that fails leaves the file as it was.

    :param path: The file, to which ``.zip`` is added where it has no suffix
    :param exclude: Attributes not to save, besides those that never are
    :param include: Attributes to save that otherwise are not
    """
    self._random_state = random_state.get()
    with whole_or_not_at_all(path) as file:
        BaseAlgorithm.save(self, file, exclude, include)


def load(
    cls: type[Model],
    /,
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
    :param restore_random_state: Put the global generators of Python, NumPy and PyTorch into the state in which they
        were when the model was saved. Training then goes on as if it had not been interrupted, from a reset of the
        environments on; their inside, their generators and the statistics of VecNormalize are not in the file
    :param kwargs: Further arguments of ``load``, and arguments of the algorithm that replace the saved ones
    :return: The model
    :raises TypeError: If an argument is of the wrong kind, or the algorithm has none of this name
    :raises ValueError: If an argument is out of its range, or the file is damaged
    """
    of_load = {"device", "custom_objects", "print_system_info", "force_reset"}
    of_model = signature(cls).parameters.keys() - {"policy", "stats_window_size", "_init_setup_model"}
    unknown = sorted(kwargs.keys() - of_load - of_model)
    if unknown:
        raise TypeError(f"load cannot replace {', '.join(unknown)}: a {cls.__name__} has {', '.join(sorted(of_model))}")
    if env is not None:
        env = check_env(env, verbose=0)
    check_archive(path, ("data", "policy.pth"))
    # The bound method of the class above, with this class
    model = cast(Model, BaseAlgorithm.load.__func__(cls, path, env, *args, **kwargs))  # type: ignore[attr-defined]
    if restore_random_state:
        random_state.restore(cast(Any, model)._random_state)
    return model


def set_env(self: Any, env: GymEnv, force_reset: bool = True) -> None:
    """
    Go on in another environment.

    :param env: As many environments as before, with the same spaces
    :param force_reset: Whether to reset them before training
    :raises TypeError: If ``env`` is no environment
    :raises ValueError: If their number or spaces are others
    """
    BaseAlgorithm.set_env(self, check_env(env, self.verbose, self.n_envs), force_reset)


def set_parameters(
    self: Any, load_path_or_dict: Place | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
) -> None:
    """
    Take parameters from a file or dictionary, which may be those of another algorithm with the same policy class: all
    of them, or where anything is wrong none.

    From a file tensors alone are read (``weights_only``): no code in it is run.

    :param load_path_or_dict: A saved model, or what ``get_parameters`` of a model returns
    :param exact_match: Whether there must be a state for everything that has one here, and nothing else; if not, what
        this model does not have, such as an optimizer for the critic, is left out
    :param device: Device on which the parameters are loaded
    :raises TypeError: If a state is not a dict
    :raises ValueError: If names do not match, a parameter is not finite, or a state is that of another optimizer
    :raises RuntimeError: If the parameters of the policy have other names or shapes
    """
    states = load_path_or_dict
    if not isinstance(states, dict):
        check_archive(states, ("policy.pth",))
        _, states, _ = load_from_zip_file(states, device=device, load_data=False)
    names = self._get_torch_save_params()[0]
    if exact_match and states.keys() != set(names):
        raise ValueError(f"load_path_or_dict must have {', '.join(names)}, got {', '.join(map(str, states))}")
    for name in states.keys() & set(names):
        if not isinstance(states[name], Mapping):
            raise TypeError(f"load_path_or_dict[{name!r}] must be a dict, as of state_dict(), got {states[name]!r}")
    with unchanged_on_error(self):
        own = {name: states[name] for name in names if name in states}
        BaseAlgorithm.set_parameters(self, own, exact_match, device)


@contextmanager
def unchanged_on_error(model: BaseAlgorithm) -> Iterator[None]:
    """
    Let parameters be set within the block. If that fails half-way, or does not leave a model that can be trained, they
    are put back.

    :param model: The model
    :raises ValueError: If a parameter is not finite, or an optimizer has the state of another one
    """
    before = deepcopy(model.get_parameters())
    try:
        yield
        for name, parameter in model.policy.named_parameters():
            if not parameter.isfinite().all():
                raise ValueError(f"load_path_or_dict must have finite parameters, got {name!r}: {parameter}")
        for name in before:
            check_settings(name, recursive_getattr(model, name))
    except BaseException:
        for name, state in before.items():
            part = recursive_getattr(model, name)
            getattr(part, "_orig_mod", part).load_state_dict(state)
        raise


def check_settings(name: str, part: Any) -> None:
    """
    Check that an optimizer has kept its settings, which the state of another one would have replaced.

    :param name: Its name
    :param part: The optimizer; anything else passes
    :raises ValueError: If one is missing
    """
    groups = part.param_groups if isinstance(part, th.optim.Optimizer) else []
    missing = sorted({setting for group in groups for setting in part.defaults.keys() - group.keys()})
    if missing:
        raise ValueError(
            f"load_path_or_dict[{name!r}] must be the state of a {type(part).__name__}, but it has no "
            f"{', '.join(missing)}: it is that of another optimizer"
        )
