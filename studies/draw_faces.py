"""Draws the sheet of faces that detectors are scored and trained with: envs/camera/data/faces.png and faces.json.

    pip install resvg-py==0.5.0
    python studies/draw_faces.py [--picture sheet.png]

Real signs are SVGs of the npm package mapillary_sprite_source 1.8.0 (MIT), words are lettered in Overpass (OFL) of the wheel
fontpkg-overpass 4.0. Both packages are checked by their hash and read as archives. resvg (MPL-2.0) renders the SVGs: it runs no
scripts and fetches nothing from the network; a file with a reference, an entity or more than 64 KiB is refused here before.

The rule of the halves: within a family the names are sorted; the first, third, fifth ... are kept back for scoring, the others
are for training.
"""

from __future__ import annotations

import argparse
import io
import json
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from cavbench.envs.camera import sheet
from cavbench.errors import UserError, in_one_line
from cavbench.zoo.tarballs import Tarball
from cavbench.zoo.wheels import Wheel

SIGNS = Tarball(
    package="mapillary_sprite_source@1.8.0",
    sha256="6266c97de1746319b9437355c853384e1c7dfc1f06973c8c37a3704a8ca763da",
    size=15_769_074,
)
FONT = Wheel(
    requirement="fontpkg-overpass==4.0",
    sha256="dcb1944d9e730255c51dcc3c065577c4e3f230bc406c0fdff02599c965c78898",
    python="3.11",
)
LETTERS = "fontpkg_overpass/files/Overpass[wght].ttf", "fontpkg_overpass/files/Overpass-Italic[wght].ttf"
MOST_BYTES = 64 * 1024
SIDE = 4 * sheet.SIDE
RED, WHITE, BLACK = (176, 20, 31), (240, 240, 235), (20, 20, 20)
BROWN, BLUE, GREEN, ORANGE, YELLOW, PURPLE, GREY = (
    (112, 68, 36),
    (20, 70, 160),
    (20, 110, 60),
    (235, 115, 20),
    (245, 200, 30),
    (105, 45, 130),
    (120, 120, 125),
)
Colour = tuple[int, int, int]
Picture = Image.Image

STOP_WORDS = ("ALTO", "PARE", "ARRÊT", "DUR", "HALT", "BERHENTI")
"""Mexico, Brazil, Quebec, Turkey, Belgium once, Malaysia."""
WORDS = (
    *("PARK", "SLOW", "DROP", "GO", "SHOP", "SPOT", "STEP", "SNAP", "TAXI", "EXIT", "POST", "TOP"),
    *("STAR", "ZONE", "CAFE", "PULL", "LOOK", "HALF", "TURN", "SALE", "BUS", "WALK", "OPEN", "PUSH"),
)
OCTAGONS: dict[str, tuple[str, Colour, Colour, Colour]] = {
    "brown octagon, PARK": ("PARK", BROWN, WHITE, WHITE),
    "blue octagon, SHOP": ("SHOP", BLUE, WHITE, WHITE),
    "green octagon, GO": ("GO", GREEN, WHITE, WHITE),
    "orange octagon, SLOW": ("SLOW", ORANGE, WHITE, WHITE),
    "yellow octagon, DROP": ("DROP", YELLOW, BLACK, BLACK),
    "purple octagon, TAXI": ("TAXI", PURPLE, WHITE, WHITE),
    "grey octagon, STEP": ("STEP", GREY, WHITE, WHITE),
    "black octagon, EXIT": ("EXIT", BLACK, WHITE, WHITE),
    "white octagon, SALE": ("SALE", WHITE, RED, RED),
    "blue octagon, BUS": ("BUS", BLUE, WHITE, WHITE),
}
REAL = (
    *("no-entry--g1", "yield--g1", "priority-road--g1", "priority-over-oncoming-vehicles--g1", "wrong-way--g1"),
    *("give-way-to-oncoming-traffic--g1", "give-way-to-oncoming-traffic--g2", "road-closed-to-vehicles--g1"),
    *("road-closed-to-vehicles--g3", "road-closed--g1", "no-stopping--g1", "no-stopping--g2", "no-stopping--g7"),
    *("no-parking--g1", "no-parking--g2", "no-parking--g8", "no-overtaking--g1", "no-overtaking--g5", "no-u-turn--g1"),
    *("no-u-turn--g2", "no-motor-vehicles--g1", "no-motor-vehicles--g5", "height-limit--g1", "width-limit--g1"),
    *("weight-limit--g1", "weight-limit--g4", "maximum-speed-limit-30--g1", "maximum-speed-limit-50--g1"),
    *("maximum-speed-limit-50--g3", "maximum-speed-limit-80--g1", "roundabout--g1", "bicycles-only--g1"),
)
WARNINGS = (
    "stop-ahead--g1",
    "stop-ahead--g3",
    "stop-ahead--g5",
    "traffic-signals--g1",
    "children--g1",
    "other-danger--g1",
)
STOPS = tuple(f"stop--g{number}" for number in range(1, 11))
"""English, Japanese, ringed (two), Chinese, Chinese and English, a hand, Arabic, Korean, Korean and English."""


