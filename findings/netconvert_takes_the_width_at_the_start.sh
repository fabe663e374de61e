#!/usr/bin/env bash
# One guesses: a lane of OpenDRIVE that grows from 2 to 4 m is as wide in SUMO as it is in the mean, or is cut into pieces.
# What happens: it is 2 m wide all along, and one that shrinks from 4 to 2 m is 4 m wide. Their middles are shifted with it.
# Versions: SUMO 1.28.0. Source: lanes of one section whose width is a polynomial.
source "$(dirname "$0")/fresh.sh"
fresh eclipse-sumo==1.28.0
see <<'P'
from open_drive import lane, lanes

ROADS = {"from 2 to 4 m": (2, 0.02), "from 4 to 2 m": (4, -0.02)}
seen = {name: [one.get("width") for one in lanes(lane(-1, *road)).values()] for name, road in ROADS.items()}
print(f"SUMO 1.28.0: widths of a lane {seen}")
raise SystemExit(seen != {"from 2 to 4 m": ["2.00"], "from 4 to 2 m": ["4.00"]})
P
