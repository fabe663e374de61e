"""The detection track: detectors of a stop sign, attacked by a patch on the sign."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cavbench.core import registry, sets
from cavbench.core.contracts import Progress
from cavbench.core.pair import Pair, choose
from cavbench.core.track import Baseline, Contrast, Driven, Job, Measure, Track
from cavbench.records.schema import FLOAT, NAN_GRADIENTS, PROBES, TEXT, field
from cavbench.scenarios import Cell

if TYPE_CHECKING:
    from cavbench.recording.film import Film

REFERENCE_PATCHES = ("noise_patch", "grey_patch", "plain_patch")
"""Baseline patches, not optimised against the detector: they measure the effect of covering the sign."""
COLOURS: Mapping[str, tuple[dict[str, str], ...]] = {"plain_patch": ({"colour": "black"}, {"colour": "blue"})}
"""The parameters of baseline patches that there are several of: the one with the lowest score counts in each cell."""

MEASUREMENTS: tuple[pa.Field, ...] = (
    field("location", TEXT, "of the approach"),
    field(
        "confidence_mean",
        FLOAT,
        "confidence in the sign at its true position, mean over the frames; 0 in a frame that misses it",
        "0 to 1",
    ),
    field("confidence_median", FLOAT, "as confidence_mean, but the median over the frames", "0 to 1"),
    field("detection_rate", FLOAT, "frames with a confidence above 0.25", "share, 0 to 1"),
    field("first_seen_m", FLOAT, "distance at which the sign is first detected; 0 if never", "m", low=0),
    field(
        "confirmed_m",
        FLOAT,
        "distance at which the sign is first detected in 3 of the last 5 frames; 0 if never",
        "m",
        low=0,
    ),
    field("overrun_m", FLOAT, "how far beyond the stop line the car stops; 0 if before it", "m", low=0),
    field("ran", pa.bool_(), "whether the car never brakes for the sign, or stops more than 1 m beyond the line"),
    field(
        "visible_share",
        FLOAT,
        "share of the sign inside the image and not occluded, mean over the frames",
        "share, 0 to 1",
    ),
    field("false_alarms", FLOAT, "stop signs detected where there is none, mean per frame", "detections", low=0),
    field("queries", FLOAT, "images that the detector was queried with to craft the patch", "images", low=0),
    field("gradients", FLOAT, "images whose gradient was taken to craft the patch", "images", low=0),
    field("crafting_s", FLOAT, "wall time of crafting the patch", "s", low=0),
    field(
        "excess",
        FLOAT,
        "largest distance of the attack's texels to the perturbation set",
        "texel value",
        low=0,
    ),
    field("patch", TEXT, "fingerprint of the patch, patches/<fingerprint>.safetensors; empty if there is none"),
    field("patch_sha256", TEXT, "of its texels; empty if the attack makes no patch"),
    field("frame_distance_m", pa.list_(FLOAT), "of each frame: distance from the camera to the sign", "m", low=0),
    field("frame_confidence", pa.list_(FLOAT), "of each frame: confidence in the sign at its true position", "0 to 1"),
    field("frame_visible", pa.list_(FLOAT), "of each frame: visible share of the sign", "share, 0 to 1"),
)


DECOYS: tuple[pa.Field, ...] = (
    field(
        "stop_score",
        FLOAT,
        "confidence_mean minus decoy_confidence, not below 0; confidence_mean where no decoys were shown",
        "0 to 1",
    ),
    field(
        "average_precision",
        FLOAT,
        "of the stop signs detected in the frames with the sign and with decoys, at an IoU of 0.5; without frames that show less "
        "than half of the sign",
        "0 to 1",
        nullable=True,
    ),
    field(
        "decoy_confidence",
        FLOAT,
        "confidence in a stop sign where another face or nothing is on the post, mean over the frames",
        "0 to 1",
        nullable=True,
    ),
    field(
        "false_stops",
        FLOAT,
        "stop signs detected in frames with decoys, mean per frame",
        "detections",
        nullable=True,
        low=0,
    ),
    field(
        "octagons",
        FLOAT,
        "frames with another face on the octagon in which it is detected as a stop sign",
        "share, 0 to 1",
        nullable=True,
    ),
)
"""How the detector tells the sign from decoys; null in records that are older than decoys, and in worlds without them."""
PRINTED: tuple[pa.Field, ...] = (
    field(
        "non_printability",
        FLOAT,
        "mean distance of the patch's texels to the nearest of thirty printable colours; null without a patch",
        "sRGB",
        nullable=True,
        low=0,
    ),
    field(
        "confidence_visible",
        FLOAT,
        "confidence_mean of the frames that show at least half of the sign",
        "0 to 1",
        nullable=True,
    ),
    field(
        "misread",
        FLOAT,
        "frames that show at least half of the sign in which another class is detected there, with a higher score",
        "share, 0 to 1",
        nullable=True,
    ),
    field("seen_instead", TEXT, "the class of most of these frames; empty if there is none", nullable=True),
)
"""What was printed, and what is seen of the sign where it can be seen; null in older records."""
CERTIFIED: tuple[pa.Field, ...] = (
    field(
        "certified",
        FLOAT,
        "stop_score at least, whatever the patch shows: with the certified confidence instead of confidence_mean; null without a "
        "certificate or an attack",
        "0 to 1",
        nullable=True,
    ),
)
"""What the defence promises; null in older records."""


FACES: tuple[pa.Field, ...] = (
    *(
        field(
            name,
            FLOAT,
            f"stop signs detected in frames with {what} that no training sees, mean per frame",
            "detections",
            nullable=True,
            low=0,
        )
        for name, what in (
            ("false_stops_faces", "a face of the three families"),
            ("false_stops_words", "another word on the red octagon"),
            ("false_stops_colours", "an octagon of another colour, or a red plate of another shape with white marks,"),
            ("false_stops_signs", "a real sign"),
        )
    ),
    field(
        "foreign_stops",
        FLOAT,
        "frames with a foreign stop sign that no training sees, at least half of it visible, in which it is detected",
        "share, 0 to 1",
        nullable=True,
    ),
)
"""What is detected on faces that are kept back from trainings; null in older records and where an approach shows none."""

CERTIFIED_FRAMES: tuple[pa.Field, ...] = (
    field(
        "frame_certified",
        pa.list_(FLOAT),
        "of each frame: frame_confidence at least, whatever the patch shows; null without a certificate or an attack",
        "0 to 1",
        nullable=True,
    ),
)
"""The certificate frame by frame; null in older records."""

CLOSED_LOOP: tuple[pa.Field, ...] = (
    field(
        "stopped",
        pa.bool_(),
        "closed loop: whether the car stopped at the line: at most 6.6 m before and at most 1 m beyond it",
        nullable=True,
    ),
    field(
        "drive_confirmed_m",
        FLOAT,
        "closed loop: distance at which the driver confirmed the sign; 0 if never",
        "m",
        nullable=True,
        low=0,
    ),
    field(
        "drive_overrun_m",
        FLOAT,
        "closed loop: how far beyond the line the car came until it stood still or had left the crossing; 0 if before the line",
        "m",
        nullable=True,
        low=0,
    ),
    field(
        "collided",
        pa.bool_(),
        "closed loop: whether the car hit a vehicle of the cross traffic before it stood still or had left the crossing",
        nullable=True,
    ),
)
"""What the car does that the detector drives; null in older records, and in worlds without a closed loop."""
FALSE_STOPS: tuple[pa.Field, ...] = (
    field(
        "drive_short_m",
        FLOAT,
        "closed loop: how far before the line the car stood still; 0 if it stood at or beyond the line, or did not stop",
        "m",
        nullable=True,
        low=0,
    ),
    field(
        "drive_false_m",
        FLOAT,
        "closed loop: distance at which the driver first confirmed something else as a stop sign; 0 if never",
        "m",
        nullable=True,
        low=0,
    ),
    field(
        "others_braked",
        pa.bool_(),
        "closed loop: whether a vehicle of the cross traffic braked for the car",
        nullable=True,
    ),
)
"""Stops for something else, and what the cross traffic does; null in older records, and in worlds without a closed loop."""


class DetectionTrack(Track):
    """Detectors of a stop sign, attacked by a patch on it, ranked by how far they tell the sign from decoys."""

    name: ClassVar[str] = "detection"
    world: ClassVar[str] = "camera"
    victim: ClassVar[str] = "yolov5"
    episode: ClassVar[tuple[str, str]] = ("approach", "approaches")
    run: ClassVar[str] = "patch seed"
    artefact: ClassVar[tuple[str, str] | None] = ("patch", "patches")

    unrepeatable: ClassVar[tuple[str, ...]] = ("patch", "crafting_s")
    measurements: ClassVar[tuple[pa.Field, ...]] = MEASUREMENTS
    probes: ClassVar[tuple[pa.Field, ...]] = (
        *PROBES,
        *DECOYS,
        *PRINTED,
        *CLOSED_LOOP,
        *CERTIFIED,
        NAN_GRADIENTS,
        *FACES,
        *CERTIFIED_FRAMES,
        *FALSE_STOPS,
    )
    later: ClassVar[tuple[str, ...]] = tuple(one.name for one in (*FACES, *CERTIFIED_FRAMES, *FALSE_STOPS))
    certificates: ClassVar[str] = "frame_certified"
    norms: ClassVar[tuple[str, ...]] = ("patch", "print")
    metric: ClassVar[str] = "stop_score"
    metric_title: ClassVar[str] = "stop score"
    blind_at_zero: ClassVar[tuple[str, str]] = ("detection_rate", "it sees no stop sign in any frame")
    failure: ClassVar[str] = "ran"
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure(column="average_precision", heading="AP of\nstop", digits=2, spare=1, ranked=True),
        Measure(column="false_stops", heading="false\nstops", digits=2, spare=1, ranked=True),
        Measure(column="false_stops_faces", heading="on kept-\nback faces", digits=2, spare=2),
        Measure(column="detection_rate", heading="frames\nseen", unit="share"),
        Measure(column="first_seen_m", heading="first\nseen m", digits=1, spare=2),
        Measure(column="ran", heading="runs the\nsign", unit="share", with_interval=True),
        Measure(column="overrun_m", heading="over-\nrun m", digits=1, spare=3),
        Measure(column="stopped", heading="stops\nin loop", unit="share", spare=1, ranked=True),
        Measure(column="drive_overrun_m", heading="loop over-\nrun m", digits=1, spare=3, ranked=True),
        Measure(column="collided", heading="\ncollides", unit="share", spare=1, ranked=True),
        Measure(column="visible_share", heading="\nvisible", unit="share", tables="cells", spare=5),
        Measure(column="false_alarms", heading="false\nalarms", digits=2, spare=7),
        Measure(column="queries", heading="\nimages", of_attack=True, tables="overview", spare=4),
        Measure(column="crafting_s", heading="craft\ns", of_attack=True, tables="overview", spare=4),
    )
    legend: ClassVar[str] = (
        "stop score: confidence in the stop sign at its true position minus confidence in decoys (other faces on the same post), "
        "mean over an approach. AP of stop: average precision over frames with the sign and with decoys. false stops: per frame "
        "with a decoy; on kept-back faces: per frame with another word, colour or sign that no training sees. frames "
        "seen: share with confidence above 0.25. runs the sign: the car, at 10 m/s, never brakes, or stops "
        "more than 1 m beyond the line. false alarms: per frame with the sign. stops in loop, loop "
        "overrun, collides: of the car that the detector drives frame by frame."
    )
    baseline_kinds: ClassVar[Mapping[str, Baseline]] = {
        "noise_patch": Baseline(title="noise patch", heading="\nnoise", spare=1),
        "grey_patch": Baseline(title="grey patch", heading="\ngrey", spare=1),
        "plain_patch": Baseline(title="plain patch", heading="\nplain", spare=1),
    }
    contrast: ClassVar[Contrast | None] = Contrast(
        side="attack", title="the best baseline patch", heading="beyond best\nbaseline"
    )
    place: ClassVar[str] = "location"
    queries_title: ClassVar[str] = "images per patch"
    gradients: ClassVar[str] = "gradients"
    excess: ClassVar[str] = "excess"
    enough_episodes: ClassVar[int] = 3
    other_input: ClassVar[str] = "a grey image"
    many_draws: ClassVar[str] = "The victim is random, and a patch is crafted on many images, each with its own draw."

    work: ClassVar[str] = "cavbench.detection.drive"
    preparation: ClassVar[str] = "cavbench.detection.crafting"

    def baselines(self, pair: Pair) -> Iterator[Pair]:
        """The baseline patches, of the same size, on the same defended detector."""
        installed = registry.names("attack") if not pair.is_clean else []
        for name in REFERENCE_PATCHES:
            if name in installed and name != pair.attack.name:
                for colour in COLOURS.get(name, ({},)):
                    yield replace(pair, attack=choose("attack", name, **colour))

    def baseline_of(self, other: Mapping[str, object], own: Mapping[str, object]) -> str:
        same = (
            "defense",
            "defense_params",
            "victim",
            "victim_params",
            "world",
            "world_params",
            "threat_norm",
            "threat_budget",
        )
        is_one = other["attack"] in REFERENCE_PATCHES and all(other[name] == own[name] for name in same)
        return str(other["attack"]) if is_one else ""

    def allowed(self, norm: str, budget: float, facts: Mapping[str, Any]) -> str:
        norm, others = sets.split(norm)
        return "; ".join((f"a {'printable ' * (norm == 'print')}patch {100 * budget:g} % as wide as the sign", *others))

    def effort(self, column: Callable[[str], NDArray[np.float64]]) -> Iterator[tuple[str, str]]:
        images, seconds = (float(column(name).mean()) for name in ("queries", "crafting_s"))
        yield "crafted", f"from {images:.0f} images in {seconds:.0f} s per patch, on average"

    def prepare(self, job: Job, made_by: str, progress: Progress) -> bytes:
        from cavbench.detection.crafting import prepare

        return prepare(job, made_by, progress)

    def try_network(self, network: Any, pair: Pair, cells: Sequence[Cell]) -> list[str]:
        from cavbench.detection.trial import try_detector

        victim: Any = pair.victim.component
        world: Any = pair.world.component
        return try_detector(network, victim, world, alone=pair.defense.name == "none") if victim.sees else []

    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        from cavbench.detection.drive import drive

        return drive(job, artefact, traced)

    def alike(self, job: Job) -> Hashable | None:
        attacked = ("attack", "attack_params")
        apart = tuple(value for name, value in job.pair.identity.items() if name not in attacked)
        seen = job.pair.world.component.facts.axes.looked_at(job.cell)
        return (apart, job.training_seed, tuple(seen.items()), job.seeds, job.device)

    def drive_jointly(self, jobs: Sequence[Job], artefacts: Mapping[str, bytes]) -> Sequence[Driven] | None:
        from cavbench.detection.drive import drive_jointly

        return drive_jointly(jobs, artefacts)

    def paper(self, action: Literal["print", "scan"], names: list[str], values: dict[str, str], console: Any) -> None:
        from cavbench.detection import paper

        paper.run(action, names, values, console)

    def record(self, job: Job, trace: Any, meta: Mapping[str, object], path: Path) -> None:
        from cavbench.detection.recording import save

        save(trace, meta=meta, path=path)

    def film(self, job: Job, trace: Any, meta: Mapping[str, object]) -> Film:
        from cavbench.detection.recording.drive_film import DriveFilm
        from cavbench.detection.recording.film import ApproachFilm

        return DriveFilm(trace, trace.drives, meta) if trace.drives else ApproachFilm(trace, meta)
