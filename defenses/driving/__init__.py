"""Defences of driving policies."""
