"""An unfinished training on disk: it goes on where it stopped, with the same result as without the stop."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch

from cavbench.errors import UserError
from cavbench.files import whole


class Stateful(Protocol):
    """What torch saves and restores: networks, optimisers, schedules."""

    def state_dict(self) -> Any: ...

    def load_state_dict(self, state_dict: Any) -> Any: ...


@dataclass(frozen=True)
class Checkpoint:
    """Where an unfinished training is kept.

    Args:
        path: the file; it is deleted at the end of the training.
        every: updates between two writes.
        held: what the loss remembers from one update to the next: tensors, numbers, and lists of them.
        restore: gives it back to the loss.
    """

    path: Path
    every: int
    held: Callable[[], Mapping[str, Any]]
    restore: Callable[[Mapping[str, Any]], None]

    def resume(self, parts: Mapping[str, Stateful]) -> int:
        """Restore the parts and what the loss remembers; return the number of the next update, 0 without a file.

        Raises:
            UserError: if the file cannot be read, or is of another training.
        """
        if not self.path.exists():
            return 0
        try:
            kept = torch.load(self.path, weights_only=True)
            for name, part in parts.items():
                part.load_state_dict(kept["parts"][name])
            torch.set_rng_state(kept["random"])
            self.restore(kept["held"])
            return int(kept["update"])
        except (OSError, RuntimeError, EOFError, pickle.UnpicklingError, KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"the unfinished training {self.path} cannot be continued ({str(error).splitlines()[0][:80]}); delete it"
            ) from None

    def keep(self, update: int, parts: Mapping[str, Stateful]) -> None:
        """Write the state before an update, atomically, if it is time."""
        if not update or update % self.every:
            return
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with whole(self.path) as file:
            states = {name: part.state_dict() for name, part in parts.items()}
            torch.save(
                {"update": update, "parts": states, "random": torch.get_rng_state(), "held": dict(self.held())}, file
            )

    def done(self) -> None:
        """Delete the file."""
        self.path.unlink(missing_ok=True)
