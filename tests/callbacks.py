"""Callbacks that record, change or stop a training."""

from collections.abc import Callable
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback


class Record(BaseCallback):
    """Keeps ``function(model)`` at each "step", "rollout_start" or "rollout_end"."""

    def __init__(self, function: Callable[[Any], Any], at: str = "rollout_end"):
        super().__init__()
        self.function, self.at, self.records = function, at, []

    def _record(self, at: str) -> bool:
        if at == self.at:
            self.records.append(self.function(self.model))
        return True

    def _on_step(self) -> bool:
        return self._record("step")

    def _on_rollout_start(self) -> None:
        self._record("rollout_start")

    def _on_rollout_end(self) -> None:
        self._record("rollout_end")


class At(BaseCallback):
    """Calls ``function(model)`` after so many steps; training stops if that returns False."""

    def __init__(self, n_calls: int, function: Callable[[Any], Any] = lambda model: False):
        super().__init__()
        self.at, self.function = n_calls, function

    def _on_step(self) -> bool:
        return self.n_calls != self.at or self.function(self.model) is not False
