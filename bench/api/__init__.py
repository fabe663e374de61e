"""The benchmark from Python: `score`, `load`, `component` and `detector`, also as `cavbench.score` and so on."""

from cavbench.api.choosing import component
from cavbench.api.scoring import load, score
from cavbench.detection.victims.in_process import detector

__all__ = ["component", "detector", "load", "score"]
