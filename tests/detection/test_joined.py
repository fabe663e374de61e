"""Who knows what: a universal patch is crafted on the training places, one for a site on the approach that is scored."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest
import torch

from cavbench.core.track import track
from cavbench.detection.joined import Joined
from cavbench.detection.patch import Patch, read_all, written_together
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.run import runner
from cavbench.run.config import plan_of
from tests.plugins.toy_camera import RedScenes, RedStreet
from tests.run.test_runner import Silent

pytestmark = pytest.mark.usefixtures("toy_folder")

WORDS = ["victim=red", "world=red_street", "lanes=3", "density=1", "seeds=0", "executor=serial", "record=0"]


@pytest.fixture(autouse=True)
def without_reference_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavbench.detection.track.REFERENCE_PATCHES", ())


def driven(out: Path, *more: str) -> pa.Table:
    """The records of attacked episodes."""
    units = runner.run(plan_of([*WORDS, f"out={out}", *more]), Silent())
    records = reading.read(out, units, track=track("detection"))
    return records.filter(pc.field("attack") == "paint")


def shown(out: Path, records: pa.Table) -> list[list[float]]:
    """The distances in m that the attack was shown, one list for each patch of the records, in their order."""
    found = []
    for name in dict.fromkeys(records["patch"].to_pylist()):
        for patch in read_all((out / "patches" / f"{name}.safetensors").read_bytes()):
            assert patch.texels is not None
            found.append([round(1000 * value, 3) for value in patch.texels.flatten().tolist() if value])
    return found


def distances(cell: dict[str, object], seeds: range) -> list[list[float]]:
    world = RedStreet()
    approaches = world.approaches(world.axes.cell(**cell), seeds)
    return [[round(value, 3) for value in one.scenes.distance.tolist()] for one in approaches]


@pytest.mark.parametrize("knows", ["universal", "site", "scene"])
def test_an_attack_is_shown_the_scored_frames_only_if_the_threat_model_says_so(tmp_path: Path, knows: str) -> None:
    records = driven(tmp_path, "attack=paint", "attack.mood=mindful", "weather=clear,fog", f"threat.knows={knows}")
    assert set(records["threat_norm"].to_pylist()) == {"patch" if knows == "universal" else f"patch+knows={knows}"}
    found = shown(tmp_path, records)
    cell = {"lanes": 3, "density": 1.0}
    first = min(records["seed"].to_pylist())
    scored = {w: distances(cell | {"weather": w}, range(first, first + 3)) for w in ("clear", "fog")}
    if knows == "universal":
        assert found == [[float(value) for value in range(8, 31, 2)]]
    elif knows == "site":
        # One file for both weathers: each patch of three was crafted on the approach in four weathers.
        assert found == [frames * 4 for frames in scored["clear"]]
    else:
        assert found == [*scored["clear"], *scored["fog"]]


def test_each_approach_is_scored_with_its_own_patch(tmp_path: Path) -> None:
    records = driven(tmp_path, "attack=paint", "attack.mood=mindful", "weather=clear", "threat.knows=scene")
    assert records.num_rows == 3
    assert len(set(records["patch_sha256"].to_pylist())) == 3
    assert len(set(records["patch"].to_pylist())) == 1


def test_what_is_known_is_not_allowed_is_one_line() -> None:
    with pytest.raises(UserError) as refused:
        plan_of([*WORDS, "attack=paint", "threat.knows=everything"])
    assert len(str(refused.value).splitlines()) == 1
    assert "universal" in str(refused.value)


def test_joined_scenes_are_their_parts() -> None:
    parts = [RedScenes(torch.linspace(30, 8, 4)), RedScenes(torch.linspace(20, 9, 3), 0.02)]
    joined = Joined(parts)
    assert len(joined) == 7
    frames, patches = torch.tensor([5, 0, 6, 3]), torch.rand(4, 3, 8, 8)
    pictures = joined.render(frames, patches, 0.5)
    for place, (part, frame) in enumerate([(1, 1), (0, 0), (1, 2), (0, 3)]):
        alone = parts[part].render(torch.tensor([frame]), patches[place : place + 1], 0.5)[0]
        assert torch.equal(pictures[place], alone)
    assert torch.equal(joined.reach(0.5), torch.cat([part.reach(0.5) for part in parts]))


def test_a_file_of_several_patches_is_checked() -> None:
    patches = [Patch(texels=torch.full((3, 8, 8), level), queries=7) for level in (0.25, 0.5)]
    content = written_together(patches, "{}")
    assert [one.sha256 for one in read_all(content)] == [one.sha256 for one in patches]
    assert [one.queries for one in read_all(patches[0].written("{}"))] == [7]
    changed = content.replace(patches[1].sha256.encode(), patches[0].sha256.encode())
    with pytest.raises(UserError, match="changed since it was written"):
        read_all(changed)
    with pytest.raises(UserError, match="truncated or foreign"):
        read_all(content[:-4])
