"""The columns of episode records: what every track has, and those of one track. One row is an episode."""

from __future__ import annotations

import pyarrow as pa

from bench.plugins.track import Track

VERSION = "2"
"""Of the format: 1 had a column for lanes, density and weather each, 2 has `cell` and `world_facts`."""
TEXT, FLOAT, INT = pa.string(), pa.float64(), pa.int64()


def field(name: str, kind: pa.DataType, meaning: str, unit: str = "", *, nullable: bool = False) -> pa.Field:
    """A column, with its unit and meaning. A share says "0 to 1" in its unit, and is checked to be one."""
    return pa.field(name, kind, nullable=nullable, metadata={"unit": unit, "meaning": meaning})


IDENTITY: tuple[pa.Field, ...] = (
    field("unit", TEXT, "fingerprint of the unit of work: sha256 of everything that decides the result"),
    field("pair", TEXT, "the attack, defence, victim, world and threat model: names and a short hash"),
    field("attack", TEXT, "name"),
    field("attack_params", TEXT, "canonical JSON"),
    field("defense", TEXT, "name"),
    field("defense_params", TEXT, "canonical JSON"),
    field("victim", TEXT, "name"),
    field("victim_params", TEXT, "canonical JSON"),
    field("world", TEXT, "name"),
    field("world_params", TEXT, "canonical JSON"),
    field("action_type", TEXT, "of the driving track: discrete or continuous; else empty"),
    field("sees", pa.bool_(), "false for victims that ignore their input; perceptual axes are at their first value"),
    field("training_seed", INT, "of the victim and of what the attack prepares; 0 where it changes nothing"),
    field("threat_norm", TEXT, "perturbation set; a clean run has budget 0"),
    field("threat_budget", FLOAT, "size of the perturbation set", "share or normalised, by the norm"),
    field("threat_access", TEXT, "the most the attacker may ask"),
    field("threat_queries", INT, "most queries: of a step, or of a patch", "queries"),
    field("grid", TEXT, "name of the grid"),
    field("cell", TEXT, "JSON: the value on each axis of the world"),
    field("world_facts", TEXT, "JSON: axes, decision rate, episode length and actions of the world"),
    field("seed", INT, "scenario seed of the episode"),
)
"""What was driven."""

PROVENANCE: tuple[pa.Field, ...] = (
    field("attack_shipped_by", TEXT, "distribution and version"),
    field("defense_shipped_by", TEXT, "distribution and version"),
    field("victim_shipped_by", TEXT, "distribution and version"),
    field("world_shipped_by", TEXT, "distribution and version"),
    field("weights_sha256", TEXT, "of the policy's weights; empty where it has none"),
    field("code_digest", TEXT, "sha256 of the source of the packages that computed it"),
    field(
        "libraries",
        TEXT,
        "JSON: versions of python, torch and others that compute, and of a component's own libraries",
    ),
    field("machine", TEXT, "system, processor and number of cores"),
    field("created_at", pa.timestamp("us", tz="UTC"), "when the unit was finished"),
    field("wall_s", FLOAT, "wall time of the unit, all its episodes", "s"),
)
"""What produced it, where and when."""


def schema(track: Track) -> pa.Schema:
    """The columns of a record of a track; each field's metadata says its unit and its meaning."""
    columns = (*IDENTITY, *track.measurements, *PROVENANCE, *track.probes)
    return pa.schema(columns, metadata={"cavbench": VERSION, "track": track.name})


PROBES: tuple[pa.Field, ...] = (
    field(
        "gradient_queries", FLOAT, "gradients the attack took: a step, mean; or of a patch", "gradients", nullable=True
    ),
    field(
        "zero_gradients",
        FLOAT,
        "of the gradients the attack took, those that were 0 everywhere",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "redrawn",
        FLOAT,
        "probes on which the victim, asked the same twice, scored it otherwise: it draws",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "same_answer",
        FLOAT,
        "probes on which another episode's observation (a grey picture) got the same scores",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "draws",
        FLOAT,
        "how often the attack asked about each observation, where the victim draws",
        "queries",
        nullable=True,
    ),
)
"""What the flags of a leaderboard are measured by; null where nothing was measured. A track that measures them names them."""
