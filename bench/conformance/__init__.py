"""The rules that every component keeps, as checks: `bench check NAME`, and `complaints` for a plug-in's own tests."""

from bench.conformance.suites import complaints, examine

__all__ = ["complaints", "examine"]
