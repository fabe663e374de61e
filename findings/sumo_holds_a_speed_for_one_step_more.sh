#!/usr/bin/env bash
# One guesses: setAcceleration(car, 1, duration=2.0) accelerates for 2 s, and then the car is its model's again. So does slowDown.
# What happens: the car has its speed after 2 s, and keeps it for one more step before its model takes over. At steps of 1 s, commands of 1 s
# one after the other hold the car half of the time.
# Versions: libsumo 1.28.0. Source: speeds after commands, at steps of 0.1 and 1 s. Both calls were made between steps.
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
Path("net.edg.xml").write_text('<edges><edge id="ab" from="a" to="b" numLanes="1" speed="30"/></edges>')
made = [f"{sumo.SUMO_HOME}/bin/netconvert", "-n", "net.nod.xml", "-e", "net.edg.xml", "-o", "net.xml"]
subprocess.run(made, check=True, capture_output=True)
Path("cars.xml").write_text('<routes><vType id="car" carFollowModel="IDM" speedFactor="1"/><route id="r" edges="ab"/></routes>')


def held(step, command):
    """How long after a command of 2 s the car has not yet gained speed by itself, in s."""
    libsumo.start(["sumo", "-n", "net.xml", "-r", "cars.xml", "--step-length", str(step), "--no-step-log", "true"])
    libsumo.vehicle.add("x", "r", typeID="car", departPos="10", departSpeed="10")
    libsumo.simulationStep()
    command()
    speeds = []
    for _ in range(round(5 / step)):
        libsumo.simulationStep()
        speeds.append(libsumo.vehicle.getSpeed("x"))
    libsumo.close()
    there = speeds[round(2 / step) - 1]
    return round(sum(abs(speed - there) < 1e-6 for speed in speeds[round(2 / step) :]) * step, 3)


COMMANDS = {
    "setAcceleration": lambda: libsumo.vehicle.setAcceleration("x", -1, 2.0),
    "slowDown": lambda: libsumo.vehicle.slowDown("x", 8, 2.0),
}
seen = {name: {step: held(step, command) for step in (0.1, 1.0)} for name, command in COMMANDS.items()}
print(f"libsumo 1.28.0, seconds for which a speed is held after its time, by the step: {seen}")
raise SystemExit(any(found != {0.1: 0.1, 1.0: 1.0} for found in seen.values()))
P
