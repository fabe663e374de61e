#!/usr/bin/env bash
# One guesses: to_zarr(append_dim="episode") of xarray adds rows by the names of the other axis, as concat and arithmetic do, or refuses another
# order. And it refuses rates for a variable of integers, as it refuses longer texts.
# What happens: columns are taken by place, and the names of the last rows are written over those of all rows: old results get other names.
# Rates are rounded to 0 or 1, booleans become True, and int8 wraps around. Texts raise. The one warning speaks of NaN.
# For whom it matters: `pgd`, which crashed every episode, has crashed none after a run that lists its attacks in another order.
# Versions: xarray 2026.9.0 (backends/zarr.py, ZarrStore.store and _validate_datatypes_for_zarr_append), zarr 3.1.6. The names are told in
# xarray's issue 11101. Source: records of two runs appended in two orders, beside concat.
source "$(dirname "$0")/fresh.sh"
fresh xarray==2026.9.0 zarr==3.1.6 numpy
see <<'P'
import shutil

import numpy as np
import xarray
import zarr


def appended(first, then):
    """Both datasets in one store, as it is read again, or the error."""
    shutil.rmtree("runs.zarr", ignore_errors=True)
    first.to_zarr("runs.zarr", consolidated=False)
    try:
        then.to_zarr("runs.zarr", append_dim="episode", consolidated=False)
    except ValueError as error:
        return str(error).split(" for ")[0]
    return xarray.open_zarr("runs.zarr", consolidated=False).load()


def crashes(rows, attacks):
    return xarray.Dataset({"crashed": (("episode", "attack"), np.array(rows))}, coords={"attack": attacks})


def column(first, then):
    read = appended(*(xarray.Dataset({"value": ("episode", values)}) for values in (first, then)))
    return read if isinstance(read, str) else read.value.values[len(first) :].tolist()


old, new = crashes([[0, 1], [0, 1]], ["noise", "pgd"]), crashes([[1, 0]], ["pgd", "noise"])
named = {"in zarr": appended(old, new), "by concat": xarray.concat([old, new], "episode", join="outer")}
pgd = {name: [int(one) for one in found.crashed.sel(attack="pgd").values] for name, found in named.items()}
types = {
    "rates to integers": column(np.array([0, 1]), np.array([0.4, 0.6])),
    "rates to booleans": column(np.array([False, True]), np.array([0.4, 0.0])),
    "300 to int8": column(np.array([1], np.int8), np.array([300])),
    "a longer text": column(np.array(["pgd"]), np.array(["rehearse"])),
}
print(f"xarray {xarray.__version__}, zarr {zarr.__version__}: crashes of pgd, which crashed 3 of 3: {pgd}; what was appended: {types}")
raise SystemExit(
    pgd != {"in zarr": [0, 0, 1], "by concat": [1, 1, 1]}
    or types != {"rates to integers": [0, 1], "rates to booleans": [True, False], "300 to int8": [44], "a longer text": "Mismatched dtypes"}
)
P
