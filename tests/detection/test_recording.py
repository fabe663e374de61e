"""Recordings of approaches, read back from their files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
import torch
from PIL import Image
from rerun.chunk import Chunk, RrdReader
from torch import Tensor

from cavbench.detection import Approach, stopping
from cavbench.detection.approach import Sighting, look
from cavbench.detection.patch import Evolution, Patch
from cavbench.detection.recording import save
from cavbench.detection.recording.film import ApproachFilm
from cavbench.recording.film import save as save_film
from cavbench.recording.film.drawing import BLUE, VERMILLION
from tests.driving.test_recording import META, read, values
from tests.plugins.toy_camera import RedDetector, RedScenes

SCENES = RedScenes(torch.linspace(30, 8, 10))
CYAN = torch.tensor([0.0, 1.0, 1.0])[:, None, None].expand(3, 8, 8)
STEPS = torch.tensor([0, 4, 8])
EVOLUTION = Evolution(
    STEPS,
    torch.tensor([200, 100, 0], dtype=torch.uint8).reshape(3, 1, 1, 1).expand(3, 3, 16, 16),
    {"found": 1 / (1 + STEPS)},
)


def sighting(texels: Tensor | None = CYAN, evolution: Evolution | None = EVOLUTION) -> Sighting:
    patch = Patch(texels=texels, queries=48, evolution=evolution)
    clean, shown = (look(RedDetector(), SCENES, one, 0.75) for one in (None, texels))
    approach = Approach(seed=0, location="front", scenes=SCENES)
    return Sighting(approach, patch, 0.75, shown, clean if texels is not None else None)


def recorded(path: Path, seen: Sighting) -> dict[str, list[Chunk]]:
    save(seen, meta=META, path=path)
    return read(path)


def picture(blob: list[bytes]) -> np.ndarray:
    """Decode one instance of an encoded image to [H, W, 3] in [0, 1]."""
    decoded = cv2.imdecode(np.asarray(blob[0], np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded[..., ::-1] / 255


def fixed(chunks: list[Chunk], component: str) -> pa.Scalar:
    """The static component whose name ends with `component`."""
    for chunk in chunks:
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith(component) and chunk.is_static:
                return batch.column(name)[0].as_py()
    raise AssertionError(f"no component {component}")


def bars(chunks: list[Chunk]) -> np.ndarray:
    """The heights of the bars of a bar chart."""
    return np.asarray(fixed(chunks, "values")[0]["buffer"], np.float64)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "approach.rrd"


def test_every_frame_is_shown_with_and_without_the_patch(path: Path) -> None:
    chunks = recorded(path, sighting())
    for name, patches in (("with_patch", CYAN[None]), ("without_patch", None)):
        (chunk,) = chunks[f"/{name}"]
        assert set(chunk.timeline_names) == {"frame", "distance_cm"}
        batch = chunk.to_record_batch()
        assert batch.column("frame").to_pylist() == list(range(10))
        assert batch.column("distance_cm").to_pylist() == (-100 * SCENES.distance).round().int().tolist()
        rendered = SCENES.render(torch.arange(10), patches, 0.75).permute(0, 2, 3, 1).numpy()
        shown = np.stack([picture(blob) for blob in values(chunks[f"/{name}"], "blob")])
        assert np.abs(shown - rendered).mean() < 0.08


def test_boxes_are_where_the_sign_is_and_where_the_detector_finds_one(path: Path) -> None:
    seen = sighting()
    chunks = recorded(path, seen)
    for name, sight in (("with_patch", seen.shown), ("without_patch", seen.clean)):
        assert sight is not None
        assert values(chunks[f"/{name}/sign"], "centers") == [[[16.0, 16.0]]] * 10
        labels = [[f"{score:.2f}" for score in one.scores] for one in sight.found]
        assert [found or [] for found in values(chunks[f"/{name}/found"], "labels")] == labels
        assert [bool(found) for found in labels] == (sight.confidence > stopping.THRESHOLD).tolist()
    assert not any(seen.shown.found[0].scores)


def test_charts_show_confidence_over_distance_and_losses_over_steps(path: Path) -> None:
    seen = sighting()
    chunks = recorded(path, seen)
    assert seen.clean is not None
    np.testing.assert_allclose(bars(chunks["/confidence/with_patch"]), seen.shown.confidence)
    np.testing.assert_allclose(bars(chunks["/confidence/without_patch"]), seen.clean.confidence)
    assert bars(chunks["/confidence/threshold"]) == [stopping.THRESHOLD]
    np.testing.assert_allclose(bars(chunks["/losses/found"]), EVOLUTION.losses["found"])
    now = [tensor[0]["buffer"][0] for tensor in values(chunks["/confidence/now"], "abscissa")]
    assert (np.abs(now - SCENES.distance.numpy()) < 22 / 9).all()


def test_the_patch_evolves_on_a_timeline_of_crafting_steps(path: Path) -> None:
    chunks = recorded(path, sighting())
    (chunk,) = (chunk for chunk in chunks["/patch/crafted"] if not chunk.is_static)
    assert chunk.to_record_batch().column("crafting_step").to_pylist() == STEPS.tolist()
    shades = [picture(blob).mean() for blob in values(chunks["/patch/crafted"], "blob")]
    np.testing.assert_allclose(shades, [200 / 255, 100 / 255, 0], atol=0.01)
    np.testing.assert_allclose(picture(fixed(chunks["/patch/scored"], "blob")).mean((0, 1)), [0, 1, 1], atol=0.02)
    assert fixed(chunks["/evolution/steps"], "labels") == ["0: 1.00", "4: 0.20", "8: 0.11"]


def test_views_without_content_are_left_out(path: Path) -> None:
    everything = set(recorded(path, sighting()))
    unreported = set(recorded(path, sighting(evolution=None)))
    clean = set(recorded(path, sighting(texels=None, evolution=None)))
    assert {entity.split("/")[1] for entity in everything - unreported} == {"evolution", "losses", "patch"}
    assert {entity.split("/")[1] for entity in unreported - clean} == {"confidence", "patch", "with_patch"}
    assert {"/without_patch/found", "/confidence/without_patch"} <= clean


def test_the_page_says_when_the_sign_is_confirmed_and_where_the_car_stops(path: Path) -> None:
    (page,) = fixed(recorded(path, sighting())["/about"], "text")
    hidden, seen = page.split("**Without a patch**")
    assert "the sign is never confirmed" in hidden
    third = f"{SCENES.distance[2]:.1f}"
    assert f"confirmed at {third} m, the car stops in time" in seen


def test_a_recording_opens_with_a_layout_of_its_own(path: Path) -> None:
    save(sighting(), meta=META, path=path)
    assert len(list(RrdReader(path).blueprints())) == 1


def test_a_film_shows_the_signs_that_are_found_with_and_without_the_patch(tmp_path: Path) -> None:
    def share(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
        return int((np.abs(picture.astype(int) - colour) <= 2).all(-1).sum())

    attacked, clean = ApproachFilm(sighting(), META), ApproachFilm(sighting(None), META)
    first, *_, last = attacked.pictures(10)
    (alone,) = clean.pictures(1)
    assert share(alone, BLUE) > 100
    assert share(alone, VERMILLION) == 0
    assert alone.shape[0] < first.shape[0], "without an attack there is one view of the street"
    assert share(last, VERMILLION) > share(first, VERMILLION), "the chart grows with the distance"
    save_film(attacked, tmp_path / "clip.webp")
    film = Image.open(tmp_path / "clip.webp")
    assert (film.n_frames, film.size) == (10, (first.shape[1], first.shape[0]))
