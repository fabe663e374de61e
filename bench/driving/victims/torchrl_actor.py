"""A module of TorchRL or tensordict, as a map from observations to values of actions, or to the action itself."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from cavbench.driving.victims.spaces import UNBOUNDED
from cavbench.errors import UserError

VALUES = ("action_value", "logits", "probs")
"""Names of entries with a value for each discrete action, in order of preference."""
ACTION = "action"
INSTEAD = "give the torch.nn.Module from observation to values or actions instead"


def is_actor(given: object) -> bool:
    """Whether an object maps a TensorDict to a TensorDict."""
    return isinstance(given, TensorDictModuleBase)


class ActorNetwork(nn.Module):
    """What an actor writes on an observation, without its exploration: the most probable action, not a sample.

    The values of discrete actions (`action_value`, `logits` or `probs`) are read if it writes them, otherwise its action.

    Args:
        actor: the module, with one input.

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
        self.given = self._given(self.actor.in_keys)
        self.key = self._key([unravel_key(key) for key in self.actor.out_keys])

    def _given(self, keys: Sequence[Any]) -> Any:
        if len(keys) != 1:
            memory = (
                " (a recurrent policy is a cavbench.driving.Policy with `initial` and `advance`)"
                if len(keys) > 1
                else ""
            )
            raise UserError(f"{self.name} reads {_listed(keys)}, a driver is given one observation{memory}; {INSTEAD}")
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

    def forward(self, observation: Tensor) -> Tensor:
        """Values [N, A] of discrete actions or continuous actions [N, 2], of observations [N, *shape]."""
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = self.actor(TensorDict({self.given: observation}, batch_size=observation.shape[:1]))
        answer: Tensor = written[self.key]
        return answer

    @torch.no_grad()
    def check(self, observation: Tensor) -> None:
        """Compare the values with the action that the actor itself takes.

        Args:
            observation: observations [N, *shape].

        Raises:
            UserError: if it does not take the action of the highest value, or its actions are indices or on another scale.
        """
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            written = self.actor(TensorDict({self.given: observation}, batch_size=observation.shape[:1]))
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
