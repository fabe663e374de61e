"""Which of our patches stand beside a number of chapter 3 of the thesis, and the command that makes the ones that are missing."""

from __future__ import annotations

import json
import math
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core.registry import Kind
from cavbench.detection.track import DetectionTrack
from cavbench.identity.fingerprint import canonical
from cavbench.leaderboard.comparisons.comparison import IDENTITY, NO_ATTACK, Comparison, parameters
from cavbench.leaderboard.comparisons.reading import SCENARIO, groups, read_comparisons
from cavbench.leaderboard.thesis.shipped import shipped as shipped_records

ATTACK, WORLD, DETECTOR = "eot", "camera", "yolov3_tiny"
COVERS = ("noise_patch", "grey_patch")
"""The thesis' patches that are not optimised."""
CONTROLS = (*COVERS, NO_ATTACK)
WEATHERS = {"sun": "clear", "rain": "rain"}
"""The thesis' and ours."""
LOCATIONS = {1: "sun-behind-ego", 2: "sun-beside", 3: "sun-behind-sign"}
"""The thesis' locations by where the sun is, and ours."""
SIDE = 0.5
"""Of the patch, in shares of the sign's, where a table says nothing else: the default of a threat model."""
VARIED = {
    "texels": 100, "tv": 0.1, "brightness": 0.2, "contrast": 0.2, "saturation": 0.2, "hue": 0.05, "noise": 0.02,
    "perspective": 0.15, "rotation": 8.0, "scale": 0.3, "translation": 0.15,
}  # fmt: skip
"""The attack's parameters that the thesis varies, and their defaults; stated here, as importing the attack imports torch."""
SWITCHED_OFF = (
    "brightness", "contrast", "saturation", "hue", "noise", "perspective", "rotation", "scale", "translation",
)  # fmt: skip
"""The transformations in the order in which the thesis leaves them out; the first four are its colour jitter."""
COLUMNS = (*IDENTITY, *SCENARIO, "world_facts", "weights_sha256", "created_at", "location", "confidence_mean")
"""Of a record that are read here."""


class ByConfidence(DetectionTrack):
    """Ranked by the confidence in the sign alone, as in the thesis, which shows no decoys."""

    metric = "confidence_mean"
    metric_title = "confidence"


@dataclass(frozen=True)
class Configuration:
    """How a patch is crafted.

    Args:
        label: of its row.
        changes: of the attack's parameters from their defaults.
        size: side of the patch in shares of the default one's.
    """

    label: str
    changes: Mapping[str, float] = field(default_factory=dict)
    size: float = 1.0

    @property
    def budget(self) -> float:
        """Side of the patch in shares of the sign's."""
        return SIDE * self.size


def _without(label: str, last: str) -> Configuration:
    off = SWITCHED_OFF[: SWITCHED_OFF.index(last) + 1]
    return Configuration(label, dict.fromkeys(off, 0))


STANDARD = "all_transformations"
ABLATION = {
    STANDARD: Configuration("all transformations"),
    "no_colour_jitter": _without("no colour jitter", "hue"),
    "no_noise": _without(" and no noise", "noise"),
    "no_perspective": _without(" and no perspective", "perspective"),
    "no_rotation": _without(" and no rotation", "rotation"),
    "no_resizing": _without(" and no resizing", "scale"),
    "no_transformations": _without("no transformations", "translation"),
}
CONFIGURATIONS: dict[str, Configuration] = {
    **ABLATION,
    "tv_3": Configuration("3 x total variation", {"tv": 0.3}),
    "tv_5": Configuration("5 x total variation", {"tv": 0.5}),
    "patch_32": Configuration("32 x 32, 0.16 wide", {"texels": 32}, size=0.32),
    "patch_64": Configuration("64 x 64, 0.32 wide", {"texels": 64}, size=0.64),
    "texels_32": Configuration("32 x 32, 0.5 wide", {"texels": 32}),
    "texels_64": Configuration("64 x 64, 0.5 wide", {"texels": 64}),
}
"""The rows of tables 3.1 and 3.2. A smaller patch of the thesis covers less of the sign; the last two are as coarse, but not
smaller."""


