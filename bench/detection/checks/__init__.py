"""The kit of the detection track, for `bench check` and `bench new`."""

from __future__ import annotations

from collections.abc import Iterator

from cavbench.checks.check import NotApplicableError, Subject, Suite
from cavbench.checks.kits import Home, Kit, Start


def _attack(subject: Subject) -> Iterator[Suite]:
    from cavbench.detection import PatchAttack
    from cavbench.detection.checks.patch import PatchSuite

    if not isinstance(subject.component, PatchAttack):
        raise NotApplicableError("it is not a PatchAttack: it does not change the sign")
    yield PatchSuite(subject)


def _detector(subject: Subject) -> Iterator[Suite]:
    from cavbench.detection.checks.detector import DetectorSuite

    yield DetectorSuite(subject)


def _world(subject: Subject) -> Iterator[Suite]:
    from cavbench.detection.checks.camera import CameraSuite

    yield CameraSuite(subject)


PLACE = "lanes=3 density=1 weather=clear"
KIT = Kit(
    suites={"attack": _attack, "defense": _detector, "victim": _detector, "world": _world},
    starts={
        "attack": Start(
            run=f"bench run attack={{name}} attack.strength=2 victim=yolov5 {PLACE}", setting="attack.strength=2"
        ),
        "defense": Start(
            run=f"bench run attack=noise_patch defense={{name}} victim=yolov5 {PLACE}", setting="defense.size=5"
        ),
        "victim": Start(run=f"bench run attack=noise_patch victim={{name}} {PLACE}", setting="victim.sharpness=20"),
    },
    package="cavbench.detection.checks",
    homes={
        "attack": Home(
            folder="attacks/detection", package="cavbench.attacks.detection", tests="tests/attacks/detection"
        ),
        "defense": Home(
            folder="defenses/detection", package="cavbench.defenses.detection", tests="tests/defenses/detection"
        ),
        "victim": Home(
            folder="bench/detection/victims", package="cavbench.detection.victims", tests="tests/detection/victims"
        ),
    },
)
