"""Every built-in detector is loaded, keeps the rules of `bench check`, and detects."""

from __future__ import annotations

from tests.checks.rules import broken, built_in, each

OWN_TESTS = {"detector", "tfjs"}
"""They need a file of the user: test_from_file.py and test_tfjs.py write some."""
DETECTORS = built_in("victim", "cavbench.detection").keys() - OWN_TESTS


@each(sorted(DETECTORS))
def test_it_keeps_the_rules(name: str) -> None:
    assert broken("victim", name) == {}
