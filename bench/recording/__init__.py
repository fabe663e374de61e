"""Recordings of single episodes for the rerun viewer: what was there, what the victim was shown, what came of it.

A recording is a view of an episode, never its record: rerun reads the files of neighbouring versions only.
"""
