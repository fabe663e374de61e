"""Every built-in driver is loaded, keeps the rules of `bench check`, and decides."""

from __future__ import annotations

from tests.checks.rules import broken, built_in, each

OWN_TESTS = {"sb3", "torch", "onnx"}
"""Drivers that need a file of the user: the tests of their names write one."""
DRIVERS = built_in("victim", "cavbench.driving").keys() - OWN_TESTS


@each(sorted(DRIVERS))
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("victim", name) == {}
