"""The benchmark from Python: `score`, `attack`, `load`, `component` and `detector`, also as `cavbench.score` and so on."""

from cavbench.api.attacking import attack
from cavbench.api.choosing import component
from cavbench.api.scoring import load, score
from cavbench.detection.victims.in_process import detector

__all__ = ["attack", "component", "detector", "load", "score"]
