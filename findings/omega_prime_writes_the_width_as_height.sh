#!/usr/bin/env bash
# One guesses: a recording of omega-prime has its sizes in a file of OSI (MCAP) as it has them in Parquet.
# What happens: each object of the OSI file is as high as it is wide. A cyclist of 1.75 m is 0.5 m high, a truck of 4 m is 2.5 m. All other
# numbers are kept, and nothing is said. Parquet keeps the height.
# For whom it matters: a sensor model that replays the trace has a cyclist below its beams or behind a car. A detector that misses it looks
# weak.
# Versions: omega-prime 0.3.7 (recording.py, get_moving_object_ground_truth: get_object takes the width twice), betterosi 0.9.0.
# mcap-protobuf-support 0.6.0 reads the file by the schema within it. Source: one recording in both formats, in two readers.
source "$(dirname "$0")/fresh.sh"
fresh omega-prime==0.3.7 polars==1.44.2 betterosi==0.9.0 mcap==1.6.0 mcap-protobuf-support==0.6.0 numpy
see <<'P'
from importlib.metadata import version

import omega_prime
import polars
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

NUMBERS = ("x", "y", "z", "vel_x", "vel_y", "vel_z", "acc_x", "acc_y", "acc_z", "roll", "pitch", "yaw")
SIZES = ("length", "width", "height")
# Length, width, height; type, subtype and role of OSI.
OBJECTS = {"car": (4.5, 1.8, 1.5, 2, 4, 1), "truck": (12.0, 2.5, 4.0, 2, 6, 1), "cyclist": (1.8, 0.5, 1.75, 2, 10, 1)}

rows = [
    {"total_nanos": step * 10**8, "idx": idx} | {name: step + place / 8 for place, name in enumerate(NUMBERS[:9])}
    | {"roll": 0.125, "pitch": 0.25, "yaw": 0.5} | dict(zip((*SIZES, "type", "subtype", "role"), values))
    for idx, values in enumerate(OBJECTS.values())
    for step in range(3)
]
recording = omega_prime.Recording(df=polars.DataFrame(rows), validate=True)
recording.to_file("trace.mcap")
recording.to_parquet("trace.parquet")


def read(path):
    """Sizes of each object, and the largest change of any other number."""
    table = omega_prime.Recording.from_file(path).df.sort("idx", "total_nanos")
    change = max(float((table[name] - polars.DataFrame(rows)[name]).abs().max()) for name in NUMBERS)
    return {kind: table.filter(polars.col("idx") == idx).select(SIZES).row(0) for idx, kind in enumerate(OBJECTS)}, change


def read_without():
    with open("trace.mcap", "rb") as stream:
        _, _, _, truth = next(iter(make_reader(stream, decoder_factories=[DecoderFactory()]).iter_decoded_messages()))
    boxes = {one.id.value: one.base.dimension for one in truth.moving_object}
    return {kind: tuple(round(getattr(boxes[idx], name), 6) for name in SIZES) for idx, kind in enumerate(OBJECTS)}


right = {kind: values[:3] for kind, values in OBJECTS.items()}
wide = {kind: (length, width, width) for kind, (length, width, _) in right.items()}
parquet, (osi, change), other = read("trace.parquet"), read("trace.mcap"), read_without()
print(f"omega-prime {version('omega-prime')}: (length, width, height) {right}; read from Parquet: {parquet[0]}; from OSI: {osi}, another reader: "
      f"{other}; largest change of other numbers in OSI: {change:.0e}")
raise SystemExit(parquet != (right, 0.0) or (osi, other) != (wide, wide) or change > 1e-6)
P
