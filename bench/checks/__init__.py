"""Checks of the rules for components: `bench check NAME`, and `complaints` for the tests of plug-ins."""

from cavbench.checks.suites import complaints, examine

__all__ = ["complaints", "examine"]
