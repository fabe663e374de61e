#!/usr/bin/env bash
# One guesses: a road of OpenDRIVE with rule="LHT" (left-hand traffic) is driven on the left in SUMO.
# What happens: the attribute is not read. Lanes with negative numbers go along the road, those with positive numbers against it, as with "RHT".
# So all traffic of such a file drives in the wrong direction.
# Versions: SUMO 1.28.0. Source: one road with both rules of OpenDRIVE 1.6.
source "$(dirname "$0")/fresh.sh"
fresh eclipse-sumo==1.28.0
see <<'P'
from open_drive import lane, lanes

seen = {}
for rule in ("RHT", "LHT"):
    found = lanes(lane(-1), left=f"<left>{lane(1)}</left>", attributes=f'rule="{rule}"')
    seen[rule] = {name: (one["begins"], one["lefthand"]) for name, one in found.items()}
print(f"SUMO 1.28.0, x where a lane begins, and the left-hand flag of the net: {seen}")
raise SystemExit(seen["RHT"] != seen["LHT"] or seen["LHT"]["-1_0"] != (0.0, None))
P
