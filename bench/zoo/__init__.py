"""The zoo: trained policies and detectors, stored by recipe and training seed."""

from __future__ import annotations

from cavbench.zoo.homes import trained_there
from cavbench.zoo.recipe import Recipe, trained_in, written
from cavbench.zoo.store import card, load, load_part, missing, own, own_files, save, seeds, unfinished

__all__ = [
    "Recipe",
    "card",
    "load",
    "load_part",
    "missing",
    "own",
    "own_files",
    "save",
    "seeds",
    "trained_in",
    "trained_there",
    "unfinished",
    "written",
]
