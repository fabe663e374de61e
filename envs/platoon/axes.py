"""The axes of the world `platoon`, and its grid."""

from __future__ import annotations

from cavbench.scenarios import Axes, Axis, Grid

CYCLES = ("motorway", "stop_and_go", "braking", "wave")
"""Drive cycles of the leader, by number."""
LAST_PLACE = 8

AXES = Axes(
    (
        Axis(
            name="place",
            kind="int",
            meaning="cars ahead of the driven one, the leader included; each of them sends",
            unit="cars",
            low=1,
            high=LAST_PLACE,
        ),
        Axis(name="cycle", kind="str", meaning="drive cycle of the leader", choices=CYCLES),
        Axis(
            name="loss",
            kind="float",
            meaning="share of the messages that the radio loses, each by itself; all followers lose some",
            unit="share",
            low=0.0,
            high=1.0,
            default=0.0,
        ),
    )
)

PLATOON_V1 = Grid(
    name="platoon-v1",
    world="platoon",
    axes=AXES,
    values={"place": (2, 5), "cycle": CYCLES, "loss": (0.0, 0.3)},
    episodes=30,
    block=10,
    training_seeds=10,
)
"""The second and the fifth follower behind four drive cycles, with a good and with a bad radio."""
