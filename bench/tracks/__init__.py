"""The tracks that ship with the benchmark, found by their entry points like any other."""
