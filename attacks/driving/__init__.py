"""Attacks on driving policies."""
