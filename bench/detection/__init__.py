"""The detection track: stop-sign detectors, attacked with a patch on the sign. Plug-ins import from here."""

from typing import TYPE_CHECKING

from cavbench.exports import exported

if TYPE_CHECKING:
    from cavbench.detection.access import PatchOracle
    from cavbench.detection.contracts import CameraWorld, DetectorDefense, DetectorVictim, PatchAttack
    from cavbench.detection.detector import STOP_SIGN, Detections, Detector, Objects, Predictions, Wrapped
    from cavbench.detection.filter import ImageFilter
    from cavbench.detection.scenes import Approach, Decoy, Scenes
    from cavbench.detection.threat import PatchThreat

__all__ = [
    "STOP_SIGN",
    "Approach",
    "CameraWorld",
    "Decoy",
    "Detections",
    "Detector",
    "DetectorDefense",
    "DetectorVictim",
    "ImageFilter",
    "Objects",
    "PatchAttack",
    "PatchOracle",
    "PatchThreat",
    "Predictions",
    "Scenes",
    "Wrapped",
]

_MODULES = ("access", "contracts", "detector", "filter", "scenes", "threat")
__getattr__ = exported(__name__, __all__, _MODULES)
