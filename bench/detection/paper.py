"""`bench patch`: a patch of a results folder on paper, and back from a scan (`Track.paper`)."""

from __future__ import annotations

from pathlib import Path

import torch
from rich.text import Text

from cavbench.detection import printout, scanned
from cavbench.detection.patch import Patch, read_all
from cavbench.detection.threat import SIDES
from cavbench.errors import UserError
from cavbench.files import whole
from cavbench.terminal import Console

LARGEST_BYTES = 100_000_000


def number(text: str, key: str, low: float, high: float) -> float:
    """A number of the command line.

    Raises:
        UserError: if it is none, or out of its range.
    """
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise UserError(f"{key} must be a number from {low:g} to {high:g}, got {text[:40]!r}")
    return value


def kept(path: Path, site: int = 0) -> Patch:
    """The patch in a file of a results folder, or that of one of its sites.

    Raises:
        UserError: if there is none.
    """
    if not path.is_file():
        raise UserError(f"there is no file {path}: choose one of patches/ in a results folder")
    if path.stat().st_size > LARGEST_BYTES:
        raise UserError(f"{path} is too large for a patch")
    try:
        found = read_all(path.read_bytes())
    except UserError as error:
        raise UserError(f"{path} is no patch: {error}") from None
    if not 0 <= site < len(found):
        raise UserError(f"site={site}: {path.name} has {len(found)} patches, from 0 to {len(found) - 1}")
    if found[site].texels is None:
        raise UserError(f"{path} has no texels: the attack made no patch")
    return found[site]


def to_paper(source: Path, side_mm: float, out: Path, site: int, console: Console) -> None:
    """Write a patch as a PDF that is ready to print, and say how large it is.

    Args:
        source: file of the patch.
        side_mm: side of the patch on paper.
        out: the PDF.
        site: which of several patches.
        console: to print to.
    """
    patch = kept(source, site)
    assert patch.texels is not None
    texels = patch.texels.shape[-1]
    size = printout.WHOLE * side_mm
    note = f"cavbench patch {patch.sha256[:12]}, {texels} x {texels} texels, side {side_mm:g} mm, {printout.PROFILE}"
    with whole(out) as file:
        file.write(printout.pdf(patch.texels, side_mm, note))
    console.print(
        Text(
            f"{out}: a page of {size:.0f} x {size + printout.NOTE_MM:.0f} mm with a patch of {side_mm:g} mm, colours in "
            f"{printout.PROFILE}. Print it at 100 %, without fitting it to the page, and cut at the edge of the patch."
        ),
        soft_wrap=True,
    )


def from_scan(source: Path, texels: int, out: Path, console: Console, original: Path | None, site: int) -> None:
    """Write the patch on a scan as a PNG of P x P pixels, and say how far it is from the original.

    Args:
        source: the scan.
        texels: P.
        out: the PNG.
        console: to print to.
        original: file of the patch that was printed; None if it is not at hand.
        site: which of several patches in it.
    """
    from PIL import Image

    wanted = kept(original, site).texels if original else None
    if wanted is not None:
        texels = wanted.shape[-1]
    found = scanned.read(scanned.opened(source), texels)
    coded = (found * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    with whole(out) as file:
        Image.fromarray(coded).save(file, format="PNG")
    line = f"{out}: {texels} x {texels} texels"
    if wanted is not None:
        line += f", {float((found - wanted).abs().mean()):.3f} from the original in the mean, on the sRGB scale"
    console.print(Text(line), soft_wrap=True)


def run(action: str, names: list[str], values: dict[str, str], console: Console) -> None:
    """Carry out `bench patch print` or `scan`."""
    if not names:
        raise UserError(f"bench patch {action} needs a file: bench patch {action} FILE out=FILE")
    source = Path(names[0]).expanduser()
    site = round(number(values.get("site", "0"), "site", 0, 10_000))
    if action == "print":
        out = Path(values.get("out", "patch.pdf")).expanduser()
        side = number(values.get("mm", "600"), "mm", printout.LEAST_MM, printout.MOST_MM)
        to_paper(source, side, _file(out, ".pdf"), site, console)
        return
    out = Path(values.get("out", "scanned.png")).expanduser()
    texels = round(number(values.get("texels", "100"), "texels", SIDES[0], SIDES[-1]))
    original = Path(values["original"]).expanduser() if "original" in values else None
    from_scan(source, texels, _file(out, ".png"), console, original, site)


def _file(out: Path, ending: str) -> Path:
    if out.suffix.lower() != ending:
        raise UserError(f"out={out}: the name must end in {ending}")
    if not out.absolute().parent.is_dir():
        raise UserError(f"out={out}: there is no folder {out.absolute().parent}")
    return out
