"""The driving track: driving policies, attacked through their observations. Plug-ins import from here."""

from typing import TYPE_CHECKING

from cavbench.exports import exported

if TYPE_CHECKING:
    from cavbench.driving.access import Oracle
    from cavbench.driving.contracts import DrivingAttack, DrivingDefense, DrivingVictim, DrivingWorld, TrainingHooks
    from cavbench.driving.dynamics import Dynamics, Forecast
    from cavbench.driving.features import ActionType, Control, Driver, DrivingFacts, Features
    from cavbench.driving.filter import ObservationFilter
    from cavbench.driving.forgery import Forgery, composed
    from cavbench.driving.kinematics import Kinematics
    from cavbench.driving.parts import Part, parts_of
    from cavbench.driving.policy import Passed, Policy, PolicyWrapper, State, Suspicion
    from cavbench.driving.threat import ObservationThreat

__all__ = [
    "ActionType",
    "Control",
    "Driver",
    "DrivingAttack",
    "DrivingDefense",
    "DrivingFacts",
    "DrivingVictim",
    "DrivingWorld",
    "Dynamics",
    "Features",
    "Forecast",
    "Forgery",
    "Kinematics",
    "ObservationFilter",
    "ObservationThreat",
    "Oracle",
    "Part",
    "Passed",
    "Policy",
    "PolicyWrapper",
    "State",
    "Suspicion",
    "TrainingHooks",
    "composed",
    "parts_of",
]

_MODULES = (
    "access",
    "contracts",
    "dynamics",
    "features",
    "filter",
    "forgery",
    "kinematics",
    "parts",
    "policy",
    "threat",
)
__getattr__ = exported(__name__, __all__, _MODULES)
