"""What a run must reach so that a job of a continuous integration passes: the options `fail_below`, `against` and `junit`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cavbench.errors import UserError
from cavbench.files import check_folder


@dataclass(frozen=True, kw_only=True)
class Gates:
    """The gates of a run.

    Args:
        fail_below: the lowest score that each pair must have; None for any.
        against: results folder whose pairs must not be significantly better; None for none.
        junit: file for the JUnit XML; None for none.

    Raises:
        ValueError: if a number is out of range.
    """

    fail_below: float | None = None
    against: Path | None = None
    junit: Path | None = None

    def __post_init__(self) -> None:
        if self.fail_below is not None and not 0 < self.fail_below <= 1:
            raise ValueError(f"fail_below must be a score above 0 and at most 1, got {self.fail_below:g}")

    def __bool__(self) -> bool:
        return self.fail_below is not None or self.against is not None or self.junit is not None

    def check(self, out: Path) -> None:
        """Refuse, before anything is driven, what cannot be read or written.

        Args:
            out: results folder of the run.

        Raises:
            UserError: says what it is.
        """
        if self.against is not None:
            if not self.against.is_dir():
                raise UserError(f"against={self.against} is no folder: give the results folder of an earlier run")
            if self.against.resolve() == out.resolve():
                raise UserError(f"against={self.against} is the folder that this run writes: choose another with out=")
        if self.junit is not None:
            if self.junit.is_dir():
                raise UserError(f"junit={self.junit} is a folder: name a file, for instance junit=report.xml")
            check_folder(self.junit.parent, "the folder of junit=", "junit")
