"""The driving track: driving policies, attacked through their observations. Plug-ins import from here."""

from typing import TYPE_CHECKING

from cavbench.exports import exported

if TYPE_CHECKING:
    from cavbench.driving.contracts import DrivingAttack, DrivingDefense, DrivingVictim, DrivingWorld, TrainingHooks
    from cavbench.driving.dynamics import Dynamics, Forecast
    from cavbench.driving.features import ActionType, Driver, DrivingFacts, Features
    from cavbench.driving.kinematics import Kinematics
    from cavbench.driving.oracle import Oracle, Part, parts_of
    from cavbench.driving.policy import Passed, Policy, PolicyWrapper, State
    from cavbench.driving.threat import ObservationThreat

__all__ = [
    "ActionType",
    "Driver",
    "DrivingAttack",
    "DrivingDefense",
    "DrivingFacts",
    "DrivingVictim",
    "DrivingWorld",
    "Dynamics",
    "Features",
    "Forecast",
    "Kinematics",
    "ObservationThreat",
    "Oracle",
    "Part",
    "Passed",
    "Policy",
    "PolicyWrapper",
    "State",
    "TrainingHooks",
    "parts_of",
]

__getattr__ = exported(
    __name__, __all__, ("contracts", "dynamics", "features", "kinematics", "oracle", "policy", "threat")
)
