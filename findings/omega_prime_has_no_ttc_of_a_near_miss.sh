#!/usr/bin/env bash
# One guesses: the time to collision (TTC) of omega-prime is that of each moment at which the ego comes closer, from bumper to bumper, 0 at contact.
# What happens: a row needs a moment, within 2 s by default, at which the other's box lies where the ego's is now. A standing car that the ego
# stops for has no row, whatever this time is, and one that it hits has its first row at contact. The distance is that of the centres, so this
# first TTC grows with the length.
# For whom it matters: the closest near miss leaves no trace in a minimum of TTC, and a crash into a truck has 0.5 s left at contact.
# Versions: omega-prime 0.3.7 (metrics/analysis/timegaps.py, timegaps_and_min_timegaps; ttc_and_thw.py, ttc_and_thw), polars 1.44.2.
# Source: recordings of one approach, with and without braking, beside the TTC by its definition.
source "$(dirname "$0")/fresh.sh"
fresh omega-prime==0.3.7 polars==1.44.2 numpy
see <<'P'
from importlib.metadata import version

import numpy as np
import omega_prime
import polars
from omega_prime.metrics import MetricManager

STEP, LENGTH, START = 0.1, 4.5, 60.0
TIMES = np.arange(0, 8, STEP)
STILL = {"z": 0.0, "vel_y": 0.0, "vel_z": 0.0, "acc_x": 0.0, "acc_y": 0.0, "acc_z": 0.0, "roll": 0.0, "pitch": 0.0, "yaw": 0.0}


def approach(braking, length, ahead_speed, **options):
    """TTC by time of a car at 20 m/s behind one of `length` at `ahead_speed`, START m from bumper to bumper: (by definition, by omega-prime)."""
    # The ego brakes as soon as it must, to stop 1 m behind the other.
    speed, place, ego = 20.0, 0.0, []
    for _ in TIMES:
        ego.append((place, speed))
        if braking and speed**2 / 2 / 8.0 >= START - 1.0 - place:
            speed = max(speed - 8.0 * STEP, 0.0)
        place += speed * STEP
    x, speeds = np.array(ego).T
    other = START + LENGTH / 2 + length / 2 + ahead_speed * TIMES
    frames = [
        {"total_nanos": round(time * 1e9), "idx": idx, "x": at, "y": 0.0, "vel_x": v, "length": size, "width": 2.0, "height": 1.5,
         "type": 2, "subtype": 4, "role": 1} | STILL
        for idx, places, velocities, size in ((0, x, speeds, LENGTH), (1, other, 0 * x + ahead_speed, length))
        for time, at, v in zip(TIMES, places, velocities)
    ]
    gap = other - x - (LENGTH + length) / 2
    closing = (speeds > ahead_speed) & (gap >= 0)
    defined = dict(zip(TIMES[closing].round(1).tolist(), (gap / np.where(closing, speeds - ahead_speed, 1))[closing].round(2).tolist()))
    _, tables = MetricManager().compute(omega_prime.Recording(df=polars.DataFrame(frames), validate=True), ego_id=0, **options)
    rows = tables["ttc_and_thw"].filter(polars.col("TTC").is_not_null()).sort("total_nanos_ego")
    return defined, {round(nanos / 1e9, 1): round(ttc, 2) for nanos, ttc in zip(rows["total_nanos_ego"], rows["TTC"])}


def least(ttc):
    return min(ttc.values(), default=None)


CASES = {
    "stops before a standing car": (True, 4.5, 0.0),
    "hits a standing car": (False, 4.5, 0.0),
    "hits a standing truck of 16.5 m": (False, 16.5, 0.0),
    "hits a car at 10 m/s": (False, 4.5, 10.0),
}
seen = {}
for name, options in CASES.items():
    defined, told = approach(*options)
    first = min(told, default=None)
    seen[name] = {"definition": (len(defined), least(defined)), "omega-prime": (len(told), first, told.get(first))}
print(f"omega-prime {version('omega-prime')}: by definition (moments with a TTC, the least), by omega-prime (moments, the first, its TTC): {seen}")
_, whenever = approach(*CASES["stops before a standing car"], time_buffer=1e12)
stops, car, truck, moving = seen.values()
raise SystemExit(
    not 0 < stops["definition"][1] < 0.2
    or stops["omega-prime"] != (0, None, None)
    or whenever
    or [one["definition"] for one in (car, truck)] != [(31, 0.0)] * 2
    or [one["omega-prime"][1:] for one in (car, truck)] != [(3.0, 0.23), (3.0, 0.53)]
    or not moving["omega-prime"][1] > 3.5
)
P
