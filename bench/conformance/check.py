"""What a check is, how it ends, and how a suite of them is carried out."""

from __future__ import annotations

import inspect
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

Status = Literal["pass", "fail", "skip"]
Check = Callable[[], str | None]
"""Returns what is worth knowing beside that it passed, or nothing."""


@dataclass(frozen=True)
class Outcome:
    """How a check ended.

    Args:
        check: what was looked at.
        status: pass, fail, or skip where it does not apply.
        text: one line: what to fix, why it does not apply, or a remark.
    """

    check: str
    status: Status
    text: str = ""


class BrokenRuleError(Exception):
    """A rule is broken; the message says in one line which and what to do."""


class NotApplicableError(Exception):
    """A check does not apply; the message says why."""


class Suite(ABC):
    """The checks of a kind of component.

    Args:
        name: the component is registered by.
        component: as it would be used in a run.
    """

    def __init__(self, name: str, component: Any) -> None:
        self.name, self.component = name, component

    @abstractmethod
    def checks(self) -> Mapping[str, Check]:
        """What is looked at, in order."""

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
        """Where in the component's own file it happened; empty if not in it."""
        own = inspect.getsourcefile(type(self.component))
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == own]
        return f" ({Path(own).name}, line {lines[-1]})" if own and lines else ""


def require(held: object, complaint: str) -> None:
    """Raise BrokenRuleError with the complaint unless the rule is held."""
    if not held:
        raise BrokenRuleError(complaint)


def one_line(error: Exception) -> str:
    """The first line of what an exception says."""
    return next(iter(str(error).splitlines()), "")
