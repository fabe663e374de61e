"""Worlds: the environments that victims drive in."""
