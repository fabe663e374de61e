"""A patch on paper and back: from a straight scan, a photograph, in other light, and from what is no page."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image, ImageCms

from cavbench.detection import paper, printing, printout, scanned
from cavbench.detection.colour import linear, srgb
from cavbench.detection.patch import Patch
from cavbench.detection.printing import LEAST, MOST
from cavbench.errors import UserError
from cavbench.terminal import Console

TEXELS = torch.rand(3, 24, 24, generator=torch.Generator().manual_seed(3)).mul(255).round().div(255)
REFLECTED = srgb(linear(TEXELS).clamp(LEAST, MOST))
"""What paper and ink can reflect of them."""


def seen(page: NDArray[np.uint8], *, tilt: float = 0.0, light: float = 1.0, noise: float = 0.0) -> NDArray[np.uint8]:
    """The page on a table, tilted, in less light, with sensor noise."""
    side = page.shape[0]
    edges = np.array([(0, 0), (side, 0), (side, side), (0, side)], np.float32)
    moved = edges + 60 + np.array([(tilt, 0), (-tilt, 0.5 * tilt), (0, -tilt), (0.3 * tilt, 0)], np.float32) * side
    matrix = cv2.getPerspectiveTransform(edges, moved.astype(np.float32))
    table = (side + 120, side + 120)
    shown = cv2.warpPerspective(page, matrix, table, borderValue=(90, 80, 70), flags=cv2.INTER_AREA)
    coded = srgb(light * linear(torch.from_numpy(shown) / 255))
    coded = coded + noise * torch.randn(coded.shape, generator=torch.Generator().manual_seed(0))
    return (coded.clamp(0, 1) * 255).round().to(torch.uint8).numpy()


@pytest.mark.parametrize(
    ("change", "most"),
    [({}, 0.02), ({"tilt": 0.06}, 0.03), ({"light": 0.5}, 0.03), ({"tilt": 0.1, "light": 0.7, "noise": 0.02}, 0.05)],
)
def test_a_page_is_read_back(change: dict[str, float], most: float) -> None:
    found = scanned.read(seen(printout.raster(TEXELS, 600), **change), 24)
    assert float((found - REFLECTED).abs().mean()) < most


def test_a_patch_that_can_be_printed_is_what_the_paper_shows() -> None:
    """`threat.norm=print` has taken paper and ink into account: they must not take contrast from the patch a second time."""
    printable = printing.printed(TEXELS)
    found = scanned.read(seen(printout.raster(printable, 600)), 24)
    assert float((found - printable).abs().mean()) < 0.02
    white = srgb(torch.full((3, 24, 24), MOST))
    assert torch.allclose(printout.on_page(white), torch.ones(3, 24, 24), atol=1e-3), "it is the paper"


@pytest.mark.parametrize("turn", [1, 2, 3])
def test_a_page_that_lies_the_other_way_round_is_the_same(turn: int) -> None:
    turned = np.ascontiguousarray(np.rot90(seen(printout.raster(TEXELS, 600)), turn))
    assert float((scanned.read(turned, 24) - REFLECTED).abs().mean()) < 0.02


def test_a_picture_without_all_marks_is_refused_in_one_line() -> None:
    page = seen(printout.raster(TEXELS, 400))
    page[:200, :200] = 255
    with pytest.raises(UserError, match="does not show the mark at the upper left"):
        scanned.read(page, 24)
    with pytest.raises(UserError, match="does not show the mark"):
        scanned.read(np.zeros((50, 50, 3), np.uint8), 24)


def test_a_page_that_is_not_flat_is_refused() -> None:
    bent = np.pad(printout.raster(TEXELS, 600), ((80, 80), (80, 80), (0, 0)), constant_values=90)
    middle = bent.shape[0] // 2
    # The lower right quarter is somewhere else, as on a page with a fold.
    bent[middle:, middle:] = np.roll(bent[middle:, middle:], (-50, -50), (0, 1))
    with pytest.raises(UserError, match="flat"):
        scanned.read(bent, 24)


def test_the_pdf_has_the_texels_the_size_and_the_profile(tmp_path: Path) -> None:
    content = printout.pdf(TEXELS, 300, "a note (with brackets)")
    boxes = re.findall(rb"/MediaBox \[0 0 ([0-9.]+) ([0-9.]+)\]", content)
    width, height = (float(each) / printout.POINTS_MM for each in boxes[0])
    assert width == pytest.approx(300 * printout.WHOLE, abs=0.01)
    assert height == pytest.approx(300 * printout.WHOLE + printout.NOTE_MM, abs=0.01)
    assert printout.PROFILE.encode() in content
    streams = [zlib.decompress(one) for one in re.findall(rb"stream\n(.*?)\nendstream", content, re.S)]
    coded = (printout.on_page(TEXELS) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy().tobytes()
    assert coded in streams
    assert any(one[36:40] == b"acsp" for one in streams), "an ICC profile"
    side = 300 * printout.POINTS_MM
    assert f"q {side:.4f} 0 0 {side:.4f}".encode() in streams[0]
    places = [int(one) for one in re.findall(rb"(\d{10}) 00000 n", content)]
    assert [content[place:].startswith(f"{n} 0 obj".encode()) for n, place in enumerate(places, 1)] == [True] * len(
        places
    )


def test_from_the_file_of_a_patch_to_paper_and_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, out = tmp_path / "a.safetensors", tmp_path / "a.pdf"
    file.write_bytes(Patch(texels=TEXELS).written("{}"))
    paper.run("print", [str(file)], {"out": str(out), "mm": "200"}, Console())
    assert out.read_bytes().startswith(b"%PDF-1.7")
    scan, back = tmp_path / "scan.png", tmp_path / "back.png"
    Image.fromarray(seen(printout.raster(TEXELS, 600))).save(scan)
    paper.run("scan", [str(scan)], {"out": str(back), "original": str(file)}, Console())
    assert Image.open(back).size == (24, 24)
    assert "from the original" in capsys.readouterr().out


def test_bad_files_are_one_line(tmp_path: Path) -> None:
    whole = tmp_path / "whole.png"
    Image.fromarray(printout.raster(TEXELS, 200)).save(whole)
    cut = tmp_path / "cut.png"
    cut.write_bytes(whole.read_bytes()[:2000])
    bomb = tmp_path / "bomb.png"
    # A header that promises 60,000 x 60,000 pixels.
    head = b"IHDR" + (60_000).to_bytes(4, "big") * 2 + bytes([8, 2, 0, 0, 0])
    crc = zlib.crc32(head).to_bytes(4, "big")
    bomb.write_bytes(b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + head + crc)
    (tmp_path / "text.png").write_text("no picture")
    for action, name, values in [
        ("scan", "cut.png", {}),
        ("scan", "bomb.png", {}),
        ("scan", "text.png", {}),
        ("scan", "none.png", {}),
        ("scan", "whole.png", {"texels": "7"}),
        ("scan", "whole.png", {"out": "back.jpg"}),
        ("scan", "whole.png", {"original": "none.safetensors"}),
        ("print", "whole.png", {}),
        ("print", "none.safetensors", {}),
        ("print", "whole.png", {"mm": "1e9"}),
        ("print", "whole.png", {"mm": "wide"}),
    ]:
        out = {"out": str(tmp_path / ("o.pdf" if action == "print" else "o.png"))}
        with pytest.raises(UserError) as refused:
            paper.run(action, [str(tmp_path / name)], out | values, Console())
        assert len(str(refused.value).splitlines()) == 1
    assert not list(tmp_path.glob("o.*"))


def test_a_picture_is_read_in_the_colours_of_its_profile(tmp_path: Path) -> None:
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    entries = [
        profile[start : start + 12] for start in range(132, 132 + 12 * int.from_bytes(profile[128:132], "big"), 12)
    ]
    red, blue = (int.from_bytes(one[4:8], "big") for one in entries if one[:4] in (b"rXYZ", b"bXYZ"))
    # Red and blue change places, in the profile and in the picture.
    profile[red : red + 20], profile[blue : blue + 20] = profile[blue : blue + 20], profile[red : red + 20]
    wanted = (TEXELS * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    picture = Image.fromarray(np.ascontiguousarray(wanted[..., ::-1]))
    for mode in ("RGB", "RGBA"):
        picture.convert(mode).save(tmp_path / "a.png", icc_profile=bytes(profile))
        assert np.array_equal(scanned.opened(tmp_path / "a.png"), wanted)
    picture.save(tmp_path / "a.png", icc_profile=b"no profile")
    with pytest.raises(UserError, match="colour profile"):
        scanned.opened(tmp_path / "a.png")