@dataclass(frozen=True)
class Detector:
    """What all numbers of a column have in common.

    Args:
        victim: its name.
        victim_params: as in a record.
        world_params: as in a record.
        crafting: the attack's parameters that the thesis does not vary, as canonical JSON.
    """

    victim: str
    victim_params: str
    world_params: str
    crafting: str


@dataclass(frozen=True)
class Found:
    """What stands beside a number of the thesis.

    Args:
        of: a patch, or none at all.
        shipped: whether it is published with the package, not the user's own.
    """

    of: Comparison
    shipped: bool


class Source:
    """The user's own records and, where they have none of the same detector and settings, the published ones.

    Args:
        records: the user's.
        shipped: the published ones; None reads those of the package.
    """

    def __init__(self, records: pa.Table, shipped: pa.Table | None = None) -> None:
        ours = (pc.field("world") == WORLD) & (pc.field("defense") == "none")
        self.track = ByConfidence()
        if shipped is None:
            shipped = shipped_records("patches")
        tables = (records, shipped)
        self.tables = [table.select(COLUMNS).filter(ours) for table in tables]
        self.detectors = _detectors(self.tables)
        self.missing: dict[Detector, set[str]] = {}
        self._read = cache(self._comparisons)

    def find(self, detector: Detector, row: str, weather: str, location: str | None = None) -> Found | None:
        """What was measured of a row; None, and noted as missing, where nothing was.

        Args:
            detector: one of `detectors`.
            row: a key of `CONFIGURATIONS`, or one of `CONTROLS`.
            weather: ours.
            location: ours; None is all of them.
        """
        for shipped in (False, True):
            candidates = [one for one in self._read(detector, weather, shipped) if is_of(row, one.identity)]
            if location is not None:
                candidates = [one.only(seeds=one.places[location]) for one in candidates if location in one.places]
            if candidates:
                found = Found(max(candidates, key=lambda one: one.own.table.num_rows), shipped)
                if found.of.lead is None and row in CONFIGURATIONS:
                    self._note(detector, row)
                return found
        self._note(detector, row)
        return None

    def find_all(
        self, detector: Detector, rows: Iterable[str], weather: str, location: str | None = None
    ) -> dict[str, Found | None]:
        """`find` for the rows of a table: those that are there on the approaches that all of them have, where there are any."""
        found = {row: self.find(detector, row, weather, location) for row in rows}
        there = [each.of.own for each in found.values() if each]
        cells = set.intersection(*(set(own.cells) for own in there)) if there else set()
        seeds = set.intersection(*(set(own.seeds) for own in there)) if there else set()
        if not (cells and seeds):
            return found
        return {row: each and replace(each, of=each.of.only(cells=cells, seeds=seeds)) for row, each in found.items()}

    def _note(self, detector: Detector, row: str) -> None:
        """Note that a row, or a control of it, is missing; controls are part of every run."""
        self.missing.setdefault(detector, set()).add(row if row in CONFIGURATIONS else STANDARD)

    def _comparisons(self, detector: Detector, weather: str, shipped: bool) -> list[Comparison]:
        cells = [
            text
            for text in self.tables[shipped]["cell"].unique().to_pylist()
            if json.loads(text).get("weather") == weather
        ]
        same = pc.field("cell").isin(pa.array(cells, pa.string()))
        for name in ("victim", "victim_params", "world_params"):
            same &= pc.field(name) == getattr(detector, name)
        records = self.tables[shipped].filter(same)
        crafted = {text for text in records["attack_params"].to_pylist() if _crafting(text) == detector.crafting}
        same_crafting = pc.field("attack_params").isin(pa.array(sorted(crafted), pa.string()))
        records = records.filter((pc.field("attack") != ATTACK) | same_crafting)
        return [
            *read_comparisons(records, self.track),
            *read_comparisons(records.filter(pc.field("attack") == NO_ATTACK), self.track),
        ]

    def commands(self) -> list[str]:
        """What to type for everything that was asked for and not found."""
        lines = []
        usual = usual_crafting() if self.missing else None
        for detector, wanted in self.missing.items():
            together: dict[tuple[object, ...], list[Configuration]] = {}
            for row, one in CONFIGURATIONS.items():
                if row in wanted:
                    together.setdefault((*one.changes, one.size), []).append(one)
            lines += [_command(detector, some, usual) for some in together.values()]
        return lines


