"""Attacks on detectors: patches on the sign."""
