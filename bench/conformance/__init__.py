"""Checks of the rules for components: `bench check NAME`, and `complaints` for the tests of plug-ins."""

from bench.conformance.suites import complaints, examine

__all__ = ["complaints", "examine"]
