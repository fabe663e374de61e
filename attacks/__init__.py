"""Attacks on what a victim sees, one file an attack."""
