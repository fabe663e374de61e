#!/usr/bin/env bash
# One guesses: with models without errors (sigma 0, speedDev 0) a seed changes nothing, and crossings with no road in common do not
# know each other: the cars of one drive alike whatever drives at the others.
# What happens: so it is where a road has priority and with allway_stop. With right_before_left three cars that meet drive differently with
# another seed, and when cars drive at 69 other crossings: its junctions draw random numbers, of a few generators that all of them share.
# Versions: libsumo 1.28.0. Source: an episode that depended on how many others were driven beside it.
source "$(dirname "$0")/fresh.sh"
fresh eclipse-sumo==1.28.0 libsumo==1.28.0
see <<'P'
import os
import subprocess
from pathlib import Path

import sumo

os.environ["SUMO_HOME"] = sumo.SUMO_HOME
import libsumo

SIDES = {"w": (-300, 0), "e": (300, 0), "s": (0, -300), "n": (0, 300)}
CARS = (("s", "n", 240.3, 11.6), ("e", "w", 249.5, 10.4), ("n", "e", 252.7, 11.5))
"""From where to where, how far from the stop line in m, and how fast in m/s; those of the other crossings are 40 m nearer."""


def network(kind):
    """Seventy crossings of a kind, 5 km apart."""
    nodes, edges = [], []
    for at in range(70):
        nodes.append(f'<node id="c{at}" x="{5000 * at}" y="0" type="{kind}"/>')
        for side, (x, y) in SIDES.items():
            nodes.append(f'<node id="{side}{at}" x="{5000 * at + x}" y="{y}"/>')
            across = 2 if kind == "priority" and side in "sn" else 1
            edges.append(f'<edge id="in_{side}{at}" from="{side}{at}" to="c{at}" priority="{across}"/>')
            edges.append(f'<edge id="out_{side}{at}" from="c{at}" to="{side}{at}" priority="{across}"/>')
    Path("n.nod.xml").write_text(f"<nodes>{''.join(nodes)}</nodes>")
    Path("n.edg.xml").write_text(f"<edges>{''.join(edges)}</edges>")
    made = [f"{sumo.SUMO_HOME}/bin/netconvert", "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", f"{kind}.net.xml"]
    subprocess.run(made, check=True, capture_output=True)


def driven(kind, crossings, seed=1):
    """Where the cars of the first crossing are, second by second."""
    cars = "".join(
        f'<vType id="t{at}.{side}" sigma="0" speedDev="0" maxSpeed="{speed}"/><trip id="{at}.{side}" type="t{at}.{side}" '
        f'from="in_{side}{at}" to="out_{end}{at}" depart="0" departPos="-{before - 40 * (at > 0):g}" departSpeed="{speed}"/>'
        for at in crossings
        for side, end, before, speed in CARS
    )
    Path("cars.xml").write_text(f"<routes>{cars}</routes>")
    libsumo.start(["sumo", "-n", f"{kind}.net.xml", "-r", "cars.xml", "--seed", str(seed), "--step-length", "0.5", "--no-step-log", "true"])
    places = []
    for _ in range(120):
        libsumo.simulationStep()
        names = sorted(name for name in libsumo.vehicle.getIDList() if name.startswith("0."))
        places.append([(name, libsumo.vehicle.getPosition(name)) for name in names])
    libsumo.close()
    return places


seen = {}
for kind in ("priority", "allway_stop", "right_before_left"):
    network(kind)
    alone = driven(kind, (0,))
    seen[kind] = {
        "again": alone == driven(kind, (0,)),
        "with other seeds": all(alone == driven(kind, (0,), seed) for seed in (2, 3, 4)),
        "beside others": alone == driven(kind, range(70)),
    }
print(f"libsumo 1.28.0, whether the cars of a crossing drive as they did alone: {seen}")
raise SystemExit([tuple(found.values()) for found in seen.values()] != [(True, True, True), (True, True, True), (True, False, False)])
P
