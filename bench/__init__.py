"""cavbench: a benchmark for the adversarial robustness of driving policies and object detectors.

`score`, `attack`, `load`, `component` and `detector` are the benchmark from Python; `gym` has its gymnasium environments, and the
`RobustEval…` classes log scores during a training. They are imported when they are first used, because torch takes seconds.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import cavbench.gym as gym
    from cavbench.api import attack, component, detector, load, score
    from cavbench.api.robust_eval import RobustEvalHook
    from cavbench.api.sb3_callback import RobustEvalCallback
    from cavbench.errors import UserError

__version__ = "0.1.0"
__all__ = [
    "RobustEvalCallback",
    "RobustEvalHook",
    "UserError",
    "__version__",
    "attack",
    "component",
    "detector",
    "gym",
    "load",
    "score",
]

_FROM = {
    **dict.fromkeys(("attack", "component", "detector", "load", "score"), "cavbench.api"),
    "RobustEvalCallback": "cavbench.api.sb3_callback",
    "RobustEvalHook": "cavbench.api.robust_eval",
    "UserError": "cavbench.errors",
}


def __getattr__(name: str) -> Any:
    if name in _FROM:
        return getattr(import_module(_FROM[name]), name)
    if name == "gym":
        return import_module("cavbench.gym")
    raise AttributeError(f"module 'cavbench' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
