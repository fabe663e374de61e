#!/usr/bin/env bash
# One guesses: TrackEval, trackers and motmetrics count one break (fragmentation) for each pause in which a car on the road is not found.
# What happens: TrackEval, and trackers after it, skip frames in which the tracker reports nothing at all. A pause of such frames is no break,
# and the first match after it prefers the old track, as within a track. One box anywhere else in these frames, and both change.
# For whom it matters: an attack that blinds a detector breaks no track, and hides a switch of identity; one that hides a single car does both.
# Versions: trackeval 1.3.0 (metrics/clear.py, CLEAR.eval_sequence: `continue` before the tracks of the last frame are renewed), trackers 2.6.1
# (eval/clear.py, compute_clear_metrics), motmetrics 1.4.0. Source: one scene of pauses in three libraries, alone and beside a parked car.
source "$(dirname "$0")/fresh.sh"
fresh trackeval==1.3.0 trackers==2.6.1 motmetrics==1.4.0 numpy
see <<'P'
from importlib.metadata import version

import motmetrics
import numpy as np
from trackers.eval import compute_clear_metrics
from trackeval.metrics import CLEAR

# The car has number 1, the parked car 2. A frame lists (track, overlap with the car); the parked car is always found, as track 50.
SEEN, BLIND = [(7, 0.9)], []
PAUSES = [SEEN, SEEN, BLIND, BLIND, SEEN, BLIND, SEEN, SEEN, BLIND, SEEN]
# After the pause track 7 fits the car badly, and a new track 8 fits it well.
OTHER_TRACK = [SEEN, SEEN, BLIND, BLIND, [(7, 0.55), (8, 0.95)], [(7, 0.55), (8, 0.95)]]


def measured(frames, parked):
    """(breaks, switches of identity, MOTA) by each library."""
    truth = [np.array([1, 2] if parked else [1]) for _ in frames]
    tracks = [np.array([track for track, _ in frame] + [50] * parked, int) for frame in frames]
    overlaps = []
    for frame in frames:
        overlap = np.zeros((1 + parked, len(frame) + parked))
        overlap[0, : len(frame)] = [fit for _, fit in frame]
        if parked:
            overlap[1, -1] = 0.9
        overlaps.append(overlap)
    here = compute_clear_metrics(truth, tracks, overlaps)
    names = {track: place for place, track in enumerate(np.unique(np.concatenate(tracks)))}
    there = CLEAR({"PRINT_CONFIG": False}).eval_sequence({
        "gt_ids": [ids - 1 for ids in truth],
        "tracker_ids": [np.array([names[track] for track in ids], int) for ids in tracks],
        "similarity_scores": overlaps,
        "num_gt_ids": 1 + parked,
        "num_tracker_ids": len(names),
        "num_gt_dets": sum(map(len, truth)),
        "num_tracker_dets": sum(map(len, tracks)),
        "num_timesteps": len(frames),
    })
    events = motmetrics.MOTAccumulator(auto_id=True)
    for ids, found, overlap in zip(truth, tracks, overlaps):
        events.update(list(ids), list(found), np.where(overlap < 0.5, np.nan, 1 - overlap))
    wanted = ["num_fragmentations", "num_switches", "mota"]
    last = motmetrics.metrics.create().compute(events, metrics=wanted).iloc[0]
    rows = {
        "trackeval": [there[name] for name in ("Frag", "IDSW", "MOTA")],
        "trackers": [here[name] for name in ("Frag", "IDSW", "MOTA")],
        "motmetrics": [last[name] for name in wanted],
    }
    return {name: (int(breaks), int(switches), round(float(mota), 2)) for name, (breaks, switches, mota) in rows.items()}


seen = {
    name: {"alone": measured(frames, 0), "beside a parked car": measured(frames, 1)}
    for name, frames in {"three pauses": PAUSES, "another track after a pause": OTHER_TRACK}.items()
}
versions = ", ".join(f"{name} {version(name)}" for name in ("trackeval", "trackers", "motmetrics"))
print(f"{versions}: (breaks, switches, MOTA) {seen}")
pauses, other = (seen[name] for name in seen)
raise SystemExit(
    [pauses[where][library][0] for library in ("trackeval", "trackers", "motmetrics") for where in pauses] != [0, 3, 0, 3, 3, 3]
    or [other[where][library][1] for library in ("trackeval", "trackers") for where in other] != [0, 1, 0, 1]
)
P