class Pen:
    """Draws faces with the letters of a font."""

    def __init__(self, upright: Path, slanted: Path) -> None:
        self.fonts = upright, slanted

    def letters(self, height: float, slanted: bool) -> ImageFont.FreeTypeFont:
        """The heaviest letters, whose capitals are `height` of the side high."""
        font = ImageFont.truetype(self.fonts[slanted], round(SIDE * height / 0.72))
        font.set_variation_by_axes([900])
        return font

    def write(
        self,
        picture: Picture,
        text: str,
        colour: Colour,
        height: float = 1 / 3,
        slanted: bool = False,
        most: float = 0.78,
        middle: float = 0.5,
    ) -> None:
        """Write a text no wider than `most` of the side; long words are narrow and keep their height, as on real signs."""
        font = self.letters(height, slanted)
        x0, y0, x1, y1 = font.getbbox(text)
        mask = Image.new("L", (int(x1 - x0) + 2, int(y1 - y0) + 2), 0)
        ImageDraw.Draw(mask).text((-x0, -y0), text, 255, font)
        mask = mask.resize((min(mask.width, round(most * SIDE)), mask.height))
        place = (SIDE - mask.width) // 2, round(middle * SIDE) - mask.height // 2
        picture.paste(Image.new("RGB", mask.size, colour), place, mask)

    def octagon(self, text: str, ground: Colour = RED, ink: Colour = WHITE, rim: Colour = WHITE) -> Picture:
        picture = plate(8, 22.5, rim)
        ImageDraw.Draw(picture).polygon(corners(8, 22.5, 0.955), (*ground, 255))
        self.write(picture, text, ink)
        return picture

    def disc(self, mark: Callable[[ImageDraw.ImageDraw], None] | str, slanted: bool = False) -> Picture:
        return self.marked(64, 0.0, mark, slanted, 1 / 4, 0.7, 0.5)

    def triangle(
        self, first: float, mark: Callable[[ImageDraw.ImageDraw], None] | str, slanted: bool = False
    ) -> Picture:
        return self.marked(3, first, mark, slanted, 1 / 6, 0.42, 0.57 if first < 0 else 0.42)

    def marked(
        self,
        count: int,
        first: float,
        mark: Callable[[ImageDraw.ImageDraw], None] | str,
        slanted: bool,
        height: float,
        most: float,
        middle: float,
    ) -> Picture:
        picture = plate(count, first, WHITE)
        draw = ImageDraw.Draw(picture)
        draw.polygon(corners(count, first, 0.93 if count > 3 else 0.86), (*RED, 255))
        if isinstance(mark, str):
            self.write(picture, mark, WHITE, height, slanted, most, middle)
        else:
            mark(draw)
        return picture


def corners(count: int, first: float, size: float) -> list[tuple[float, float]]:
    """A centred regular polygon; an octagon's size is its width across flats."""
    radius = size * SIDE / 2 / (np.cos(np.pi / 8) if count == 8 else 1)
    angles = np.deg2rad(first + 360 / count * np.arange(count))
    return [(SIDE / 2 + radius * float(np.cos(a)), SIDE / 2 + radius * float(np.sin(a))) for a in angles]


def plate(count: int, first: float, colour: Colour) -> Picture:
    picture = Image.new("RGBA", (SIDE, SIDE), (*colour, 0))
    ImageDraw.Draw(picture).polygon(corners(count, first, 1.0), (*colour, 255))
    return picture


def bar(draw: ImageDraw.ImageDraw, box: tuple[float, float, float, float] = (0.15, 0.42, 0.85, 0.58)) -> None:
    draw.rectangle([SIDE * one for one in box], WHITE)


