"""Defences of detectors."""
