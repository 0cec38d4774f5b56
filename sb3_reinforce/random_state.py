"""The state of the global random generators that training draws from, to go on exactly where a run has stopped."""

import random
from typing import Any

import numpy as np
import torch as th


def get() -> dict[str, Any]:
    """The states of the generators of Python, NumPy and PyTorch, on all its devices."""
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state(),
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
    }


def restore(state: dict[str, Any]) -> None:
    """
    Put the generators into a state.

    :param state: What ``get`` has returned
    :raises ValueError: If it was saved with another number of GPUs
    """
    n_gpus = th.cuda.device_count()
    if len(state["cuda"]) not in (0, n_gpus):
        raise ValueError(f"The random state is that of {len(state['cuda'])} GPUs, and there are {n_gpus}")
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(state["torch"])
    if state["cuda"]:
        th.cuda.set_rng_state_all(state["cuda"])
