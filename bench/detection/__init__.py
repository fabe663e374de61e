"""The detection track: stop-sign detectors, attacked with a patch on the sign. Plug-ins import from here."""

from bench.detection.contracts import CameraWorld, DetectorDefense, DetectorVictim, PatchAttack
from bench.detection.detector import STOP_SIGN, Detections, Detector, Objects, Predictions, Wrapped
from bench.detection.oracle import PatchOracle
from bench.detection.scenes import Approach, Decoy, Scenes
from bench.detection.threat import PatchThreat

__all__ = [
    "STOP_SIGN",
    "Approach",
    "CameraWorld",
    "Decoy",
    "Detections",
    "Detector",
    "DetectorDefense",
    "DetectorVictim",
    "Objects",
    "PatchAttack",
    "PatchOracle",
    "PatchThreat",
    "Predictions",
    "Scenes",
    "Wrapped",
]
