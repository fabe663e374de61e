"""How a patch comes onto the sign: where it changes the face, by how much, and how a plate that appears is scored."""

from __future__ import annotations

from pathlib import Path

import pyarrow.compute as pc
import pytest
import torch

from cavbench.core.track import track
from cavbench.detection.mount import Mount, Shape
from cavbench.detection.threat import PatchThreat
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.run import runner
from cavbench.run.config import plan_of
from tests.run.test_runner import Silent

PLAIN = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1))
PAPER = torch.ones(3, 1, 1)


def changed(mount: Mount, share: float) -> torch.Tensor:
    """[64, 64] the texels of the face that a white patch changes."""
    return (mount.painted(PLAIN, torch.ones(1, 3, 8, 8), share, PAPER) != PLAIN).any(1)[0]


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("mount", [Mount(), Mount(place="top"), Mount(place="bottom"), Mount("stickers")])
def test_every_shape_of_paper_covers_the_same_area_within_its_bounds(mount: Mount, share: float) -> None:
    found = changed(mount, share)
    assert int(found.sum()) == (64 * share) ** 2
    assert torch.equal(found, mount.cover(share, 64)[0].bool())
    left, top, right, bottom = (round(64 * edge) for edge in mount.bounds(share))
    assert 0 <= left < right <= 64
    assert not found[:top].any()
    assert not found[bottom:].any()
    assert not found[:, :left].any()
    assert not found[:, right:].any()


def test_stickers_show_the_quarters_of_the_patch() -> None:
    patch = torch.zeros(1, 3, 8, 8)
    patch[..., :4, 4:] = 1.0
    face = Mount("stickers").painted(torch.full((1, 3, 64, 64), 0.5), patch, 0.5, PAPER)[0, 0]
    assert (face[8:24, 40:56] == 1).all()
    assert (face[8:24, 8:24] == 0).all()
    assert (face[40:56, 40:56] == 0).all()
    assert (face[26:38] == 0.5).all(), "the word between them stays"


def test_light_only_adds_and_at_most_the_budget() -> None:
    patch = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(2))
    lit = Mount("light").painted(PLAIN, patch, 0.3, PAPER)
    assert (lit >= PLAIN).all()
    assert (lit <= 1.3 * PLAIN + 1e-6).all()
    assert torch.equal(Mount("light").painted(PLAIN, torch.zeros(1, 3, 8, 8), 0.3, PAPER), PLAIN)


@pytest.mark.parametrize("shape", ["square", "stickers", "light"])
def test_the_gradient_reaches_every_texel(shape: Shape) -> None:
    patch = torch.full((1, 3, 8, 8), 0.5, requires_grad=True)
    Mount(shape).painted(PLAIN, patch, 0.5, PAPER).sum().backward()
    assert patch.grad is not None
    assert (patch.grad > 0).all()


def test_a_place_is_for_squares() -> None:
    with pytest.raises(ValueError, match=r"^threat\.place=top is for squares: leave it out with threat\.shape=light$"):
        PatchThreat(shape="light", place="top")


@pytest.mark.usefixtures("toy_folder")
@pytest.mark.parametrize(
    "words",
    [
        ["threat.shape=circle"],
        ["threat.place=left"],
        ["threat.shape=plate"],  # There is no sign that it could hide.
        ["threat.shape=light", "world=crossing", "victim=fcos"],
        ["attack=appear"],
    ],
)
def test_what_fits_nothing_is_refused_in_one_line(words: list[str]) -> None:
    given = dict(word.split("=", 1) for word in ["attack=eot", "victim=red", "world=red_street", *words])
    with pytest.raises(UserError) as refused:
        plan_of([f"{key}={value}" for key, value in given.items()])
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.usefixtures("toy_folder")
def test_a_plate_that_appears_is_scored_as_a_decoy_beside_the_sign_as_it_is(tmp_path: Path) -> None:
    words = [
        "attack=appear",
        "attack.texels=8",
        "attack.window=32",
        "attack.steps=40",
        "threat.shape=plate",
        "threat.budget=1",
    ]
    words += [
        "victim=red",
        "world=red_street",
        "lanes=3",
        "density=1",
        "weather=clear",
        "seeds=0",
        "executor=serial",
        "record=1",
    ]
    records = reading.read(
        tmp_path, runner.run(plan_of([*words, f"out={tmp_path}"]), Silent()), track=track("detection")
    )
    of = {name: records.filter(pc.field("attack") == name) for name in ("none", "appear", "grey_patch")}
    mean = {
        name: {
            column: pc.mean(table[column]).as_py() for column in ("confidence_mean", "decoy_confidence", "stop_score")
        }
        for name, table in of.items()
    }
    assert set(of["appear"]["threat_norm"].to_pylist()) == {"patch+shape=plate"}
    assert mean["appear"]["confidence_mean"] == pytest.approx(mean["none"]["confidence_mean"]), "the sign is as it was"
    assert mean["appear"]["decoy_confidence"] > mean["grey_patch"]["decoy_confidence"] + 0.3
    assert mean["appear"]["stop_score"] < mean["grey_patch"]["stop_score"] - 0.3
