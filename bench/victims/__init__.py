"""Victims: the driving policies and object detectors that are attacked, and the baseline drivers."""
