#!/usr/bin/env bash
# One guesses: a hard shoulder of OpenDRIVE carries no traffic in SUMO. Its lane type is `stop`, for emergency stops on motorways.
# What happens: `shoulder`, a soft shoulder, is left out; `stop` is a lane for all at full speed. As cars keep right, they drive on it: half of the
# cars of a motorway of two lanes.
# For whom it matters: a scene with one lane more has other gaps, and room to escape to that the real road forbids.
# Versions: SUMO 1.28.0 (data/typemap/opendriveNetconvert.typ.xml, `stop`; import by NIImporter_OpenDrive).
# Source: the lanes of one road for each lane type of OpenDRIVE 1.6, and where the cars of SUMO drive on them.
source "$(dirname "$0")/fresh.sh"
fresh eclipse-sumo==1.28.0 libsumo==1.28.0
see <<'P'
import os
import subprocess
import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import sumo

os.environ["SUMO_HOME"] = sumo.SUMO_HOME
import libsumo

WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'
Path("cars.xml").write_text(
    '<routes><vType id="car"/><flow id="f" type="car" from="-1" to="-1" begin="0" end="300" period="2" departLane="best" departSpeed="10"/></routes>'
)


def motorway(shoulder):
    """A straight motorway of two lanes and a shoulder on the right: whom each lane is for, and the share of the traffic on each."""
    lanes = "".join(
        f'<lane id="{-i}" type="{kind}" level="false">{WIDTH}</lane>' for i, kind in enumerate(("driving", "driving", shoulder), 1)
    )
    Path("road.xodr").write_text(
        '<?xml version="1.0"?><OpenDRIVE><header revMajor="1" revMinor="6"/><road name="r" id="1" junction="-1" length="2000"><link/>'
        '<type s="0" type="motorway"/><planView><geometry s="0" x="0" y="0" hdg="0" length="2000"><line/></geometry></planView>'
        '<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>'
        f"<right>{lanes}</right></laneSection></lanes></road></OpenDRIVE>"
    )
    command = [f"{sumo.SUMO_HOME}/bin/netconvert", "--opendrive", "road.xodr", "-o", "net.xml", "--no-warnings"]
    subprocess.run(command, check=True, capture_output=True)
    speeds = [float(lane.get("speed")) for lane in ET.parse("net.xml").getroot().iterfind("edge/lane")]
    libsumo.start(["sumo", "-n", "net.xml", "-r", "cars.xml", "--no-step-log", "true", "--no-warnings", "true"])
    seen = Counter()
    for _ in range(300):
        libsumo.simulationStep()
        seen.update(libsumo.vehicle.getLaneIndex(car) for car in libsumo.vehicle.getIDList())
    libsumo.close()
    return speeds, {index: round(seen[index] / seen.total(), 2) for index in sorted(seen)}


seen = {kind: motorway(kind) for kind in ("shoulder", "stop")}
print(f"SUMO 1.28.0, limits of the lanes from the right in m/s, and the share of the cars on each: {seen}")
raise SystemExit(
    not (len(seen["shoulder"][0]) == 2 and len(set(seen["stop"][0])) == 1 and len(seen["stop"][0]) == 3 and seen["stop"][1][0] > 0.4)
)
P
