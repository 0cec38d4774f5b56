"""What the callbacks of the lab have in common."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, EventCallback


class Diagnosis(BaseCallback):
    """Keeps what it knows of a model from one ``learn()`` to the next, but not for another model."""

    # A REINFORCE; GradientQualityCallback takes a FiniteDifference too
    model: Any

    def __init__(self, verbose: int = 0):
        super().__init__(verbose)
        self.last_model: Any = None
        self._forget()

    @property
    def parent(self) -> BaseCallback | None:
        """The callback that calls this one, None for ``learn()`` and for a ``CallbackList`` that it was given."""
        return self._parent

    @parent.setter
    def parent(self, parent: BaseCallback | None) -> None:
        # Which passes on steps, but not the ends of rollouts
        if isinstance(parent, EventCallback):
            raise ValueError(f"{type(self).__name__} must be given to learn(), not to {type(parent).__name__}")
        self._parent = parent

    def _init_callback(self) -> None:
        if self.model is not self.last_model:
            self.last_model = self.model
            self._forget()

    def _forget(self) -> None:
        """Start with a model of which nothing is known."""

    def _on_step(self) -> bool:
        return True