def is_of(row: str, identity: Mapping[str, object]) -> bool:
    """Whether a pair's identity columns are those of a row, a key of `CONFIGURATIONS` or one of `CONTROLS`."""
    if row == NO_ATTACK:
        return identity["attack"] == NO_ATTACK
    configuration = CONFIGURATIONS.get(row, CONFIGURATIONS[STANDARD])
    if not math.isclose(float(str(identity["threat_budget"])), configuration.budget):
        return False
    if row in COVERS:
        return identity["attack"] == row
    crafted = parameters(identity["attack_params"])
    return identity["attack"] == ATTACK and all(
        crafted.get(name) == configuration.changes.get(name, value) for name, value in VARIED.items()
    )


def _detectors(tables: Iterable[pa.Table]) -> list[Detector]:
    """Of every victim what most of its records share: the user's where there are any, else the published ones."""
    found: dict[str, Detector] = {}
    for table in tables:
        rows: Counter[Detector] = Counter()
        columns = ("victim", "victim_params", "world_params", "attack_params")
        for identity, some in groups(table, columns, pc.equal(table["attack"], ATTACK)):
            victim, victim_params, world_params, attack = (str(identity[name]) for name in columns)
            rows[Detector(victim, victim_params, world_params, _crafting(attack))] += some.num_rows
        for detector, _ in rows.most_common():
            found.setdefault(detector.victim, detector)
    if not found:
        victim, world, attack = _standard("victim", DETECTOR), _standard("world", WORLD), _standard("attack", ATTACK)
        return [Detector(DETECTOR, victim, world, _crafting(attack))]
    return [found[name] for name in sorted(found)]


def _standard(kind: Kind, name: str) -> str:
    """The default parameters of a component."""
    # Imported here: torch takes seconds, and whoever has all the records needs no component.
    from cavbench.core.pair import choose

    return choose(kind, name).params


def _crafting(attack_params: str) -> str:
    return canonical({name: value for name, value in parameters(attack_params).items() if name not in VARIED})


def usual_crafting() -> str | None:
    """The attack's default parameters as in the published records, most of which were run with them; None without any."""
    records = shipped_records("patches")
    counts = records.filter(pc.field("attack") == ATTACK)["attack_params"].value_counts()
    most = max(counts.to_pylist(), key=lambda one: one["counts"], default=None)
    return _crafting(most["values"]) if most else None


def _command(detector: Detector, configurations: list[Configuration], usual: str | None) -> str:
    words = [f"attack={ATTACK}", f"victim={detector.victim}", f"weather={','.join(WEATHERS.values())}", "seeds=0,1,2"]
    for kind, text in (("victim", detector.victim_params), ("world", detector.world_params)):
        words += [f"{kind}.{name}={value}" for name, value in parameters(text).items() if value not in ("", None)]
    if detector.crafting != usual:
        defaults = parameters(_standard("attack", ATTACK))
        words += [f"attack.{name}={v}" for name, v in parameters(detector.crafting).items() if v != defaults.get(name)]
    first = configurations[0]
    for name in first.changes:
        words.append(f"attack.{name}={','.join(f'{one.changes[name]:g}' for one in configurations)}")
    if first.size != 1:
        words.append(f"threat.budget={first.budget:g}")
    return shlex.join(["bench", "run", *words])
