"""The driving track: driving policies, attacked through their observations. Plug-ins import from here."""

from bench.driving.contracts import DrivingAttack, DrivingDefense, DrivingVictim, DrivingWorld, TrainingHooks
from bench.driving.dynamics import Dynamics, Forecast
from bench.driving.features import ActionType, Driver, DrivingFacts, Features
from bench.driving.kinematics import Kinematics
from bench.driving.oracle import Oracle, Part, parts_of
from bench.driving.policy import Passed, Policy, PolicyWrapper, State
from bench.driving.threat import ObservationThreat

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
