"""Hashes of what a result depends on: configuration, code, content."""
