"""cavbench: a benchmark for the adversarial robustness of driving policies and object detectors."""

from bench import shadow

__version__ = "0.1.0"

shadow.check()