def cross(draw: ImageDraw.ImageDraw) -> None:
    for first, second in (((0.27, 0.27), (0.73, 0.73)), ((0.73, 0.27), (0.27, 0.73))):
        draw.line([SIDE * one for one in (*first, *second)], WHITE, SIDE // 8)


def arrow(draw: ImageDraw.ImageDraw) -> None:
    shape = ((0.2, 0.44), (0.55, 0.44), (0.55, 0.3), (0.82, 0.5), (0.55, 0.7), (0.55, 0.56), (0.2, 0.56))
    draw.polygon([(SIDE * x, SIDE * y) for x, y in shape], WHITE)


def ring(draw: ImageDraw.ImageDraw) -> None:
    draw.ellipse([0.25 * SIDE, 0.25 * SIDE, 0.75 * SIDE, 0.75 * SIDE], outline=WHITE, width=SIDE // 10)


def colours(pen: Pen) -> dict[str, Picture]:
    """Octagons of other colours, and red discs and triangles with white marks or script."""
    faces = {name: pen.octagon(*given) for name, given in OCTAGONS.items()}
    faces |= {
        "red disc, bar": pen.disc(bar),
        "red disc, cross": pen.disc(cross),
        "red disc, arrow": pen.disc(arrow),
        "red disc, ring": pen.disc(ring),
        "red disc, two bars": pen.disc(lambda draw: [bar(draw, (0.2, y, 0.8, y + 0.13)) for y in (0.3, 0.57)] and None),
        "red disc, script Cola": pen.disc("Cola", slanted=True),
        "red disc, script Sport": pen.disc("Sport", slanted=True),
        "red disc, PIZZA": pen.disc("PIZZA"),
        "red disc, OPEN": pen.disc("OPEN"),
        "red triangle on its base, !": pen.triangle(-90, "!"),
        "red triangle on its base, script Hot": pen.triangle(-90, "Hot", slanted=True),
        "red triangle on its corner, SLOW": pen.triangle(90, "SLOW"),
        "red triangle on its corner, bar": pen.triangle(90, lambda draw: bar(draw, (0.3, 0.38, 0.7, 0.5))),
        "red triangle on its corner, YIELD": pen.triangle(90, "YIELD"),
    }
    return faces


def drawn(svg: Path) -> Picture:
    """A sign of the package, as large as fits into the octagon, without changing its shape.

    Raises:
        UserError: if the file is too large, or names anything outside itself.
    """
    text = svg.read_text("utf-8") if svg.stat().st_size <= MOST_BYTES else ""
    outside = r"<!ENTITY|<image|<script|<foreignObject|<style|href\s*=\s*[\"'](?!#)|url\((?!#)"
    if not text or re.search(outside, text, re.IGNORECASE):
        raise UserError(f"{svg.name} is larger than {MOST_BYTES} bytes, or refers to something outside itself")
    import resvg_py

    picture = Image.open(io.BytesIO(bytes(resvg_py.svg_to_bytes(svg_string=text, width=SIDE)))).convert("RGBA")
    picture = picture.crop(picture.getchannel("A").point(lambda one: 255 * (one > 127)).getbbox())
    step = np.linspace(0, 1, SIDE)
    across, down = np.meshgrid(np.abs(2 * step - 1), np.abs(2 * step - 1))
    outside_octagon = (across + down) > np.sqrt(2)
    for share in np.arange(1.0, 0.5, -0.02):
        scale = share * SIDE / max(picture.size)
        small = picture.resize((round(scale * picture.width), round(scale * picture.height)), Image.Resampling.LANCZOS)
        whole = Image.new("RGBA", (SIDE, SIDE), (0, 0, 0, 0))
        whole.paste(small, ((SIDE - small.width) // 2, (SIDE - small.height) // 2))
        solid = np.asarray(whole.getchannel("A")) > 127
        if (solid & outside_octagon).sum() <= 0.004 * solid.sum():
            return whole
    raise UserError(f"{svg.name} does not fit into the octagon")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--picture", type=Path, help="PNG of the sheet on grey, kept back ones first")
    asked = parser.parse_args()
    chosen = {f"regulatory--{name}": name for name in (*STOPS, *REAL)} | {
        f"warning--{n}": f"warning {n}" for n in WARNINGS
    }
    with tempfile.TemporaryDirectory() as folder:
        members = [f"package/package_signs/{name}.svg" for name in chosen]
        parts = SIGNS.take(members, Path(folder), lambda done, total: None)
        signs = {title: drawn(part) for title, part in zip(chosen.values(), parts, strict=True)}
        letters = Path(folder) / "letters"
        letters.mkdir()
        pen = Pen(*FONT.take(LETTERS, letters, lambda done, total: None))
        faces = {
            "words": {f"red octagon, {word}": pen.octagon(word) for word in WORDS},
            "colours": colours(pen),
            "signs": {name: picture for name, picture in signs.items() if name not in STOPS},
            "stops": {f"red octagon, {word}": pen.octagon(word) for word in STOP_WORDS} | {n: signs[n] for n in STOPS},
        }
    rows = [
        {"name": name, "family": family, "octagonal": "octagon" in name, "scored": place % 2 == 0}
        for family, own in faces.items()
        for place, name in enumerate(sorted(own))
    ]
    cells = [faces[str(row["family"])][str(row["name"])] for row in rows]
    sheet.write([np.asarray(one.resize((sheet.SIDE, sheet.SIDE), Image.Resampling.BOX)) for one in cells], rows)
    print(json.dumps({family: [len(own), (len(own) + 1) // 2] for family, own in faces.items()}), "faces, kept back")
    if asked.picture:
        contact(rows, cells).save(asked.picture)


def contact(rows: list[dict[str, object]], cells: list[Picture]) -> Picture:
    """All faces on grey, those that are kept back first, with their names."""
    wide, side = 14, 110
    order = sorted(range(len(rows)), key=lambda place: not rows[place]["scored"])
    whole = Image.new("RGB", (wide * side, -(-len(order) // wide) * (side + 12)), (125, 140, 125))
    for number, place in enumerate(order):
        x, y = number % wide * side, number // wide * (side + 12)
        small = cells[place].resize((side - 6, side - 6), Image.Resampling.BOX)
        whole.paste(small, (x, y), small)
        mark = "" if rows[place]["scored"] else "t "
        ImageDraw.Draw(whole).text((x, y + side - 5), f"{mark}{rows[place]['name']}"[:20], (255, 255, 255))
    return whole


if __name__ == "__main__":
    with in_one_line():
        main()
