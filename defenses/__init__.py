"""Defences of a victim, one file a defence."""
