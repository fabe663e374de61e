"""The tracks that ship with cavbench, found by their entry points like all others."""
