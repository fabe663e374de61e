"""Films: what they show, the files, and `bench view --save` and `--web` from records."""

from __future__ import annotations

import signal
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from cavbench.driving.recording.episode import Episode
from cavbench.driving.recording.film import EpisodeFilm
from cavbench.driving.rollout import Trace
from cavbench.envs.highway.world import HighwayWorld
from cavbench.recording.film import save, stacked
from cavbench.recording.film.drawing import GREEN, SKY, VERMILLION
from tests.command import Said, started

Bench = Callable[..., Said]
FACTS = HighwayWorld().facts
META = {"victim": "dqn", "attack": "pgd", "cell": '{"lanes":3,"density":1.0,"weather":"clear"}', "seed": 7}


def film(steps: int = 12, shift: float = 0.05, *, crashed: bool = True) -> EpisodeFilm:
    """An episode with one car 20 m ahead in the next lane, which the attack shows `shift` too far."""
    observation = np.zeros((1, 3, 5), np.float32)
    observation[0, 0] = (1, 0.1, 0.2, 0.5, 0)
    observation[0, 1] = (1, 0.2, 0.2, -0.1, 0)
    perturbed = observation.copy()
    perturbed[0, 1, 1] += shift
    values: dict[str, Any] = {"observation": observation, "perturbed": perturbed, "action": np.array([3])}
    scores = np.array([[0.0, 0.1, 0.2, 1.0, 0.3]], np.float32)
    values |= {"scores": scores, "clean_scores": scores[:, ::-1].copy(), "queries": np.array([45])}
    values |= {name: np.array([1.0], np.float32) for name in ("reward", "progress", "speed", "ttc")}
    values |= {"running": np.array([True]), "offroad": np.array([False])}
    trace = Trace([0], {name: [value] * steps for name, value in values.items()})
    trace.steps["x"] = [np.array([float(step)]) for step in range(steps)]
    trace.steps["crashed"] = [np.array([crashed and step == steps - 1]) for step in range(steps)]
    return EpisodeFilm(Episode.of(trace, FACTS, META))


def count(picture: Any, colour: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - colour) <= 2).all(-1).sum())


def test_a_picture_shows_the_ego_the_cars_and_what_the_attack_shows() -> None:
    first, *_, last = film().pictures(12)
    area = 5 * 8 * 2 * 8
    assert count(first, GREEN) > 0.6 * area
    assert count(first, SKY) > 0.6 * area
    assert count(first, VERMILLION) > 100
    assert count(last, GREEN) < 0.5 * area, "after a crash the ego is no longer green"
    (clean,) = film(1, shift=0.0, crashed=False).pictures(1)
    assert count(clean, VERMILLION) == 0
    assert clean.shape[0] < first.shape[0], "an episode without an attack has no perturbation"


def test_films_together_last_as_long_as_the_longest() -> None:
    short, long = film(4), film(9)
    both = stacked([short, long])
    pictures = list(both.pictures(len(both)))
    assert len(pictures) == 9
    alone = list(short.pictures(4))
    held = pictures[-1][: alone[0].shape[0]]
    # Only the time axis is longer.
    assert np.array_equal(held[40:120], alone[-1][40:120])


@pytest.mark.parametrize("ending", [".gif", ".webp", ".mp4"])
def test_a_film_is_written_and_read_back(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"clip{ending}"
    save(film(18), path, seconds=(0.2, 0.8))
    reader: Any = cv2.VideoCapture(str(path)) if ending == ".mp4" else Image.open(path)
    if ending == ".mp4":
        assert reader.get(cv2.CAP_PROP_FPS) == 15
        assert reader.read()[1].shape[1] == 960
    else:
        assert (reader.size[0], reader.n_frames) == (960, 5)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(("name", "seconds"), [("clip.avi", None), ("clip.gif", (3, 2))])
def test_what_cannot_be_written_is_refused(name: str, seconds: Any, tmp_path: Path) -> None:
    from cavbench.errors import UserError

    with pytest.raises(UserError):
        save(film(), tmp_path / name, seconds=seconds)
    assert not list(tmp_path.iterdir())


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    import cavbench

    out = tmp_path_factory.mktemp("results")
    world = HighwayWorld(max_steps=20)
    cavbench.score(
        "dqn", "noise", world=world, lanes=3, density=1, weather="clear", episodes=2, seeds=[0], record=1,
        baselines=False, out=out,
    )  # fmt: skip
    return out


def test_records_and_recordings_are_saved_side_by_side(bench: Bench, results: Path, tmp_path: Path) -> None:
    (recording,) = results.glob("recordings/noise*/*.rrd")
    words = ("none-none-dqn", str(recording), "--out", str(results), "--save", str(tmp_path / "clip.gif"))
    said = bench("view", *words)
    assert said.code == 0, said.err
    assert "differs" not in said.out
    assert Image.open(tmp_path / "clip.gif").n_frames == 10
    for bad, line in (
        (("view", "none-none-dqn", "noise-none", "--out", str(results)), "need --save FILE"),
        (("view", *words[:4], "--save", "clip.txt"), "must end in .gif, .webp, .mp4"),
        (("view", *words, "--seconds", "3"), "--seconds takes FROM:TO"),
    ):
        refused = bench(*bad)
        assert (refused.code, line in refused.err) == (2, True), refused.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, -signal.SIGTERM), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_the_web_viewer_is_served_to_this_machine_only_and_ends_with_the_command(
    results: Path, tmp_path: Path, number: int, code: int
) -> None:
    import psutil

    (recording,) = results.glob("recordings/noise*/*.rrd")
    process = started(tmp_path, "view", str(recording), "--web")
    assert process.stdout is not None
    line = process.stdout.readline()
    address = next(word for word in line.split() if word.startswith("http://127.0.0.1:"))
    with urllib.request.urlopen(address, timeout=30) as page:
        assert b"rerun" in page.read().lower()
    servers = psutil.Process(process.pid).children(recursive=True)
    listening = {
        one.laddr.ip for server in servers for one in server.net_connections() if one.status == psutil.CONN_LISTEN
    }
    assert listening == {"127.0.0.1"}
    process.send_signal(number)
    assert process.wait(timeout=60) == code
    assert not psutil.wait_procs(servers, timeout=30)[1]
