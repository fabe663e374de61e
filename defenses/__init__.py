"""Defences of a victim, one file per defence."""
