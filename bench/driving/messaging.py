"""Enforces the set `messages`: composes the messages that a victim is shown, and remembers what it was told."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cavbench.driving.features import Features
from cavbench.driving.forgery import Forgery
from cavbench.driving.sets import Messages
from cavbench.errors import UserError

NEEDED = ("x", "vx", "ax", "age")


class Messaging:
    """The messages of B episodes from their start.

    A message that was not received, because the radio lost it or the attacker held it back, leaves the last one that was shown,
    seen from where the ego is now, and older by one decision.

    Args:
        threat: the set.
        features: features of the observation.
        period: seconds between decisions.
        steps: decisions of a full episode.
        batch: B.
    """

    def __init__(self, threat: Messages, features: Features, period: float, steps: int, batch: int) -> None:
        self.threat, self.features, self.period = threat, features, period
        self.allowed = threat.senders > 0 and features.messages > 0
        self.first = features.messages
        if not self.allowed:
            return
        self.columns = [1 + features.names.index(name) for name in NEEDED]
        self.half = features.half_range()[[column - 1 for column in self.columns]]
        self.most = math.floor(threat.dropped * steps + 1e-9)
        self.drops = torch.zeros(batch, dtype=torch.int64)
        self.owned = torch.zeros(batch, 0, dtype=torch.bool)
        self.truths: list[Tensor] = []
        self.ways: list[Tensor] = []
        self.shown: Tensor | None = None

    def see(self, truth: Tensor) -> None:
        """Note the true observation of a step, [B, V, F], and how far the ego has come."""
        if not self.allowed:
            return
        way = torch.zeros(len(truth), dtype=torch.float64)
        if self.truths:
            # The speed changes evenly within a decision.
            mean = (self._speed(truth) + self._speed(self.truths[0])).double() / 2
            way = self.ways[0] + mean * self.period
        else:
            self.owned = torch.zeros(truth.shape[:2], dtype=torch.bool)
        kept = self.threat.delay + 1
        self.truths, self.ways = [truth.clone(), *self.truths[:kept]], [way, *self.ways[:kept]]

    def tell(
        self, forgery: Forgery, shown: Tensor, age: Tensor, rows: Tensor, name: str
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the victim is shown [R, V, F], how far the messages had to be moved [R], and the number of senders used [R].

        Args:
            forgery: the attack's answer.
            shown: the observation with what is forged besides, [R, V, F].
            age: of the frame, int64 [R]; messages can be forged in the newest frame only.
            rows: the episodes.

        Raises:
            UserError: if the answer is more than the set allows.
        """
        given = (forgery.messages, forgery.content, forgery.dropped)
        if any(one is not None for one in given) and bool(age.any()):
            raise UserError(f"{name} forged messages in an old frame: threat.messages needs the newest one (age 0)")
        content, dropped = self._content(forgery, shown, name), self._dropped(forgery, shown, rows, name)
        true = self._aged(content, rows)
        false, excess = self._forged(forgery, true, name)
        received = (shown[..., 0] > 0) & (shown[..., self.columns[3]] <= -1 + 1e-6)
        received[:, : self.first] = False
        differs = (false != shown).any(-1) & received
        wanted = (content > 0) | dropped | (false != true).any(-1)
        touched = wanted & (differs | dropped)
        self._own(wanted & received, rows, name)
        fresh = torch.where((touched & ~dropped).unsqueeze(-1), false, shown)
        # What an owned sender said last is what is left of it.
        missing = self.owned[rows] & (dropped | ~received)
        missing[:, : self.first] = False
        told = torch.where(missing.unsqueeze(-1), self._left(rows), fresh) if self.shown is not None else fresh
        if self.shown is None:
            told = torch.where((missing & dropped).unsqueeze(-1), torch.zeros_like(told), told)
        self._keep(told, rows)
        return told, excess, touched.sum(1)

    def left(self, rows: Tensor) -> Tensor:
        """int64 [R] frames in which messages may still be held back."""
        return self.most - self.drops[rows] if self.allowed else torch.zeros_like(rows)

    def close(self, truth: Tensor, others: Tensor) -> None:
        """End the showing of a step: the episodes `others`, bool [B], saw the truth."""
        if self.allowed:
            self._keep(truth[others], others.nonzero().squeeze(-1))

    def _keep(self, told: Tensor, rows: Tensor) -> None:
        if self.shown is None:
            self.shown = self.truths[0].clone()
        self.shown[rows] = told

    def _own(self, used: Tensor, rows: Tensor, name: str) -> None:
        """Note whose messages were touched.

        Raises:
            UserError: if they are too many.
        """
        self.owned[rows] |= used
        count = int(self.owned[rows].sum(1).max()) if len(rows) else 0
        if count > self.threat.senders:
            raise UserError(
                f"{name} forged messages of {count} senders in an episode, the threat model allows {self.threat.senders} "
                "(threat.messages.senders)"
            )

    def _content(self, forgery: Forgery, shown: Tensor, name: str) -> Tensor:
        """int64 [R, V] how old the content of each message is."""
        if forgery.content is None:
            return torch.zeros(shown.shape[:2], dtype=torch.int64)
        content = _answered(forgery.content, torch.int64, shown, f"{name} answered content")
        if len(content) and (int(content.min()) < 0 or int(content.max()) > self.threat.delay):
            raise UserError(
                f"{name} repeated a message after {int(content.max())} decisions, the threat model allows 0 to "
                f"{self.threat.delay} (threat.messages.delay)"
            )
        content = content.clamp(max=len(self.truths) - 1)
        content[:, : self.first] = 0
        return content

    def _dropped(self, forgery: Forgery, shown: Tensor, rows: Tensor, name: str) -> Tensor:
        """bool [R, V] which messages are held back."""
        if forgery.dropped is None:
            return torch.zeros(shown.shape[:2], dtype=torch.bool)
        dropped = _answered(forgery.dropped, torch.bool, shown, f"{name} answered dropped").clone()
        dropped[:, : self.first] = False
        self.drops[rows] += dropped.any(1)
        if bool((self.drops[rows] > self.most).any()):
            raise UserError(
                f"{name} held messages back in more frames than the threat model allows: {self.threat.dropped:g} of a full "
                "episode (threat.messages.dropped)"
            )
        return dropped

    def _aged(self, content: Tensor, rows: Tensor) -> Tensor:
        """[R, V, F] the true messages with content of some decisions ago, told as fresh and seen from here."""
        true = self.truths[0][rows].clone()
        if not bool(content.any()):
            return true
        x, vx, _, age = self.columns
        places = torch.arange(content.shape[1])
        old = torch.stack(self.truths)[content, rows[:, None], places]
        speeds = torch.stack([self._speed(one) for one in self.truths])
        ways = torch.stack(self.ways)
        since = ways[0][rows][:, None] - ways[content, rows[:, None]]
        slower = speeds[0][rows][:, None] - speeds[content, rows[:, None]]
        old[..., x] -= (since / self.half[0]).to(old.dtype)
        old[..., vx] -= slower / self.half[1]
        # Its time stamp is that of the message that it takes the place of.
        old[..., age] = true[..., age]
        there = (old[..., 0] > 0) & (content > 0)
        return torch.where(there.unsqueeze(-1), old.clamp(-1.0, 1.0), true)

    def _forged(self, forgery: Forgery, true: Tensor, name: str) -> tuple[Tensor, Tensor]:
        """The false messages in their bounds around the true content, and how far they had to be moved [R]."""
        if forgery.messages is None:
            return true, true.new_zeros(len(true))
        given = forgery.messages.detach().to(true.dtype)
        if given.shape != true.shape:
            raise UserError(f"{name} answered messages of shape {list(given.shape)}, not {list(true.shape)}")
        if bool(given.isinf().any()):
            raise UserError(f"{name} answered messages that are infinite")
        given = torch.where(given.isnan(), true, given)
        bounds = torch.tensor([self.threat.position, self.threat.speed, self.threat.acceleration]) / self.half[:3]
        radius = torch.zeros(true.shape[-1])
        radius[self.columns[:3]] = bounds
        inside = given.clamp(true - radius, true + radius).clamp(-1.0, 1.0)
        sends = (true[..., 0] > 0) & (torch.arange(true.shape[1]) >= self.first)
        false = torch.where(sends.unsqueeze(-1), inside, true)
        away = (given - false).abs() * sends.unsqueeze(-1)
        return false, away.flatten(1).amax(1)

    def _left(self, rows: Tensor) -> Tensor:
        """[R, V, F] what was shown last, seen from here and one decision older; nothing where it is too old."""
        assert self.shown is not None
        x, vx, _, age = self.columns
        left, now = self.shown[rows].clone(), self.truths[0]
        before = self.truths[1] if len(self.truths) > 1 else now
        way = self.ways[0] - (self.ways[1] if len(self.ways) > 1 else self.ways[0])
        left[..., x] -= (way[rows] / self.half[0]).to(left.dtype)[:, None]
        left[..., vx] -= ((self._speed(now) - self._speed(before))[rows] / self.half[1])[:, None]
        left[..., age] += self.period / self.half[3]
        gone = (left[..., 0] <= 0) | (left[..., age] > 1 + 1e-4)
        return left.clamp(-1.0, 1.0).masked_fill(gone.unsqueeze(-1), 0.0)

    def _speed(self, observation: Tensor) -> Tensor:
        """[B] speed of the ego in m/s."""
        return observation[:, 0, self.columns[1]] * self.half[1]


def _answered(given: Tensor, dtype: torch.dtype, shown: Tensor, what: str) -> Tensor:
    """One value for each row of the observations `shown` [R, V, F].

    Raises:
        UserError: if it has another type or shape; the line begins with `what`.
    """
    if given.shape != shown.shape[:2] or given.dtype != dtype:
        raise UserError(
            f"{what} as {given.dtype} of shape {list(given.shape)}, not {dtype} of shape {list(shown.shape[:2])}"
        )
    return given.detach()
