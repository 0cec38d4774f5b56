"""The columns of a rollout, one per environment, which several processes may have collected."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_reinforce.common.tensors import map_parts
from sb3_reinforce.sampling.collection import ROWS, Columns


def gather(model: Any, buffer: RolloutBuffer, columns: Columns) -> Columns | None:
    """Process 0 writes the columns of all into the buffer and returns them; the others send theirs and return None."""
    if model._processes is None:
        return columns
    state = None if columns.state is None else columns.state.cpu()
    parts = model.end_round((replace(columns, state=state), {name: getattr(buffer, name) for name in ROWS}))
    return join(buffer, parts, model.device) if parts else None


def join(buffer: RolloutBuffer, parts: Sequence[tuple[Columns, dict[str, Any]]], device: Any = "cpu") -> Columns:
    """Write the parts side by side into the buffer, as one process would with the environments of all."""
    all_columns = [columns for columns, _ in parts]
    # A process without a quota has steps until an episode ends, and none of them counts
    n_steps = max(len(columns.dones) for columns in all_columns if columns.quota.any())
    for name in ROWS:
        # A policy may refuse observations of zeros
        mode = "edge" if name == "observations" else "constant"
        setattr(buffer, name, side_by_side([rows[name] for _, rows in parts], n_steps, mode))
    buffer.n_envs = buffer.rewards.shape[1]
    buffer.buffer_size = n_steps
    buffer.pos = n_steps
    first = np.cumsum([0, *(len(columns.quota) for columns in all_columns)]).tolist()
    terminal_obs = [
        ((step, first[number] + env), obs)
        for number, columns in enumerate(all_columns)
        for (step, env), obs in columns.terminal_obs.items()
    ]
    states = [columns.state for columns in all_columns]
    known = next((each for each in states if each is not None), None)
    state = None
    if known is not None:
        # A process whose environments all start episodes has no state
        state = th.cat([th.zeros_like(known) if each is None else each for each in states]).to(device)
    return Columns(
        # An episode that ends beyond the quota does not count, and the padding ends none
        dones=side_by_side([columns.dones for columns in all_columns], n_steps),
        # In the order of one process: the last bit of a batch's values may depend on it
        terminal_obs=dict(sorted(terminal_obs, key=lambda item: item[0])),
        last_obs=map_parts(lambda *parts: np.concatenate(parts), *(columns.last_obs for columns in all_columns)),
        quota=np.concatenate([columns.quota for columns in all_columns]),
        state=state,
        # A callback of process 0 may have changed its policy alone
        has_values=all(columns.has_values for columns in all_columns),
    )


def side_by_side(arrays: Sequence[Any], n_steps: int, mode: Any = "constant") -> Any:
    """Arrays, or dicts of arrays, along the axis of the environments, cut or padded to ``n_steps`` rows."""

    def padded(rows: np.ndarray) -> np.ndarray:
        rows = rows[:n_steps]
        return np.pad(rows, [(0, n_steps - len(rows)), *[(0, 0)] * (rows.ndim - 1)], mode)

    return map_parts(lambda *parts: np.concatenate([padded(rows) for rows in parts], axis=1), *arrays)
