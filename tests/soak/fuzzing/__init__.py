"""Fuzzing of every reader of foreign files: changed valid files are read, or refused in one line, within limits."""
