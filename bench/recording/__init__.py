"""Recordings of single episodes for the rerun viewer: the true input, the attacked input and the outcome.

A recording does not replace the episode's record: rerun reads only files of neighbouring versions.
"""
