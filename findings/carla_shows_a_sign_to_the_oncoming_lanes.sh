#!/usr/bin/env bash
# One guesses: a sign with orientation "+", which OpenDRIVE defines as valid for traffic in the direction of the road, is seen by the cars that
# drive in this direction. Without a <validity> it holds for all of their lanes. scenariogeneration writes it so.
# What happens: CARLA gives a sign without <validity> to the lanes of the other direction. With a <validity> it does not look at the orientation.
# For whom it matters: a stop sign or a limit is seen by oncoming cars only; a car that runs it counts as one that had no sign.
# Versions: carla 0.9.16 (the client; LibCarla, road/MapBuilder.cpp, GenerateDefaultValiditiesForSignalReferences), scenariogeneration 0.16.7
# (xodr/signals_objects.py, Signal). Source: a road that one library writes, read by the other; ASAM OpenDRIVE 1.6, signals, for the orientation.
source "$(dirname "$0")/fresh.sh"
fresh carla==0.9.16 scenariogeneration==0.16.7 numpy
see <<'P'
from importlib.metadata import version
from pathlib import Path

import carla
from scenariogeneration import xodr

FORWARD, BACKWARD = ("lane -1", "lane -2"), ("lane 1",)


def lanes_that_see(orientation, kind="274", validity=None):
    """The driving lanes of a road of 100 m from which a sign in its middle is a landmark ahead."""
    road = xodr.create_road(xodr.Line(100), id=1, left_lanes=1, right_lanes=2)
    dynamic = xodr.Dynamic.yes if kind == "1000001" else xodr.Dynamic.no
    sign = xodr.Signal(s=50, t=-8, country="DE", Type=kind, subtype="50", value=50, unit="km/h", orientation=orientation, dynamic=dynamic)
    if validity:
        sign.add_validity(*validity)
    road.add_signal(sign)
    made = xodr.OpenDrive("road")
    made.add_road(road)
    made.adjust_roads_and_lanes()
    made.write_xml("road.xodr")
    read = carla.Map("road", Path("road.xodr").read_text())
    starts = {-1: 10.0, -2: 10.0, 1: 90.0}
    return tuple(f"lane {lane}" for lane, s in starts.items() if read.get_waypoint_xodr(1, lane, s).get_landmarks(80.0))


kinds = {"limit": "274", "stop": "206", "light": "1000001"}
seen = {name: {"+": lanes_that_see(xodr.Orientation.positive, kind), "-": lanes_that_see(xodr.Orientation.negative, kind)} for name, kind in kinds.items()}
told = [lanes_that_see(orientation, validity=(-2, -1)) for orientation in (xodr.Orientation.positive, xodr.Orientation.negative)]
print(f"carla {version('carla')}, scenariogeneration {version('scenariogeneration')}: lanes -1 and -2 drive along the road, 1 against it; without "
      f"<validity> they see {seen}; with a <validity> from -2 to -1, orientation + and -: {told}", flush=True)
raise SystemExit(any(one != {"+": BACKWARD, "-": FORWARD} for one in seen.values()) or told != [FORWARD, FORWARD])
P
