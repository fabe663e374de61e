"""Bad input of the user ends scripts in one line; faults of the code keep their traceback."""

from __future__ import annotations

import pytest

from cavbench.errors import UserError, in_one_line


def test_a_script_ends_in_one_line_where_the_user_is_wrong() -> None:
    with pytest.raises(SystemExit) as ended, in_one_line():
        raise UserError("unknown victim 'nonsense'; known: dqn\nmore")
    assert ended.value.code == "error: unknown victim 'nonsense'; known: dqn"


def test_a_fault_of_the_code_is_not_hidden() -> None:
    with pytest.raises(ZeroDivisionError), in_one_line():
        raise ZeroDivisionError
