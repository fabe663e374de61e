"""The run's own access to the victim: every evaluation is counted, whoever asked for it, and every answer is checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

from cavbench.driving.draws import Draws, fresh, given
from cavbench.driving.policy import Policy, State
from cavbench.driving.threat import finite
from cavbench.errors import UserError
from cavbench.isolation.modes import Modes
from cavbench.isolation.streams import Stream, put_back
from cavbench.isolation.watch import Side, TamperError, Watch

CHUNK = 1024
"""Queries per batch: a larger batch does not fit into the processor's cache and takes twice as long per query."""


def plain(observation: Tensor) -> Tensor:
    """A copy in one layout, whoever asks: neither strides nor storage tell a query from driving."""
    return observation.clone(memory_format=torch.contiguous_format)


class CountedPolicy:
    """A victim as the run holds it; neither attacks nor policies are given this object.

    Driving, queries and probes use the same methods, so that a policy sees the same kind of call. Actions are always `choose` of
    `scores`: a policy cannot drive otherwise than it answers.

    Args:
        policy: the (defended) victim.
        watch: a watch on it; None in trainings and checks.
        stream: random numbers of the attack; None for those of the process.
        numbers: numbers of what the victim draws for each episode; None for the generators of the process.

    `draws` says whether the victim was seen to draw. `shares` says whether it draws from the generators of the process, although
    it was given numbers: they are then exchanged around every query, which takes time.
    """

    def __init__(
        self,
        policy: Policy,
        watch: Watch | None = None,
        stream: Stream | None = None,
        numbers: Draws | None = None,
    ) -> None:
        self.policy, self.watch, self.stream, self._numbers = policy, watch, stream, numbers
        self.action_type = policy.action_type
        self.evaluations = 0
        self.draws = self.shares = False
        self._foreign, self._modes = False, Modes()

    def numbers(self, rows: Tensor | None = None, copies: int = 1) -> Tensor | None:
        """Numbers for the draws of a call, as of `Draws.numbers`; None if the run has none."""
        return self._numbers.numbers(rows, copies) if self._numbers else None

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Run an attack: with its own random numbers, and with an eye on evaluations that it does not ask the oracle for."""
        self._switch(True, self.stream)
        try:
            with self._modes.around("attack"):
                yield
        finally:
            self._switch(False, self.stream)

    @contextmanager
    def asked(self, foreign: bool = False) -> Iterator[None]:
        """Answer a query in the middle of an attack's turn, with the victim's random numbers; `foreign` goes back to the attack.

        Raises:
            TamperError: if the attack has written to the victim's weights, or the victim does so while it answers.
        """
        before = self._foreign
        if before == foreign:
            yield
            return
        self._switch(foreign, self.stream if self.shares else None)
        try:
            with self._modes.for_attack() if foreign else self._modes.for_victim():
                yield
        finally:
            self._switch(before, self.stream if self.shares else None)

    @contextmanager
    def unseen(self) -> Iterator[None]:
        """Ask as a run asks while it drives, and leave no trace: what is drawn in here, from whatever stream, is put back.

        The victim meets the states of the random generators that it meets while it drives: it cannot tell a probe by them.
        """
        with put_back(), nullcontext() if self.stream is None else self.stream.put_back():
            yield

    @contextmanager
    def as_asked(self) -> Iterator[None]:
        """Ask as an attack's query asks: the victim meets the same states of the random generators as in `asked`."""
        with nullcontext() if self.stream is None or self.shares else self.stream.in_use():
            yield

    def _switch(self, foreign: bool, stream: Stream | None) -> None:
        self._foreign = foreign
        if self.watch is not None:
            if self.watch.touched():
                side: Side = "defense" if foreign else "attack"
                raise TamperError(f"the {side} changed the victim's weights", side)
            self.watch.away = foreign
        if stream is not None:
            stream.swap()

    def initial(self, episodes: Tensor) -> State:
        """The policy's state before the first step; `episodes` are opaque numbers."""
        return self._called(self.policy.initial, episodes)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        """The policy's state after a step, as a copy that nobody else has."""
        after = self._called(self.policy.advance, plain(observation), action.clone(), state)
        return None if after is None else after.clone()

    def choose(self, scores: Tensor) -> Tensor:
        """The actions [B] (or [B, 2]) for scores of the policy."""
        return self._called(self.policy.choose, scores)

    def aside(self, observation: Tensor, state: State, numbers: Tensor | None = None) -> Tensor:
        """The scores [B, A], as in `noticed`, and what is drawn is put back."""
        if numbers is None and self._numbers is not None:
            numbers = fresh(len(observation), torch.Generator().manual_seed(0))
        with self.unseen():
            return self.noticed(observation, state, numbers)

    def noticed(self, observation: Tensor, state: State, numbers: Tensor | None = None) -> Tensor:
        """The scores [B, A]; notes in `draws` and `shares` whether random numbers of the process were drawn for them."""
        before = Stream.marks()
        scores = self._scores(plain(observation), state, "while driving", numbers)
        drew = Stream.marks() != before
        self.draws |= drew
        self.shares |= drew
        return scores

    def driven(self, observation: Tensor, state: State, numbers: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The scores [B, A] (or [B, 2]) and the actions with which the victim drives.

        Args:
            observation: [B, V, F].
            state: of these episodes.
            numbers: for its draws, int64 [B]; None for the generators of the process. So in all that asks the victim.

        Raises:
            UserError: if the scores are NaN, infinite or complex.
        """
        scores = self._scores(plain(observation), state, "while driving", numbers)
        return scores, self.choose(scores)

    def decided(self, observation: Tensor, state: State, numbers: Tensor | None = None) -> Tensor:
        """The actions [B] for observations [B, V, F], as in `driven`."""
        return self.choose(self._scores(plain(observation), state, numbers=numbers))

    @torch.no_grad()
    def answered(self, observation: Tensor, state: State, numbers: Tensor | None = None) -> Tensor:
        """The scores of observations [N, V, F], evaluated in batches of at most `CHUNK`."""
        # The policy gets a copy: one that writes to its input would change the attack's points.
        flat = plain(observation)
        if len(flat) <= CHUNK:
            return self._scores(flat, state, numbers=numbers).clone()
        # Parts of the same size: a small rest would cost almost as much as a full batch.
        size = -(-len(flat) // -(-len(flat) // CHUNK))
        parts = flat.split(size)
        states = [None] * len(parts) if state is None else state.split(size)
        own = [None] * len(parts) if numbers is None else numbers.split(size)
        return torch.cat([self._scores(*part[:2], numbers=part[2]) for part in zip(parts, states, own, strict=True)])

    def differentiated(
        self,
        observation: Tensor,
        state: State,
        loss: Callable[[Tensor], Tensor],
        numbers: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The value of `loss` [...] of the scores of observations [N, V, F], and its gradient [N, V, F].

        `loss` gets a copy of the scores as a leaf, so it has no graph that leads into the victim. The gradient of a
        non-differentiable victim is 0.
        """
        asked = observation.detach().clone().requires_grad_(True)
        with torch.enable_grad():
            scores = self._scores(asked, state, numbers=numbers)
            shown = scores.detach().clone().requires_grad_(True)
            value = loss(shown)
            outer = torch.autograd.grad(value.sum(), shown, allow_unused=True)[0] if value.requires_grad else None
        gradient = None
        if outer is not None and scores.requires_grad:
            (gradient,) = self._called(torch.autograd.grad, scores, asked, outer, allow_unused=True)
        return value.detach(), torch.zeros_like(asked).detach() if gradient is None else gradient

    def valued(
        self, observation: Tensor, action: Tensor, state: State, numbers: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        """The critic Q(observation, action) [N], and its gradient [N, 2] in the action; None for discrete actions."""
        self.evaluations += len(observation)
        asked = action.detach().clone()
        if not asked.is_floating_point():
            with given(numbers):
                return self._called(self.policy.value, observation.clone(), asked, state).detach(), None
        asked.requires_grad_(True)
        with torch.enable_grad():
            with given(numbers):
                value = self._called(self.policy.value, observation.clone(), asked, state)
            slope = None
            if value.requires_grad:
                (slope,) = self._called(torch.autograd.grad, value.sum(), asked, allow_unused=True)
        return value.detach(), torch.zeros_like(asked).detach() if slope is None else slope

    def _called(self, work: Callable[..., Any], *given: Any, **named: Any) -> Any:
        """What code of the victim returns; torch's modes are the run's again after it.

        Raises:
            TamperError: if it left a mode on.
        """
        try:
            answer = work(*given, **named)
        except BaseException:
            self._modes.put_back()
            raise
        self._modes.settle("defense")
        return answer

    def _scores(
        self, observation: Tensor, state: State, where: str = "to a query", numbers: Tensor | None = None
    ) -> Tensor:
        """The scores of the policy.

        Raises:
            UserError: if they are NaN or infinite: no attack could choose such a point, so the victim would look robust.
        """
        self.evaluations += len(observation)
        with given(numbers) as found:
            scores = self._called(self.policy.scores, observation, state)
        if found is not None and found.calls:
            self.draws = True
        if type(scores) is not Tensor:
            raise TamperError(f"the victim's scores are a {type(scores).__name__}, not a torch.Tensor", "defense")
        if not finite(scores) and not bool(scores.isfinite().all()):
            raise UserError(f"the victim ({type(self.policy).__name__}) answered NaN or infinite scores {where}")
        if scores.is_complex():
            raise UserError(f"the victim ({type(self.policy).__name__}) answered complex scores")
        return scores
