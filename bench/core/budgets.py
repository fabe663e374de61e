"""The budget of a threat model as a user writes it: 0.1, or in per cent, 10%."""

from __future__ import annotations

import re
from typing import Any, TypeVar

from cavbench.core.contracts import ThreatModel
from cavbench.errors import UserError, short

PER_CENT = re.compile(r"\d+(\.\d*)?|\.\d+")
T = TypeVar("T", bound=ThreatModel)


def read(given: Any) -> tuple[Any, bool]:
    """The budget that was given, and whether it was given in per cent, so that no number is taken for another.

    Raises:
        UserError: if what stands before the per cent sign is no number.
    """
    if not isinstance(given, str) or not given.strip().endswith("%"):
        return given, False
    number = given.strip().removesuffix("%").strip()
    if not PER_CENT.fullmatch(number):
        raise UserError(f"threat.budget must be a number, such as 0.1, or per cent, such as 10%, got {short(given)}")
    # 10 % is 0.1 to the last digit, which the division of floating-point numbers does not promise for all.
    return float(f"{number}e-2"), True


def checked(threat: T, *, confirmed: bool = False, python: bool = False) -> T:
    """The threat model, if its budget is no slip of the pen or was `confirmed` in per cent.

    Args:
        threat: the threat model.
        confirmed: whether its budget was given in per cent.
        python: whether the message is for the caller of a Python function.

    Raises:
        UserError: asks which budget is meant.
    """
    if confirmed or not (slip := threat.slip()):
        return threat
    small, large = (f"{number:g}%" for number in (threat.budget, 100 * threat.budget))
    meant, stress = (f'threat={{"budget": "{each}"}}' if python else f"threat.budget={each}" for each in (small, large))
    raise UserError(f"{slip}: write {meant} for {small.removesuffix('%')} %, or {stress} if you mean that")
