"""The benchmark from Python: `score`, `load` and `component`, also as `cavbench.score` and so on."""

from bench.api.choosing import component
from bench.api.scoring import load, score

__all__ = ["component", "load", "score"]
