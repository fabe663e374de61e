"""The axes of the world of recorded scenes, and its grid."""

from __future__ import annotations

from cavbench.envs.highway.axes import AXES as HIGHWAY
from cavbench.scenarios import Axes, Axis, Grid

SCENES = {
    "us101_23_1": "USA_US101-23_1_T-1.xml",
    "us101_3_1": "USA_US101-3_1_T-1.xml",
    "us101_3_3": "USA_US101-3_3_T-1.xml",
    "lanker_2_23": "USA_Lanker-2_23_T-1.xml",
}
"""The files of the scenes that `bench fetch ngsim` brings."""
OWN = "own"

RECORDED = Axes(
    (
        Axis(
            name="scene",
            kind="str",
            meaning="what was recorded: NGSIM scenes of US-101 and Lankershim Boulevard, or own for the file world.path",
            choices=(*SCENES, OWN),
        ),
        Axis(
            name="traffic",
            kind="str",
            meaning="replay: as recorded; mixed: a car follows IDM as soon as the ego matters to it; reactive: all do",
            choices=("replay", "mixed", "reactive"),
            default="mixed",
        ),
        HIGHWAY["weather"],
    )
)

RECORDED_V1 = Grid(
    name="recorded-v1",
    world="recorded",
    axes=RECORDED,
    values={
        "scene": ("us101_23_1", "us101_3_1", "lanker_2_23"),
        "traffic": ("replay", "mixed"),
        "weather": ("clear", "rain", "fog"),
    },
    episodes=30,
    block=10,
    training_seeds=10,
)
"""The three scenes that last for eight seconds or more, as they were recorded and with cars that react."""
OWN_V1 = Grid(
    name="recorded-own",
    world="recorded",
    axes=RECORDED,
    values={"scene": (OWN,), "traffic": ("replay", "mixed"), "weather": ("clear", "rain", "fog")},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""The same cells of a file of the user's own."""
