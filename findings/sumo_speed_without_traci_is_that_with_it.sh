#!/usr/bin/env bash
# One guesses: getSpeedWithoutTraCI is the speed that the car would drive if setSpeed, slowDown and setAcceleration had not been called, as
# its documentation says. So the difference to getSpeed is what a controller took from the model.
# What happens: under all three commands it is the commanded speed, to the last bit. A car beside it, without a command, drives the other one.
# Versions: libsumo 1.28.0. Source: measuring by how much an attacker's commands differ from the car-following model.
source "$(dirname "$0")/fresh.sh"
fresh eclipse-sumo==1.28.0 libsumo==1.28.0
see <<'P'
import os
import subprocess
from pathlib import Path

import sumo

os.environ["SUMO_HOME"] = sumo.SUMO_HOME
import libsumo

Path("net.nod.xml").write_text('<nodes><node id="a" x="0" y="0"/><node id="b" x="2000" y="0"/></nodes>')
Path("net.edg.xml").write_text('<edges><edge id="ab" from="a" to="b" numLanes="2" speed="30"/></edges>')
made = [f"{sumo.SUMO_HOME}/bin/netconvert", "-n", "net.nod.xml", "-e", "net.edg.xml", "-o", "net.xml"]
subprocess.run(made, check=True, capture_output=True)
car = '<vType id="car" carFollowModel="IDM" speedFactor="1" speedDev="0"/>'
Path("cars.xml").write_text(f'<routes>{car}<route id="r" edges="ab"/></routes>')
COMMANDS = {
    "setSpeed": lambda: libsumo.vehicle.setSpeed("told", 10),
    "slowDown": lambda: libsumo.vehicle.slowDown("told", 10, 5),
    "setAcceleration": lambda: libsumo.vehicle.setAcceleration("told", -2, 5),
}


def seen(command):
    """After a step under a command: the speed, that without TraCI, and the speed of a car beside it without a command."""
    libsumo.start(["sumo", "-n", "net.xml", "-r", "cars.xml", "--step-length", "0.1", "--no-step-log", "true"])
    for lane, name in enumerate(("told", "free")):
        libsumo.vehicle.add(name, "r", typeID="car", departPos="50", departSpeed="20", departLane=str(lane))
    libsumo.simulationStep()
    command()
    libsumo.simulationStep()
    asked = (libsumo.vehicle.getSpeed("told"), libsumo.vehicle.getSpeedWithoutTraCI("told"), libsumo.vehicle.getSpeed("free"))
    libsumo.close()
    return asked


found = {name: seen(command) for name, command in COMMANDS.items()}
shown = {name: tuple(round(speed, 2) for speed in speeds) for name, speeds in found.items()}
print(f"libsumo 1.28.0: speed, without TraCI, and of a free car beside it: {shown}")
raise SystemExit(any(told != without or free < 20.1 for told, without, free in found.values()))
P
