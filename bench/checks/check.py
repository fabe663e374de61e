"""Checks, their outcomes, and suites of checks."""

from __future__ import annotations

import inspect
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from cavbench.core.registry import Kind
from cavbench.errors import UserError

Status = Literal["pass", "fail", "skip", "doubt"]
Check = Callable[[], str | None]
"""Returns a remark or None if the check passes; raises otherwise."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a check.

    Args:
        check: name of the check.
        status: pass, fail, skip if it does not apply, or doubt if only its author can say whether it is right.
        text: one line: what to fix, why it does not apply, what to look at, or a remark.
    """

    check: str
    status: Status
    text: str = ""


class BrokenRuleError(Exception):
    """A rule is broken; the message says in one line which one, and what to fix."""


class DoubtError(Exception):
    """What a check found may be wrong; the arguments are one line each."""


class NotApplicableError(Exception):
    """A check does not apply; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A component to check, with the world and the victim to check it with.

    Args:
        kind: attack, defense, victim or world.
        name: registered name.
        component: the instance to check.
        world: world to check in; None if a world is checked, and for checks that need none.
        victim: victim of a defence or of an attack that learns, or the checked victim itself; None for worlds and other attacks.
    """

    kind: Kind
    name: str
    component: Any
    world: Any = None
    victim: Any = None

    def load(self) -> Any:
        """Load the network of training seed 0 of a victim or a defence.

        Raises:
            UserError: if it does not exist.
        """
        if self.kind == "victim":
            return self.component.load(0, self.world.facts)
        return self.component.load(self.victim, 0, self.world.facts)

    def load_victim(self) -> Any:
        """Load the network of the victim without the defence."""
        return self.victim.load(0, self.world.facts)


class Suite(ABC):
    """A group of checks for a component.

    Args:
        subject: the component to check.
    """

    component: Any

    def __init__(self, subject: Subject) -> None:
        self.subject, self.component = subject, subject.component

    @abstractmethod
    def checks(self) -> Mapping[str, Check]:
        """The checks by name, in order."""

    def outcomes(self) -> Iterator[Outcome]:
        """Run every check."""
        for name, check in self.checks().items():
            try:
                yield Outcome(name, "pass", check() or "")
            except BrokenRuleError as failure:
                yield Outcome(name, "fail", one_line(failure))
            except DoubtError as doubt:
                yield from (Outcome(name, "doubt", line) for line in doubt.args)
            except NotApplicableError as reason:
                yield Outcome(name, "skip", one_line(reason))
            # Third-party code may raise anything: tell its author what, and where.
            except Exception as error:
                yield Outcome(name, "fail", f"{type(error).__name__}: {one_line(error)}{self._place(error)}")

    def _place(self, error: Exception) -> str:
        """The line of the component's file that raised the error; empty if the error is from another file."""
        file = inspect.getsourcefile(type(self.component))
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        return f" ({Path(file).name}, line {lines[-1]})" if file and lines else ""


def require(condition: object, complaint: str) -> None:
    """Raise BrokenRuleError with the complaint unless `condition` is true."""
    if not condition:
        raise BrokenRuleError(complaint)


def one_line(error: Exception) -> str:
    """The first line of an exception's message."""
    return next(iter(str(error).splitlines()), "")


@contextmanager
def refusals_are_broken_rules() -> Iterator[None]:
    """Convert a UserError, with which the framework refuses what a component did, to a BrokenRuleError."""
    try:
        yield
    except UserError as error:
        raise BrokenRuleError(one_line(error)) from None
