"""Modes of torch reach nobody: what an attack or a victim switches on changes neither the other, nor what enforces."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from cavbench.driving import Oracle
from cavbench.driving.policy import State
from cavbench.isolation.modes import numbers, put, stacked
from cavbench.isolation.watch import TamperError
from tests.driving.cheats import Victim, drive
from tests.isolation.torch_modes import NUMBERS, STACKED, Left, Mode, leaving


@pytest.fixture(autouse=True)
def _numbers() -> Iterator[None]:
    before = numbers()
    yield
    found = numbers()
    put(before)
    assert found == before


def asks(observation: Tensor, oracle: Oracle) -> None:
    oracle.scores(observation)


@pytest.mark.parametrize("name", STACKED)
def test_a_mode_that_an_attack_leaves_on_is_noticed(name: str) -> None:
    with (
        Left(name) as mode,
        pytest.raises(TamperError, match=f"the attack left {name}: it changes what torch computes") as caught,
    ):
        drive(lambda observation, oracle: mode.enter())
    assert caught.value.sides == ("attack",)


@pytest.mark.parametrize("name", STACKED)
@pytest.mark.parametrize("who", ["attack", "victim", "nobody raises"])
def test_nothing_is_left_for_the_next_unit(name: str, who: str) -> None:
    """Nor where the code that switched it on raises something else."""
    before = stacked()

    class Raises(Victim):
        def scores(self, observation: Tensor, state: State = None) -> Tensor:
            if who == "victim":
                mode.enter()
                raise ZeroDivisionError
            return super().scores(observation, state)

    def deed(observation: Tensor, oracle: Oracle) -> None:
        mode.enter()
        if who == "attack":
            raise ZeroDivisionError

    with Left(name) as mode:
        with pytest.raises(TamperError if who == "nobody raises" else ZeroDivisionError):
            drive(deed if who != "victim" else None, Raises())
        assert stacked() == before


@pytest.mark.parametrize("name", sorted(STACKED.keys() - {"inference mode"}))
def test_a_victim_is_not_asked_under_a_mode_of_the_attack(name: str) -> None:

    def ask(observation: Tensor, oracle: Oracle) -> None:
        mode.enter()
        oracle.scores(observation)

    with Left(name) as mode, pytest.raises(TamperError, match=f"the attack asked under {name}"):
        drive(ask)


def test_a_transform_around_a_question_is_noticed() -> None:
    def ask(observation: Tensor, oracle: Oracle) -> None:
        torch.func.vmap(oracle.scores)(observation.unsqueeze(0))

    with pytest.raises(TamperError, match="the attack asked under a transform"):
        drive(ask)


@pytest.mark.parametrize("name", STACKED)
@pytest.mark.parametrize("where", ["scores", "choose", "advance", "initial", "assured"])
@pytest.mark.parametrize("attacked", [False, True])
def test_a_mode_that_a_victim_leaves_on_is_noticed(name: str, where: str, attacked: bool) -> None:
    with Left(name) as mode, pytest.raises(TamperError, match=f"the defense left {name}") as caught:
        drive(asks if attacked else None, leaving(Victim, where, mode)())
    assert caught.value.sides == ("defense",)


@pytest.mark.parametrize("name", STACKED)
def test_a_mode_that_is_gone_before_the_next_step_is_noticed(name: str) -> None:

    class Between(Victim):
        """Its mode is on from an answer to the next question."""

        def scores(self, observation: Tensor, state: State = None) -> Tensor:
            mode.leave()
            answer = super().scores(observation, state)
            mode.enter()
            return answer

        def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
            mode.leave()
            return super().advance(observation, action, state)

    with Left(name) as mode, pytest.raises(TamperError, match=f"the defense left {name}"):
        drive(None, Between())


class Sees(Victim):
    """Keeps what changes numbers whenever it is asked."""

    seen: ClassVar[set[object]] = set()

    def forward(self, observation: Tensor) -> Tensor:
        self.seen.add(numbers())
        return super().forward(observation)


@pytest.mark.parametrize("change", NUMBERS.values(), ids=NUMBERS)
@pytest.mark.parametrize("asks", [False, True])
def test_what_an_attack_sets_changes_no_answer_of_the_victim(change: Callable[[], object], asks: bool) -> None:
    Sees.seen.clear()
    usual, own = numbers(), []

    def deed(observation: Tensor, oracle: Oracle) -> None:
        change()
        changed = numbers()
        if asks:
            oracle.scores(observation)
            oracle.gradient(observation, lambda scores: own.append(numbers()) or scores.sum(-1))  # type: ignore[func-returns-value]
            own.append(numbers())
            assert {*own} == {changed} != {usual}, "the attack has its own settings back"

    drive(deed, Sees())
    assert Sees.seen == {usual}


@pytest.mark.parametrize("change", NUMBERS.values(), ids=NUMBERS)
def test_what_a_victim_sets_changes_nobody_else(change: Callable[[], object]) -> None:
    seen, usual = set(), numbers()

    class Sets(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            answer = super().forward(observation)
            change()
            return answer

    def deed(observation: Tensor, oracle: Oracle) -> None:
        seen.add(numbers())
        oracle.scores(observation)
        seen.add(numbers())

    drive(deed, Sets())
    assert seen == {usual}


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode, lambda: torch.autocast("cpu")])
def test_attacks_compute_in_modes_of_their_own(mode: Mode) -> None:
    answers: list[Tensor] = []

    def asked(observation: Tensor, oracle: Oracle) -> list[Tensor]:
        return [oracle.scores(observation), *oracle.gradient(observation, lambda scores: scores[..., 0])]

    def deed(observation: Tensor, oracle: Oracle) -> None:
        outside = asked(observation, oracle)
        assert bool(outside[-1].any())
        with mode():
            answers.extend(one - other for one, other in zip(asked(observation, oracle), outside, strict=True))

    drive(deed)
    assert all(bool((one == 0).all()) for one in answers)


def test_an_operator_of_a_library_stays() -> None:
    """Libraries replace operators when they are imported, before a unit begins."""
    with Left("an operator of its own") as library:
        library.enter()
        with_library, other = stacked(), torch.library.Library("aten", "IMPL")

        def deed(observation: Tensor, oracle: Oracle) -> None:
            with warnings.catch_warnings(action="ignore"):
                other.impl("lgamma", lambda values: values * 0, "CPU")

        with pytest.raises(TamperError, match="the attack left an operator of its own"):
            drive(deed)
        assert stacked() == with_library
