"""The columns of episode records: those of all tracks and those of one track. One row is one episode."""

from __future__ import annotations

from collections.abc import Sequence

import pyarrow as pa

from cavbench.core.track import Track

VERSION = "1"
"""Version of the format."""
AUDIT = "audit"
"""`grid` of records on scenarios that were drawn for an audit; no score contains them."""
SEQUENTIAL = "sequential"
"""`grid` of records that were driven in rounds until a score was known (`until=`): their number depends on what they showed."""
TEXT, FLOAT, INT = pa.string(), pa.float64(), pa.int64()
ENCODED = pa.dictionary(pa.int32(), TEXT)
"""Text as it is read: each text once, and a number for each record."""


LARGEST = 1e15
"""No number of a record is larger, unless its column says so."""


def field(
    name: str,
    kind: pa.DataType,
    meaning: str,
    unit: str = "",
    *,
    nullable: bool = False,
    low: float = -LARGEST,
    high: float = LARGEST,
    at_most: str = "",
) -> pa.Field:
    """A column with its unit, its meaning and the numbers that it can hold; records are checked when written and read.

    Args:
        name: of the column.
        kind: type of its values.
        meaning: one line.
        unit: of its values. If it ends with "0 to 1", they lie between 0 and 1.
        nullable: whether values may be missing.
        low: smallest number, or number in a list.
        high: largest number; `math.inf` if it may be infinite.
        at_most: the fact of the world (`world_facts`) that the numbers do not exceed, for instance `max_steps`.
    """
    if unit.endswith("0 to 1"):
        low, high = 0.0, 1.0
    limits = {"low": repr(float(low)), "high": repr(float(high)), "at_most": at_most}
    return pa.field(name, kind, nullable=nullable, metadata={"unit": unit, "meaning": meaning, **limits})


IDENTITY: tuple[pa.Field, ...] = (
    field("unit", TEXT, "fingerprint of the unit of work: sha256 of everything that determines the result"),
    field("pair", TEXT, "the attack, defence, victim, world and threat model: names and a short hash"),
    field("attack", TEXT, "name"),
    field("attack_params", TEXT, "canonical JSON"),
    field("defense", TEXT, "name"),
    field("defense_params", TEXT, "canonical JSON"),
    field("victim", TEXT, "name"),
    field("victim_params", TEXT, "canonical JSON"),
    field("world", TEXT, "name"),
    field("world_params", TEXT, "canonical JSON"),
    field("action_type", TEXT, "driving track: discrete or continuous; otherwise empty"),
    field("sees", pa.bool_(), "false if the victim ignores its input; perceptual axes are then at their first value"),
    field("training_seed", INT, "of the victim and of the attack's preparation; 0 if neither depends on it", low=0),
    field(
        "threat_norm",
        TEXT,
        "name of the perturbation set, and the other sets as +SET.FIELD=VALUE; a clean run has budget 0",
    ),
    field("threat_budget", FLOAT, "size of the perturbation set", "share or normalised, depending on the norm", low=0),
    field("threat_access", TEXT, "highest access allowed to the attacker"),
    field("threat_queries", INT, "query budget of a step or of a patch", "queries", low=0),
    field("threat_share", FLOAT, "share of the frames of an episode that may be attacked", "share, 0 to 1"),
    field(
        "grid", TEXT, "name of the grid; `audit` for scenarios that an audit drew, `sequential` for those of `until=`"
    ),
    field("cell", TEXT, "JSON: the value on each axis of the world"),
    field("world_facts", TEXT, "JSON: axes, decision rate, episode length and actions of the world"),
    field("seed", INT, "scenario seed of the episode", low=0, high=2**53),
)
"""What was evaluated."""

PROVENANCE: tuple[pa.Field, ...] = (
    field("attack_shipped_by", TEXT, "distribution and version"),
    field("defense_shipped_by", TEXT, "distribution and version"),
    field("victim_shipped_by", TEXT, "distribution and version"),
    field("world_shipped_by", TEXT, "distribution and version"),
    field("weights_sha256", TEXT, "of the victim's weights; empty if it has none"),
    field("code_digest", TEXT, "sha256 of the source code that computed it"),
    field(
        "libraries",
        TEXT,
        "JSON: versions of Python, torch, other computing libraries and the libraries of components",
    ),
    field("machine", TEXT, "system, processor and number of cores; if the victim computed on a GPU, which"),
    field("created_at", pa.timestamp("us", tz="UTC"), "time when the unit was finished"),
    field("wall_s", FLOAT, "wall time of the unit with all its episodes", "s", low=0),
)
"""What produced the record, where and when."""


def schema(track: Track) -> pa.Schema:
    """The schema of a track's records; the metadata of each field holds its unit, meaning and range."""
    columns = (*IDENTITY, *track.measurements, *PROVENANCE, *track.probes)
    return pa.schema(columns, metadata={"cavbench": VERSION, "track": track.name})


def written_by(track: Track, found: pa.Schema) -> bool:
    """Whether a file with this schema has records of a track: of now, or from before it had some of its `later` columns.

    These columns are null in such records.
    """
    whole, names = schema(track), set(found.names)
    kept = [one for one in whole if one.name in names or one.name not in track.later]
    return bool(found.equals(pa.schema(kept, metadata=whole.metadata)))


def encoded(track: Track, names: Sequence[str] | None = None) -> pa.Schema:
    """The schema of a track's records as they are read: text is dictionary-encoded.

    Args:
        track: the track.
        names: the columns; None is all.
    """
    whole = schema(track)
    columns = [whole.field(name) for name in (whole.names if names is None else names)]
    return pa.schema(
        [one.with_type(ENCODED) if pa.types.is_string(one.type) else one for one in columns], metadata=whole.metadata
    )


PROBES: tuple[pa.Field, ...] = (
    field(
        "gradient_queries",
        FLOAT,
        "gradients that the attack took: mean per step, or per patch",
        "gradients",
        nullable=True,
        low=0,
    ),
    field(
        "zero_gradients",
        FLOAT,
        "gradients of the attack that were 0 everywhere",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "redrawn",
        FLOAT,
        "probes on which the victim gave different scores to the same input: it is random",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "same_answer",
        FLOAT,
        "probes on which another episode's observation (a grey image) got the same scores",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "draws",
        FLOAT,
        "queries of the attack per observation, if the victim is random",
        "queries",
        nullable=True,
        low=0,
    ),
    field(
        "inconsistent",
        FLOAT,
        "probes on which the victim answered a query otherwise than it acts",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "entropy",
        INT,
        "seed of the moments that were probed, drawn when the unit was driven",
        nullable=True,
        low=0,
        high=2**63,
    ),
)
"""Columns for the flags of a leaderboard; null if not measured. A track that measures them lists them in `probes`."""

NAN_GRADIENTS = field(
    "nan_gradients",
    FLOAT,
    "gradients of the attack with a NaN or infinite entry, which then counted as 0",
    "share, 0 to 1",
    nullable=True,
)
"""A probe of tracks whose attacks take gradients."""
