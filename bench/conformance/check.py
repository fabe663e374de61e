"""What a check is, how it ends, and how a suite of them is carried out."""

from __future__ import annotations

import inspect
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from bench.errors import UserError
from bench.plugins.registry import Kind

Status = Literal["pass", "fail", "skip"]
Check = Callable[[], str | None]
"""Returns a remark beside that it passed, or nothing."""


@dataclass(frozen=True)
class Outcome:
    """How a check ended.

    Args:
        check: its name.
        status: pass, fail, or skip where it does not apply.
        text: one line: what to fix, why it does not apply, or a remark.
    """

    check: str
    status: Status
    text: str = ""


class BrokenRuleError(Exception):
    """A rule is broken; the message says in one line which rule and what to do."""


class NotApplicableError(Exception):
    """A check does not apply; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """A component that is checked, with what it is tried together with.

    Args:
        kind: attack, defense, victim or world.
        name: it is registered by.
        component: as it would be used in a run.
        world: that attacks, victims and defences are tried in; None for a world, and for checks that need none.
        victim: that a defence is tried on; of a victim, the victim itself; None for the others.
    """

    kind: Kind
    name: str
    component: Any
    world: Any = None
    victim: Any = None

    def load(self) -> Any:
        """The network of training seed 0 that a victim or a defence loads, made anew.

        Raises:
            UserError: if it is not there.
        """
        if self.kind == "victim":
            return self.component.load(0, self.world.facts)
        return self.component.load(self.victim, 0, self.world.facts)

    def load_victim(self) -> Any:
        """The network of the victim without the defence, made anew."""
        return self.victim.load(0, self.world.facts)


class Suite(ABC):
    """Some checks of a component.

    Args:
        subject: what is checked.
    """

    component: Any

    def __init__(self, subject: Subject) -> None:
        self.subject, self.component = subject, subject.component

    @abstractmethod
    def checks(self) -> Mapping[str, Check]:
        """The checks by name, in order."""

    def outcomes(self) -> Iterator[Outcome]:
        """Carry out every check."""
        for name, check in self.checks().items():
            try:
                yield Outcome(name, "pass", check() or "")
            except BrokenRuleError as failure:
                yield Outcome(name, "fail", one_line(failure))
            except NotApplicableError as reason:
                yield Outcome(name, "skip", one_line(reason))
            # Third-party code may fail in any way; its author is told how and where.
            except Exception as error:
                yield Outcome(name, "fail", f"{type(error).__name__}: {one_line(error)}{self._place(error)}")

    def _place(self, error: Exception) -> str:
        """The line of the component's own file at which it happened; empty if it happened elsewhere."""
        own = inspect.getsourcefile(type(self.component))
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
        return f" ({Path(own).name}, line {lines[-1]})" if own and lines else ""


def require(held: object, complaint: str) -> None:
    """Raise BrokenRuleError with the complaint unless the rule is held."""
    if not held:
        raise BrokenRuleError(complaint)


def one_line(error: Exception) -> str:
    """The first line of an exception's message."""
    return next(iter(str(error).splitlines()), "")


@contextmanager
def refusals_are_broken_rules() -> Iterator[None]:
    """Turn a UserError, by which the framework refuses what a component did, into a broken rule with the same message."""
    try:
        yield
    except UserError as error:
        raise BrokenRuleError(one_line(error)) from None
