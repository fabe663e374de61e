"""Reads scenes of CommonRoad (https://commonroad.in.tum.de) in XML, versions 2020a and 2018b. Nothing of a file is executed.

Where CommonRoad's own readers differ from each other, or guess, a file is refused: an id that stands twice, a time step that is
missing, a state that is an interval.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from cavbench.envs.recorded.scene import Floats, Lanelet, Problem, Recording, Track
from cavbench.errors import UserError, short
from cavbench.formats import markup
from cavbench.formats.markup import Element

VERSIONS = ("2020a", "2018b")
OBSTACLES = ("dynamicObstacle", "staticObstacle", "obstacle")
"""Elements of road users; that of 2018b says by its role what it is."""
MOST_LANELETS, MOST_TRACKS, MOST_STATES, MOST_POINTS = 2_000, 1_000, 200_000, 100_000
LONGEST_S, LARGEST_M = 600.0, 40.0
"""Most seconds of a recording, and the longest road user in m."""
FASTEST = 100.0
"""Largest speed in m/s."""


def read(path: Path, name: str = "") -> Recording:
    """A scene in a file.

    Args:
        path: the file.
        name: the file in errors; its path if there is none.

    Raises:
        UserError: in one line, if it is no scene of a version that is read, or cannot be replayed.
    """
    name = name or str(path)
    root = markup.read(path, name=name)
    try:
        return recording(root, name)
    except ValueError as error:
        raise UserError(f"{name} cannot be driven: {error}") from None


def recording(root: Element, name: str) -> Recording:
    """The scene in a document, by a name for errors.

    Raises:
        ValueError: in one line, as of `read`.
    """
    if root.tag != "commonRoad":
        raise ValueError(f"it is a file of <{short(root.tag)}>, not of <commonRoad>")
    version = root.attribute("commonRoadVersion")
    if version not in VERSIONS:
        raise ValueError(f"it has the version {short(version)!r} of CommonRoad, not {' or '.join(VERSIONS)}")
    step_s = markup.number(root.attribute("timeStepSize"), "timeStepSize")
    if not 0.01 <= step_s <= 1:
        raise ValueError(f"its time step is {step_s:g} s, allowed are 0.01 to 1")
    lanelets = _lanelets(root)
    tracks = tuple(_tracks(root, step_s))
    _distinct([*lanelets.values(), *tracks], "id")
    if tracks and (longest := max(track.first + len(track.states) for track in tracks) * step_s) > LONGEST_S:
        raise ValueError(f"it lasts {longest:.0f} s, at most {LONGEST_S:.0f} s are read")
    problems = tuple(_problem(element) for element in root.all("planningProblem"))
    return Recording(name=name, version=version, step_s=step_s, lanelets=lanelets, tracks=tracks, problems=problems)


def _identity(element: Element) -> int:
    return markup.whole(element.attribute("id"), f"line {element.line}: the id of <{element.tag}>")


def _distinct(found: Iterable[Lanelet | Track], what: str) -> None:
    seen: set[int] = set()
    for one in found:
        if one.number in seen:
            raise ValueError(f"{what} {one.number} stands twice")
        seen.add(one.number)


def _lanelets(root: Element) -> dict[int, Lanelet]:
    elements = list(root.all("lanelet"))
    if not elements:
        raise ValueError("it has no lanes (<lanelet>)")
    if len(elements) > MOST_LANELETS:
        raise ValueError(f"it has {len(elements)} lanelets, at most {MOST_LANELETS} are read")
    found: list[Lanelet] = []
    points = 0
    for element in elements:
        found.append(_lanelet(element))
        points += len(found[-1].left)
        if points > MOST_POINTS:
            raise ValueError(f"its lanelets have more than {MOST_POINTS} points")
    _distinct(found, "lanelet")
    return {one.number: one for one in found}


def _lanelet(element: Element) -> Lanelet:
    number = _identity(element)
    left, right = (_border(element.need(side)) for side in ("leftBound", "rightBound"))
    if len(left) != len(right) or len(left) < 2:
        raise ValueError(
            f"lanelet {number} has {len(left)} and {len(right)} points; it needs as many on both sides, at least 2"
        )
    return Lanelet(
        number=number,
        left=left,
        right=right,
        before=_references(element, "predecessor"),
        after=_references(element, "successor"),
        beside=(_neighbour(element, "adjacentLeft"), _neighbour(element, "adjacentRight")),
    )


def _border(element: Element) -> Floats:
    return np.array([_point(point) for point in element.all("point")]).reshape(-1, 2)


def _point(element: Element) -> tuple[float, float]:
    return element.need("x").number(), element.need("y").number()


def _references(element: Element, tag: str) -> tuple[int, ...]:
    return tuple(
        markup.whole(child.attribute("ref"), f"line {child.line}: the ref of <{tag}>") for child in element.all(tag)
    )


def _neighbour(element: Element, tag: str) -> int | None:
    """The lanelet at a side, if it leads in the same direction."""
    child = element.get(tag)
    if child is None:
        return None
    direction = child.attribute("drivingDir")
    if direction not in ("same", "opposite"):
        raise ValueError(f"line {child.line}: drivingDir must be same or opposite, got {short(direction)!r}")
    return _references(element, tag)[0] if direction == "same" else None


def _tracks(root: Element, step_s: float) -> Iterable[Track]:
    elements = list(root.all(*OBSTACLES))
    if len(elements) > MOST_TRACKS:
        raise ValueError(f"it has {len(elements)} road users, at most {MOST_TRACKS} are read")
    states = 0
    for element in elements:
        track = _track(element, step_s)
        states += len(track.states)
        if states > MOST_STATES:
            raise ValueError(f"its road users have more than {MOST_STATES} states")
        yield track


def _track(element: Element, step_s: float) -> Track:
    number, trajectory = _identity(element), element.get("trajectory")
    standing = element.tag == "staticObstacle"
    if element.tag == "obstacle":
        role = element.need("role").word()
        if role not in ("dynamic", "static"):
            raise ValueError(f"obstacle {number} has the role {short(role)!r}, not dynamic or static")
        standing = role == "static"
    if element.get("occupancySet") is not None:
        raise ValueError(f"obstacle {number} has sets of places (<occupancySet>), not a trajectory")
    states = [element.need("initialState"), *(trajectory.all("state") if trajectory is not None else ())]
    first = states[0].need("time").need("exact").count()
    if first < 0:
        raise ValueError(f"obstacle {number} begins at time step {first}, the first one is 0")
    for place, state in enumerate(states):
        step = state.need("time").need("exact").count()
        if step != first + place:
            raise ValueError(
                f"obstacle {number} has time step {step} where {first + place} is due: steps must follow each other"
            )
    length, width, middle = _box(element.need("shape"), number)
    places = np.array([_state(state, f"obstacle {number}") for state in states])
    if np.isnan(places[:, 3]).any():
        places[:, 3] = _speeds(places, step_s)
    if (fastest := float(np.abs(places[:, 3]).max())) > FASTEST:
        raise ValueError(f"obstacle {number} drives at {fastest:g} m/s, at most {FASTEST:g} are allowed")
    cos, sin = np.cos(places[:, 2]), np.sin(places[:, 2])
    places[:, 0] += cos * middle[0] - sin * middle[1]
    places[:, 1] += sin * middle[0] + cos * middle[1]
    kind = element.need("type").word()
    return Track(number=number, kind=kind, length=length, width=width, first=first, states=places, moves=not standing)


def _speeds(places: Floats, step_s: float) -> Floats:
    """Speeds from places, for files that leave them out."""
    if len(places) == 1:
        return np.zeros(1)
    driven = np.hypot(*np.diff(places[:, :2], axis=0).T) / step_s
    return np.append(driven, driven[-1])


def _state(element: Element, who: str) -> tuple[float, float, float, float]:
    """x, y, heading and speed; NaN for a speed that is left out."""
    position, velocity = element.need("position"), element.get("velocity")
    if position.get("point") is None:
        raise ValueError(f"line {element.line}: {who} is at a region, not at a <point>")
    x, y = _point(position.need("point"))
    return x, y, _exact(element.need("orientation"), who), math.nan if velocity is None else _exact(velocity, who)


def _exact(element: Element, who: str) -> float:
    if element.get("exact") is None:
        raise ValueError(f"line {element.line}: the {element.tag} of {who} is an interval, not an <exact> value")
    return element.need("exact").number()


def _box(shape: Element, number: int) -> tuple[float, float, tuple[float, float]]:
    """Length and width of the rectangle around a road user that heads along x, and the middle of the rectangle."""
    corners: list[Sequence[float]] = []
    for part in shape.children:
        if part.tag == "rectangle":
            corners += _rectangle(part)
        elif part.tag == "circle":
            radius, (x, y) = part.need("radius").number(), _centre(part)
            corners += [(x - radius, y - radius), (x + radius, y + radius)]
        elif part.tag == "polygon":
            corners += [_point(point) for point in part.all("point")]
        else:
            raise ValueError(f"line {part.line}: obstacle {number} has the shape {short(part.tag)!r}")
    if not corners:
        raise ValueError(f"obstacle {number} has no shape")
    low, high = np.min(corners, 0), np.max(corners, 0)
    length, width = (float(side) for side in high - low)
    if not (0 < length <= LARGEST_M and 0 < width <= LARGEST_M):
        raise ValueError(
            f"obstacle {number} is {length:g} m long and {width:g} m wide, allowed are up to {LARGEST_M:g} m"
        )
    return length, width, (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2)


def _centre(element: Element) -> tuple[float, float]:
    centre = element.get("center")
    return (0.0, 0.0) if centre is None else _point(centre)


def _rectangle(element: Element) -> list[Sequence[float]]:
    length, width, (x, y) = element.need("length").number(), element.need("width").number(), _centre(element)
    turned = element.get("orientation")
    angle = 0.0 if turned is None else turned.number()
    cos, sin = math.cos(angle), math.sin(angle)
    ends = [(a * length / 2, b * width / 2) for a in (-1, 1) for b in (-1, 1)]
    return [(x + cos * a - sin * b, y + sin * a + cos * b) for a, b in ends]


def _problem(element: Element) -> Problem:
    number, state = _identity(element), element.need("initialState")
    x, y, heading, speed = _state(state, f"planning problem {number}")
    return Problem(number=number, x=x, y=y, heading=heading, speed=0.0 if math.isnan(speed) else speed)
