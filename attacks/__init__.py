"""Attacks on a victim's input, one file per attack."""
