#!/usr/bin/env bash
# One guesses: SpeedLimit(...) of lanelet2's Python module, added to a lanelet, is the limit of that lanelet, as one from a file is.
# What happens: it is a TrafficSign that Python calls a SpeedLimit. The traffic rules of Germany do not see it: 100 km/h instead of 30. It is
# written to a file as a traffic sign, so the limit is lost there, too. A tag `speed_limit` on the lanelet, or a file made by hand, has it.
# For whom it matters: in maps that are generated for tests, cars that exceed the limit by 70 km/h obey it.
# Versions: lanelet2 1.2.3 (lanelet2_python, core.cpp: the constructor of SpeedLimit calls TrafficSign::make; GermanVehicle::speedLimit casts).
# Source: limits of generated lanelets, beside those of the same map after it was written and read.
source "$(dirname "$0")/fresh.sh"
fresh lanelet2==1.2.3
see <<'P'
from importlib.metadata import version
from pathlib import Path

from lanelet2 import io, traffic_rules
from lanelet2.core import (
    AttributeMap, Lanelet, LaneletMap, LineString3d, Point3d, SpeedLimit, TrafficSignsWithType, getId,
)
from lanelet2.projection import UtmProjector

rules = traffic_rules.create(traffic_rules.Locations.Germany, traffic_rules.Participants.Vehicle)
projector = UtmProjector(io.Origin(49, 8.4))


def line(y, **tags):
    return LineString3d(getId(), [Point3d(getId(), x, y, 0) for x in (0, 100)], AttributeMap(tags))


def lanelet(**tags):
    border = {"type": "line_thin", "subtype": "solid"}
    road = {"type": "lanelet", "subtype": "road", "location": "nonurban", "one_way": "yes"}
    return Lanelet(getId(), line(3.5, **border), line(0, **border), AttributeMap(road | tags))


def limit(one):
    return round(rules.speedLimit(one).speedLimit)


made = lanelet()
sign = line(-2, type="traffic_sign", subtype="de274-30")
element = SpeedLimit(getId(), AttributeMap(), TrafficSignsWithType([sign], "de274-30"))
made.addRegulatoryElement(element)
assert isinstance(element, SpeedLimit) and element.type() == "de274-30"

whole = LaneletMap()
whole.add(made)
io.write("made.osm", whole, projector)
(read,) = io.load("made.osm", projector).laneletLayer
text = Path("made.osm").read_text()
kind = '<tag k="subtype" v="traffic_sign"/>'.replace("/>", " />")
assert text.count(kind) == 1
Path("by_hand.osm").write_text(text.replace(kind, kind.replace("traffic_sign", "speed_limit")))
(by_hand,) = io.load("by_hand.osm", projector).laneletLayer
seen = {
    "none": limit(lanelet()),
    "SpeedLimit made in Python": limit(made),
    "the same, written and read": limit(read),
    "its file with speed_limit for traffic_sign": limit(by_hand),
    "a tag of the lanelet": limit(lanelet(speed_limit="30")),
}
print(f"lanelet2 {version('lanelet2')}, sign of 30 km/h on a country road, limit in km/h by the rules of Germany: {seen}")
raise SystemExit(list(seen.values()) != [100, 100, 100, 30, 30])
P
