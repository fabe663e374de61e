"""The run's side of forgeries: composes what the victim is shown and what the car executes, within the sets of the threat model.

What is counted (cars, frames, decisions) is refused where it is too much; what is continuous is clipped to the set.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal

import torch
from torch import Tensor

from cavbench.driving import invented
from cavbench.driving.features import ActionType, Features
from cavbench.driving.forgery import Forgery, composed
from cavbench.driving.messaging import Messaging
from cavbench.driving.sets import Actuator
from cavbench.driving.threat import ObservationThreat, PerturbationSet, bounds
from cavbench.errors import UserError

NO_ACTUATOR = Actuator()
COINS = 0x5DEECE66D
"""The run's coins have another seed than the attack's random numbers."""


@dataclass(frozen=True, eq=False)
class Used:
    """What was used of the sets in a step, int64 [B] each.

    Args:
        hidden, invented: cars.
        age: of the frame in decisions.
        messages: senders whose messages were forged, repeated or held back.
    """

    hidden: Tensor
    invented: Tensor
    age: Tensor
    messages: Tensor

    @classmethod
    def nothing(cls, batch: int) -> Used:
        """Nothing in every episode."""
        return cls(*torch.zeros(4, batch, dtype=torch.int64))


class Forging:
    """Enforces the sets beside the perturbation of values, for B episodes from their start.

    Args:
        threat: the threat model; this object's own copy.
        features: features of the observation.
        period: seconds between decisions.
        steps: decisions of a full episode, of which the shares are.
        parts: number of episodes of each unit, with the seed of its attack.
    """

    def __init__(
        self, threat: ObservationThreat, features: Features, period: float, steps: int, parts: Sequence[tuple[int, int]]
    ) -> None:
        self.threat, self.features, self.period, self.steps = threat, features, period, steps
        batch = sum(count for count, _ in parts)
        self.coins = [(count, torch.Generator().manual_seed(seed ^ COINS)) for count, seed in parts]
        self.depth = threat.latency.frames + threat.held.longest
        self.messaging = Messaging(threat.messages, features, period, steps, batch)
        self.elapsed = -1
        self.truths: list[Tensor] = []
        self.actions: list[Tensor] = []
        self.age, self.repeats, self.held, self.forged = torch.zeros(4, batch, dtype=torch.int64)
        self.ghosts: Tensor | None = None
        self.ego: Tensor | None = None
        self.before = self.age.clone()
        self.used = Used.nothing(batch)
        self.answer: Forgery | None = None
        self.rows = torch.zeros(0, dtype=torch.int64)

    def see(self, truth: Tensor) -> None:
        """Note the true observation of a step [B, V, F], and that nothing is forged in it as yet."""
        self.elapsed += 1
        if self.depth:
            self.truths = [truth.clone(), *self.truths[: self.depth]]
        else:
            self.truths = [truth]
        self.messaging.see(truth)
        self.answer, self.used, self.before = None, Used.nothing(len(truth)), self.age.clone()

    def past(self, age: int) -> Tensor:
        """[B, V, F] the truth of some decisions ago, or the oldest that is kept."""
        return self.truths[min(age, len(self.truths) - 1)]

    def left(self, of: Literal["presence", "held", "messages"], rows: Tensor) -> Tensor:
        """int64 [R] frames that are left of a set's share."""
        if of == "messages":
            return self.messaging.left(rows)
        spent = self.forged if of == "presence" else self.held
        return _frames(getattr(self.threat, of).share, self.steps) - spent[rows]

    def show(self, forgery: Forgery, rows: Tensor, name: str) -> tuple[Tensor, Tensor]:
        """What the victim is shown in the episodes `rows` [R], and how far the answer was outside of its set [R].

        Raises:
            UserError: if the answer is more than the threat model allows.
        """
        _check(forgery, name)
        base = self._aged(forgery, rows, name)
        shown, excess = base, base.new_zeros(len(rows))
        if forgery.observation is not None:
            given = _shaped(forgery.observation, base.shape, "observation", name).to(base.dtype)
            radius = self.threat.radius(base, self.features)
            shown, excess = PerturbationSet(base, radius, *bounds(base, radius)).project(given)
        shown, told = self._told(forgery, shown, rows, name)
        excess = torch.maximum(excess, told)
        hidden = self._hidden(forgery, base, rows, name)
        ghosts, beyond = self._invented(forgery, base, rows, name)
        if hidden is not None or ghosts is not None:
            shown = composed(shown, self.features, hidden, ghosts)
            self._spend(rows, name)
            excess = torch.maximum(excess, beyond)
        self.answer, self.rows = self._commands(forgery, len(rows), name), rows
        return shown, excess

    def _told(self, forgery: Forgery, shown: Tensor, rows: Tensor, name: str) -> tuple[Tensor, Tensor]:
        """What is shown, with the messages that the attack forged, and how far these had to be moved for that [R]."""
        if not self.messaging.allowed:
            if forgery.messages is not None or forgery.content is not None or forgery.dropped is not None:
                raise UserError(f"{name} forged messages, the threat model allows none (threat.messages.senders)")
            return shown, shown.new_zeros(len(rows))
        told, excess, used = self.messaging.tell(forgery, shown, self.age[rows], rows, name)
        self.used.messages[rows] = used
        return told, excess

    def close(self, truth: Tensor, attacked: Tensor) -> None:
        """End the showing of a step.

        Args:
            truth: the true observation [B, V, F].
            attacked: int64 [R], the episodes that were attacked; the others saw the truth.
        """
        others = torch.ones(len(truth), dtype=torch.bool)
        others[attacked] = False
        self.messaging.close(truth, others)
        self.age[others] = 0
        self.repeats[others] = 0
        if self.ghosts is not None:
            self.ghosts[others] = 0.0
        if self.ego is None or self.answer is None:
            self.ego = truth[:, 0].clone()
        else:
            self.ego[others] = truth[others, 0]

    def execute(self, action: Tensor, action_type: ActionType, actions: int) -> Tensor:
        """What the cars execute, where the victim decided on `action` [B] or [B, 2].

        Args:
            action: of the victim.
            action_type: its kind.
            actions: number of discrete actions.

        Raises:
            UserError: if the attack's action is none of the world.
        """
        actuator, forgery = self.threat.actuator, self.answer
        if actuator == NO_ACTUATOR:
            return action
        if actuator.delay:
            self.actions = [action.clone(), *self.actions[: actuator.delay]]
        # In every frame: an attack that answers no action may not keep a coin for later.
        coin = self._tossed() if actuator.replaced else None
        if forgery is None or (forgery.action is None and forgery.shift is None and forgery.delay is None):
            return action
        own, rows = action[self.rows], self.rows
        if forgery.delay is not None and actuator.delay:
            kept = torch.stack(self.actions)[:, rows]
            back = forgery.delay.clamp(max=len(self.actions) - 1)
            own = kept[back, torch.arange(len(rows))]
        if forgery.action is not None:
            theirs = self._theirs(forgery.action, own, actions)
            mixed = own + actuator.noise * (theirs - own) if action_type == "continuous" else own
            replaced = torch.zeros(len(rows), dtype=torch.bool) if coin is None else coin[rows]
            own = torch.where(replaced.view(-1, *[1] * (own.ndim - 1)), theirs, mixed)
        if forgery.shift is not None:
            own = (own + forgery.shift.to(own.dtype).clamp(-actuator.offset, actuator.offset)).clamp(-1.0, 1.0)
        executed = action.clone()
        executed[rows] = own
        return executed

    def _theirs(self, given: Tensor, own: Tensor, actions: int) -> Tensor:
        """The attacker's actions [R] or [R, 2], in the form of the victim's, which stay where it answers none (-1 or NaN)."""
        if given.shape != own.shape:
            raise UserError(f"the attack answered an action of shape {list(given.shape)}, not {list(own.shape)}")
        if own.is_floating_point():
            return torch.where(given.isnan(), own, given.to(own.dtype).clamp(-1.0, 1.0))
        if given.is_floating_point() or bool(((given < -1) | (given >= actions)).any()):
            raise UserError(f"the attack answered an action that is no whole number from 0 to {actions - 1}")
        return torch.where(given < 0, own, given.to(own.dtype))

    def _tossed(self) -> Tensor:
        """[B] whether the attacker's action is executed. Every episode has a coin, whatever the others do."""
        drawn = torch.cat([torch.rand(count, generator=generator) for count, generator in self.coins])
        return drawn < self.threat.actuator.replaced

    def _aged(self, forgery: Forgery, rows: Tensor, name: str) -> Tensor:
        """The frame [R, V, F] that is shown, as it was measured."""
        if forgery.age is None:
            self.age[rows], self.repeats[rows] = 0, 0
            return self.truths[0][rows]
        age = _shaped(forgery.age, rows.shape, "age", name, whole=True).clamp(max=self.elapsed)
        latency, held, before = self.threat.latency, self.threat.held, self.age[rows]
        if bool((age < 0).any()):
            raise UserError(f"{name} showed a frame of the future: age must be at least 0")
        if bool((age > before + 1).any()):
            raise UserError(f"{name} showed an earlier frame after a later one: age grows by at most 1 in a step")
        repeated = age > latency.frames
        self.repeats[rows] = torch.where(repeated, self.repeats[rows] + 1, 0)
        if bool((repeated & ((self.repeats[rows] > held.longest) | (age != before + 1))).any()):
            raise UserError(
                f"{name} showed a frame that is {int(age[repeated].max())} decisions old, the threat model allows "
                f"{latency.frames} (threat.latency.frames) and {held.longest} repetitions in a row (threat.held.longest)"
            )
        self.held[rows] += repeated
        if bool((self.held[rows] > _frames(held.share, self.steps)).any()):
            raise UserError(
                f"{name} held the sensor in more frames than the threat model allows: {held.share:g} of {self.steps} "
                "(threat.held.share)"
            )
        self.age[rows] = self.used.age[rows] = age
        if not bool(age.any()):
            return self.truths[0][rows]
        return torch.stack(self.truths)[age, rows]

    def _hidden(self, forgery: Forgery, base: Tensor, rows: Tensor, name: str) -> Tensor | None:
        if forgery.hidden is None:
            return None
        hidden = _shaped(forgery.hidden, base.shape[:2], "hidden", name)
        if hidden.dtype != torch.bool:
            raise UserError(f"{name} answered hidden as {hidden.dtype}, not as torch.bool")
        if bool(hidden[:, 0].any()):
            raise UserError(f"{name} hid the ego: row 0 cannot be hidden")
        hidden = hidden & (base[..., 0] > 0)
        self._allow(hidden.sum(1), self.threat.presence.hidden, "hid", "hidden", name)
        self.used.hidden[rows] = hidden.sum(1)
        return hidden

    def _invented(self, forgery: Forgery, base: Tensor, rows: Tensor, name: str) -> tuple[Tensor | None, Tensor]:
        """The invented cars [R, K, F] as they are shown, and how far they had to be moved for that [R]."""
        if forgery.invented is None:
            if self.ghosts is not None:
                self.ghosts[rows] = 0.0
            self._driven(base, rows)
            return None, base.new_zeros(len(rows))
        most, slots = self.threat.presence.invented, forgery.invented.shape[1] if forgery.invented.ndim == 3 else 0
        wanted = torch.Size([len(rows), slots, base.shape[-1]])
        cars = _shaped(forgery.invented, wanted, "invented", name).to(base.dtype)
        if not bool(cars.isfinite().all()):
            raise UserError(f"{name} invented cars with NaN or infinite values")
        self._allow((cars[..., 0] > 0).sum(1), most, "invented", "invented", name)
        if self.ghosts is None:
            self.ghosts = base.new_zeros(len(self.age), slots, base.shape[-1])
        if self.ghosts.shape[1] != slots:
            raise UserError(f"{name} invented {slots} cars after {self.ghosts.shape[1]}: absent ones have presence 0")
        ego = base[:, 0]
        before = ego if self.ego is None else self.ego[rows]
        # In the frames that are shown so much time passes.
        passed = self.period * (1 + self.before[rows] - self.age[rows]).to(base.dtype)[:, None]
        shown = invented.plausible(cars, ego, self.ghosts[rows], before, self.features, passed)
        self.ghosts[rows] = shown
        self._driven(base, rows)
        self.used.invented[rows] = (shown[..., 0] > 0).sum(1)
        there = (shown[..., :1] > 0) & (cars[..., :1] > 0)
        beyond = ((shown - cars).abs()[..., 1:] * there).flatten(1).amax(1) if slots else base.new_zeros(len(rows))
        return shown, beyond

    def _driven(self, base: Tensor, rows: Tensor) -> None:
        """Note the ego of the frame that is shown."""
        if self.ego is None:
            self.ego = self.truths[0][:, 0].clone()
        self.ego[rows] = base[:, 0]

    def _allow(self, count: Tensor, most: int, did: str, field: str, name: str) -> None:
        if (worst := int(count.max()) if len(count) else 0) > most:
            raise UserError(
                f"{name} {did} {worst} cars at once, the threat model allows {most} (threat.presence.{field})"
            )

    def _spend(self, rows: Tensor, name: str) -> None:
        """Count the frames in which a car is hidden or invented."""
        self.forged[rows] += (self.used.hidden[rows] + self.used.invented[rows]) > 0
        if bool((self.forged[rows] > _frames(self.threat.presence.share, self.steps)).any()):
            raise UserError(
                f"{name} hid or invented cars in more frames than the threat model allows: "
                f"{self.threat.presence.share:g} of {self.steps} (threat.presence.share)"
            )

    def _commands(self, forgery: Forgery, count: int, name: str) -> Forgery:
        """The commands alone, as copies that nobody else has.

        Raises:
            UserError: if the actuator's set does not allow them.
        """
        actuator = self.threat.actuator
        if forgery.action is not None:
            if not (actuator.noise or actuator.replaced):
                raise UserError(
                    f"{name} answered an action, the threat model allows none (threat.actuator.replaced, .noise)"
                )
            if forgery.action.shape[:1] != (count,) or bool(forgery.action.isinf().any()):
                raise UserError(f"{name} answered an action of shape {list(forgery.action.shape)} for {count} episodes")
        if forgery.shift is not None:
            _shaped(forgery.shift, torch.Size([count, 2]), "shift", name)
            if not bool(forgery.shift.isfinite().all()):
                raise UserError(f"{name} answered a shift that is NaN or infinite")
        if forgery.delay is not None:
            delay = _shaped(forgery.delay, torch.Size([count]), "delay", name, whole=True)
            if bool(((delay < 0) | (delay > actuator.delay)).any()):
                raise UserError(
                    f"{name} delayed a command by {int(delay.max())} decisions, the threat model allows {actuator.delay} "
                    "(threat.actuator.delay)"
                )
        given = {name: getattr(forgery, name) for name in ("action", "shift", "delay")}
        return Forgery(**{name: None if value is None else value.detach().clone() for name, value in given.items()})


def _frames(share: float, steps: int) -> int:
    # A share such as 0.3 is a little below three tenths.
    return math.floor(share * steps + 1e-9)


def _check(forgery: Forgery, name: str) -> None:
    """A subclass of Tensor could change what its methods answer."""
    if type(forgery) is not Forgery:
        raise UserError(f"{name} answered a {type(forgery).__name__}, not a Forgery")
    for item in fields(Forgery):
        value = getattr(forgery, item.name)
        if value is not None and (type(value) is not Tensor or value.is_complex()):
            raise UserError(f"{name} answered {item.name} as a {type(value).__name__}, not as a real torch.Tensor")


def _shaped(value: Tensor, shape: torch.Size, what: str, name: str, *, whole: bool = False) -> Tensor:
    if value.shape != shape:
        raise UserError(f"{name} answered {what} of shape {list(value.shape)}, not {list(shape)}")
    if whole and value.dtype != torch.int64:
        raise UserError(f"{name} answered {what} as {value.dtype}, not as torch.int64")
    return value.detach()
