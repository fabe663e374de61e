#!/usr/bin/env bash
# One guesses: SUMO drives a road of an OpenDRIVE file at the speed limit of its <type>, which is where most files have it.
# What happens: only the <speed> of a lane is read, in all units. That of the road is left out without a word, and all its lanes have
# 13.89 m/s (50 km/h), motorways too.
# Versions: SUMO 1.28.0. Source: limits of 50 mph, 80 km/h and 20 m/s at both places.
source "$(dirname "$0")/fresh.sh"
fresh eclipse-sumo==1.28.0
see <<'P'
from open_drive import lane, lanes

SPEED = '<speed {}max="{}" unit="{}"/>'
LIMITS = (50, "mph"), (80, "km/h"), (20, "m/s")


def limits(**road):
    return [float(one["speed"]) for one in lanes(**road).values()]


by_road = [limits(right=lane(-1), kind=f'<type s="0" type="motorway">{SPEED.format("", *one)}</type>') for one in LIMITS]
by_lane = [limits(right=lane(-1, limit=SPEED.format('sOffset="0" ', *one))) for one in LIMITS]
print(f"SUMO 1.28.0, limits {LIMITS}: at the road {by_road}, at the lane {by_lane} m/s")
raise SystemExit(by_road != [[13.89]] * 3 or by_lane != [[22.35], [22.22], [20.0]])
P
