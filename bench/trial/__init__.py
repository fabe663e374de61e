"""Tries each network before a run: attacks assume a pure function with gradients, and one that is not would get a wrong score."""
