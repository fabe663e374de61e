#!/usr/bin/env bash
# One guesses: a straight OpenDRIVE road of 100 m with a lane of 3.5 m has these lengths as a CommonRoad lanelet; a geoReference moves it.
# What happens: with a geoReference the points are projected to pseudo-Mercator, whose metres are longer away from the equator: 149 m and
# 5.24 m at a latitude of 48 degrees. Speed limits and cars keep their sizes. Without a geoReference the sizes are kept.
# Versions: commonroad-scenario-designer 0.8.5 with its default configuration. Source: one map read by it and by SUMO's netconvert.
source "$(dirname "$0")/fresh.sh"
fresh commonroad-scenario-designer==0.8.5 commonroad-io==2024.3
see <<'P'
from pathlib import Path

import numpy as np
from crdesigner.map_conversion.map_conversion_interface import opendrive_to_commonroad

PLACE = "<geoReference><![CDATA[+proj=tmerc +lat_0=48 +lon_0=11 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m]]></geoReference>"
ROAD = """<?xml version="1.0"?>
<OpenDRIVE><header revMajor="1" revMinor="6" name="a" version="1" date="2026" north="0" south="0" east="0" west="0">{place}</header>
<road name="r" id="1" junction="-1" length="100"><link/>
<planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>
<right><lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right></laneSection></lanes>
</road></OpenDRIVE>"""


def size(place):
    """Length and width of the one lanelet, in m."""
    Path("road.xodr").write_text(ROAD.format(place=place))
    (lanelet,) = opendrive_to_commonroad(Path("road.xodr")).lanelet_network.lanelets
    width = np.linalg.norm(lanelet.left_vertices - lanelet.right_vertices, axis=1).mean()
    return round(float(lanelet.distance[-1]), 1), round(float(width), 2)


plain, placed = size(""), size(PLACE)
print(f"commonroad-scenario-designer 0.8.5: length and width of a road of 100 m and 3.5 m: {plain}, at 48 degrees north {placed}")
raise SystemExit((plain, placed) != ((100.0, 3.5), (149.2, 5.24)))
P
