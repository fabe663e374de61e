"""A module of TorchRL or tensordict, as a map from observations to values of actions, or to the action itself."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import GRUModule, LSTMModule, set_recurrent_mode

from cavbench.driving.victims.remembering import BEGUN, Memory, empty
from cavbench.driving.victims.spaces import UNBOUNDED
from cavbench.errors import UserError

VALUES = ("action_value", "logits", "probs")
"""Names of entries with a value for each discrete action, in order of preference."""
ACTION = "action"
FIRST = "is_init"
"""The entry that says whether an episode begins."""
LEARNING = ("VecNorm", "VecNormV2")
"""Transforms whose statistics change when they are called. A lock of theirs also stays locked after a failed call."""
Carried = dict[Any, tuple[Any, tuple[int, ...]]]
"""For each entry that is read: the entry that is written for the next call, and its shape."""
INSTEAD = "give the torch.nn.Module from observation to values or actions instead"


def is_actor(given: object) -> bool:
    """Whether an object maps a TensorDict to a TensorDict."""
    return isinstance(given, TensorDictModuleBase)


def carried(actor: nn.Module, read: Sequence[Any], written: Sequence[Any]) -> Carried:
    """What an actor writes for its own next call.

    An entry `key` is carried on if the actor writes `("next", key)`, or if an `LSTMModule` or a `GRUModule` reads it as its state
    and writes it again. Its shape is what that module says.

    Args:
        actor: the module.
        read, written: its keys.

    Raises:
        UserError: if no module says the shape of an entry.
    """
    shapes: dict[Any, tuple[int, ...]] = {}
    for part in actor.modules():
        if isinstance(part, LSTMModule | GRUModule):
            network = part.lstm if isinstance(part, LSTMModule) else part.gru
            sizes = [getattr(network, "proj_size", 0) or network.hidden_size, network.hidden_size]
            shapes |= {
                unravel_key(key): (network.num_layers, size)
                for key, size in zip(part.in_keys[1:-1], sizes, strict=False)
            }
    found: Carried = {}
    for key in read:
        path = (key,) if isinstance(key, str) else tuple(key)
        # What is no memory may be written again, too: by a transform that normalises the observation.
        again = [key] if key in shapes else []
        later = next((one for one in (("next", *path), *again) if one in written), None)
        if later is None or _last(key) == FIRST:
            continue
        if key not in shapes:
            raise UserError(
                f"{type(actor).__name__} remembers {_listed([key])}, whose shape only an LSTMModule or a GRUModule says; give a "
                "cavbench.driving.Policy with `initial` and `advance`"
            )
        found[key] = (later, shapes[key])
    return found


class ActorNetwork(nn.Module):
    """What an actor writes on an observation, without its exploration: the most probable action, not a sample.

    The values of discrete actions (`action_value`, `logits` or `probs`) are read if it writes them, otherwise its action. What it
    reads and writes for its own next call, such as the state of an `LSTMModule`, is its memory (`carried`).

    Args:
        actor: the module, with one input besides its memory.

    Raises:
        UserError: if it reads or writes something else.
    """

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.name = type(actor).__name__
        self.actor = copy.deepcopy(actor)
        # What an actor hides of its results is often what it chooses from.
        for part in self.actor.modules():
            if isinstance(part, TensorDictModuleBase):
                part.reset_out_keys()
        self._check_statistics()
        read, written = ([unravel_key(key) for key in keys] for keys in (self.actor.in_keys, self.actor.out_keys))
        self.carried = carried(self.actor, read, written)
        self.marks = [key for key in read if _last(key) == FIRST]
        self.given = self._given([key for key in read if key not in (*self.carried, *self.marks)])
        memory = {later for later, _ in self.carried.values()}
        self.key = self._key([key for key in written if key not in memory])

    def _check_statistics(self) -> None:
        """Refuse a normalisation that goes on learning: its answers would depend on all that it was asked before."""
        for part in self.actor.modules():
            if type(part).__name__ in LEARNING and type(part).__module__.startswith("torchrl."):
                raise UserError(
                    f"{self.name} holds a {type(part).__name__}, which goes on learning its statistics when it is called: put "
                    "transform.to_observation_norm() in its place"
                )

    def _given(self, keys: Sequence[Any]) -> Any:
        if len(keys) != 1:
            raise UserError(
                f"{self.name} reads {_listed(keys)}, a driver is given one observation, and the memory of an LSTMModule or "
                f"GRUModule; {INSTEAD}, or a cavbench.driving.Policy with `initial` and `advance`"
            )
        return keys[0]

    def _key(self, keys: Sequence[Any]) -> Any:
        for wanted in (*VALUES, ACTION):
            if found := [key for key in keys if _last(key) == wanted]:
                return found[0]
        if len(keys) == 1:
            return keys[0]
        raise UserError(
            f"{self.name} writes {_listed(keys)}; a driver writes one of {', '.join((*VALUES, ACTION))}; {INSTEAD}"
        )

    @property
    def memory(self) -> Memory:
        """What it remembers of an episode, by names in order; empty for an actor without a memory."""
        dtype = next((weight.dtype for weight in self.parameters() if weight.is_floating_point()), torch.float32)
        begun = {BEGUN: ((), torch.bool)} if self.carried or self.marks else {}
        return {**begun, **{f"memory{place}": (shape, dtype) for place, (_, shape) in enumerate(self.carried.values())}}

    def forward(
        self, observation: Tensor, memory: TensorDictBase | None = None
    ) -> Tensor | tuple[Tensor, TensorDictBase]:
        """Values [N, A] of discrete actions or continuous actions [N, 2], of observations [N, *shape].

        With a memory of batch size [N]: a pair of these and the memory after them.
        """
        written = self._written(observation, memory)
        answer: Tensor = written[self.key]
        if memory is None:
            return answer
        after = {f"memory{place}": written[later] for place, (later, _) in enumerate(self.carried.values())}
        begun = torch.ones(len(observation), dtype=torch.bool, device=observation.device)
        return answer, TensorDict({BEGUN: begun, **after}, batch_size=observation.shape[:1])

    def _written(self, observation: Tensor, memory: TensorDictBase | None) -> TensorDictBase:
        """All that the actor writes; with an empty memory if there is none."""
        if memory is None:
            memory = empty(self.memory, torch.arange(len(observation), device=observation.device))
        entries: dict[Any, Tensor] = {key: memory[f"memory{place}"] for place, key in enumerate(self.carried)}
        for key in self.marks:
            entries[key] = ~memory[BEGUN].unsqueeze(-1)
        given = TensorDict(batch_size=observation.shape[:1], device=observation.device)
        for key, value in {self.given: observation, **entries}.items():
            given.set(key, value)
        with set_exploration_type(ExplorationType.DETERMINISTIC), set_recurrent_mode(False):
            return self.actor(given)

    @torch.no_grad()
    def check(self, observation: Tensor) -> None:
        """Compare the values with the action that the actor itself takes.

        Args:
            observation: observations [N, *shape].

        Raises:
            UserError: if it does not take the action of the highest value, or its actions are indices or on another scale.
        """
        written = self._written(observation, None)
        self._check_scale()
        keys = [key for key in written.keys(True, True) if _last(key) == ACTION]
        if not keys:
            return
        action, answer = written[keys[0]], written[self.key]
        if _last(self.key) in VALUES:
            self._check_choice(action, answer)
        elif not action.is_floating_point():
            raise UserError(f"{self.name} writes the number of an action, without the values it chooses by; {INSTEAD}")
        elif answer.ndim == 2 and answer.shape[1] != 2 and bool(((answer == 0) | (answer == 1)).all()):
            raise UserError(f"{self.name} writes one-hot actions, without the values it chooses by; {INSTEAD}")

    def _check_choice(self, action: Tensor, values: Tensor) -> None:
        if values.ndim != 2:
            raise UserError(
                f"{self.name} writes {_last(self.key)} of shape {list(values.shape)}, one number for each action is needed; "
                f"{INSTEAD}"
            )
        best = values.argmax(-1)
        one_hot = action.ndim == values.ndim and action.shape[-1] == values.shape[-1]
        chosen = action.bool().gather(-1, best[:, None]).squeeze(-1) if one_hot else action.reshape(-1) == best
        if not bool(chosen.all()):
            raise UserError(f"{self.name} does not take the action of the highest {_last(self.key)}; {INSTEAD}")

    def _check_scale(self) -> None:
        """Refuse continuous actions of another range than [-1, 1]: they would be clipped."""
        for part in self.actor.modules():
            options = getattr(part, "distribution_kwargs", None) or {}
            ends = [options[name] for name in ("low", "high") if name in options]
            spec: Any = getattr(part, "spec", None)
            action = spec.get(ACTION, None) if hasattr(spec, "keys") else spec
            space = getattr(action, "space", None)
            if space is not None and getattr(action, "domain", "") == "continuous":
                ends += [end for end in (getattr(space, "low", None), getattr(space, "high", None)) if end is not None]
            # `TanhModule` keeps them as buffers, named by the entry.
            if isinstance(part, TensorDictModuleBase):
                ends += [end for name, end in part.named_buffers(recurse=False) if name.endswith(("_low", "_high"))]
            for end in ends:
                numbers = torch.as_tensor(end).float()
                if bool(((numbers.abs() < UNBOUNDED) & (numbers.abs() != 1)).any()):
                    raise UserError(
                        f"{self.name} has actions up to {numbers.flatten()[0]:g}, controls are in [-1, 1] (acceleration, "
                        f"steering); {INSTEAD}"
                    )


def _last(key: Any) -> str:
    return key if isinstance(key, str) else str(key[-1])


def _listed(keys: Sequence[Any]) -> str:
    return ", ".join(key if isinstance(key, str) else ".".join(key) for key in keys) or "nothing"
