"""A driver from outside that remembers something of each episode: a recurrent network, or a stack of frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving import State
from cavbench.driving.victims.from_file import FilePolicy

BEGUN = "begun"
"""The entry of a memory that is true after the first decision."""
Memory = Mapping[str, tuple[tuple[int, ...], torch.dtype]]
"""The shape and the type of each entry that is remembered of an episode. Before the first decision all entries are 0."""


def empty(memory: Memory, episodes: Tensor) -> TensorDict:
    """The memory [B] before the first decision of some episodes, int64 [B]."""
    entries = {
        name: torch.zeros(*episodes.shape, *shape, dtype=dtype, device=episodes.device)
        for name, (shape, dtype) in memory.items()
    }
    return TensorDict(entries, batch_size=episodes.shape)


class RememberingPolicy(FilePolicy):
    """A policy whose network is given what it remembers, and returns what it remembers next.

    Args:
        network: maps observations [N, *shape] and a memory of batch size [N] to scores [N, A], or actions [N, 2], and the memory
            after them.
        memory: what it remembers.
        options: as of `FilePolicy`.
    """

    def __init__(
        self,
        network: Callable[[Tensor, TensorDictBase], tuple[Tensor, TensorDictBase]],
        memory: Memory,
        **options: Any,
    ) -> None:
        super().__init__(network, **options)  # type: ignore[arg-type] # called with a memory, below
        self.memory = dict(memory)

    def initial(self, episodes: Tensor) -> State:
        return empty(self.memory, episodes)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        shown = self._shown(observation)
        if not len(shown):
            return self._answered(None, observation)
        return self._answered(self._asked(shown, state)[0], observation)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        shown = self._shown(observation)
        if not len(shown):
            return state
        return self._asked(shown, state)[1].reshape(state.batch_size)

    def _asked(self, shown: Tensor, state: State) -> tuple[Tensor, TensorDictBase]:
        assert state is not None
        # On a GPU the kernels of recurrent networks have no gradient in eval mode.
        with torch.backends.cudnn.flags(enabled=False):
            found: tuple[Tensor, TensorDictBase] = self.network(shown, state.reshape(-1))  # type: ignore[call-arg,assignment]
        return found
