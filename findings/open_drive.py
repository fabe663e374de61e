"""Used by findings about OpenDRIVE: a straight road in the form 1.6, and what netconvert makes of it."""

import os
import subprocess
import xml.etree.ElementTree as ET
from pathlib import Path

import sumo

ROAD = """<?xml version="1.0"?>
<OpenDRIVE><header revMajor="1" revMinor="6"/><road name="r" id="1" junction="-1" length="100" {attributes}><link/>{kind}
<planView><geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry></planView>
<lanes><laneSection s="0">{left}
<center><lane id="0" type="none" level="false"/></center><right>{right}</right></laneSection></lanes>
</road></OpenDRIVE>"""


def lane(number, width=3.5, grows=0.0, limit=""):
    width = f'<width sOffset="0" a="{width}" b="{grows}" c="0" d="0"/>'
    return f'<lane id="{number}" type="driving" level="false">{width}{limit}</lane>'


def lanes(right, left="", kind="", attributes=""):
    """The lanes of SUMO, by their id: all that netconvert says of each, and its first point."""
    Path("road.xodr").write_text(ROAD.format(right=right, left=left, kind=kind, attributes=attributes))
    os.environ["SUMO_HOME"] = sumo.SUMO_HOME
    command = [f"{sumo.SUMO_HOME}/bin/netconvert", "--opendrive", "road.xodr", "-o", "road.net.xml", "--no-warnings"]
    subprocess.run([*command, "--offset.disable-normalization"], check=True, capture_output=True)
    root = ET.parse("road.net.xml").getroot()
    found = {}
    for one in root.iterfind("edge/lane"):
        if not one.get("id").startswith(":"):
            found[one.get("id")] = dict(one.attrib) | {
                "begins": float(one.get("shape").split(",")[0]),
                "lefthand": root.get("lefthand"),
            }
    return found
