"""The benchmark from Python: `score`, `load` and `component`, also as `cavbench.score` and so on."""

from cavbench.api.choosing import component
from cavbench.api.scoring import load, score

__all__ = ["component", "load", "score"]
