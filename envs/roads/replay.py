"""Recorded traffic in compiled code: cars that are replayed, until they must react and follow IDM.

Body n + 1 of an episode is track n of its scene; the body of the car whose place the ego has taken stays away.
"""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip
from cavbench.envs.roads.bodies import put_body, put_obstacle
from cavbench.envs.roads.collision import collide
from cavbench.envs.roads.lanes import update_lane
from cavbench.envs.roads.motion import move, update_direction
from cavbench.envs.roads.recordings import Reaction, Recordings, TrackRecord
from cavbench.envs.roads.state import Bodies, Body, Episode, Floats, Kind, Parameters, Road
from cavbench.envs.roads.traffic import act, new_places

IDM, OBSTACLE, RECORDED = int(Kind.IDM), int(Kind.OBSTACLE), int(Kind.RECORDED)
REPLAY, REACTIVE = int(Reaction.REPLAY), int(Reaction.REACTIVE)
AWAY = -1e6
"""Where bodies are that are not in the scene, in m: seen by nobody."""
FORESIGHT_S, SAMPLES, MARGIN = 2.0, 5, 2.0
"""A recorded car is released if it would come so near in m to a car that drives, within so many seconds."""
ALIGNED = 0.5
"""Cars that head more than this many rad across the lanes are always replayed."""
RECORDED_SPEED = 0.1
"""A released car wants to drive at least this fast, in m/s."""
BESIDE = 2.0
"""Lanes count as a car's own up to this many m beside it."""


@inner
def frame_of(track: TrackRecord, scene_frame: int) -> int:
    """The row of a track at a frame of the scene; -1 if it is not there."""
    if track.stands:
        return track.offset
    at = scene_frame - track.first
    return track.offset + at if 0 <= at < track.count else -1


@inner
def send_away(body: Body, kind: int) -> None:
    """Take a body out of the scene: for now (`RECORDED`) or for good (`OBSTACLE`)."""
    body.kind, body.x, body.y, body.speed = kind, AWAY, 0.0, 0.0
    body.along, body.across = AWAY, 0.0
    body.acceleration = body.steering = 0.0


@inner
def put_at(road: Road, body: Body, frames: Floats, row: int) -> None:
    """Put a body where its recording says."""
    body.x, body.y, body.heading, body.speed = frames[row, 0], frames[row, 1], frames[row, 2], frames[row, 3]
    update_direction(body)
    update_lane(body, road)
    body.target_lane = body.lane
    # What hits a recorded car does not stop it.
    body.crashed = body.impact = False


@inner
def is_on_lanes(road: Road, body: Body) -> bool:
    """Whether a body drives along one of the lanes."""
    return abs(body.across) <= road.lanes[body.lane].width / 2 and body.cos_heading > 0 and abs(body.heading) < ALIGNED


@inner
def near(first: Body, x: float, y: float, second: Body, other_x: float, other_y: float) -> bool:
    """Whether two bodies at these places are within the margin of each other along the road, and side by side across it."""
    along = (first.length + second.length) / 2 + MARGIN
    across = (first.width + second.width) / 2
    return abs(x - other_x) < along and abs(y - other_y) < across


@inner
def is_free(bodies: Bodies, cars: int, number: int) -> bool:
    """Whether no car that drives is where a body is."""
    body = bodies[number]
    free = True
    for other in range(cars):
        driven = bodies[other]
        if other != number and driven.kind not in (RECORDED, OBSTACLE):
            free &= not near(body, body.x, body.y, driven, driven.x, driven.y)
    return free


@inner
def meets(
    road: Road, body: Body, track: TrackRecord, frames: Floats, scene_frame: int, other: Body, parameters: Parameters
) -> bool:
    """Whether a recorded car will come near a car that drives, from behind or from the side.

    The other car keeps its speed, and is both where it is now and on the lane that it aims for.
    """
    if body.x >= other.x + (body.length + other.length) / 2:
        return False
    aims = road.lanes[other.target_lane].start_y
    for sample in range(SAMPLES):
        time = FORESIGHT_S * sample / (SAMPLES - 1)
        row = frame_of(track, scene_frame + round(time / parameters.dt))
        if row < 0:
            return False
        x = other.x + other.speed * other.cos_heading * time
        if near(body, frames[row, 0], frames[row, 1], other, x, other.y):
            return True
        if near(body, frames[row, 0], frames[row, 1], other, x, aims):
            return True
    return False


@inner
def must_react(
    road: Road, bodies: Bodies, episode: Episode, number: int, recordings: Recordings, parameters: Parameters
) -> bool:
    """Whether a recorded car will meet one that drives."""
    track = recordings.tracks[episode.first_track + number - 1]
    body, now = bodies[number], episode.begin + episode.frames
    for other in range(episode.cars):
        if other == number or bodies[other].kind in (RECORDED, OBSTACLE):
            continue
        if meets(road, body, track, recordings.frames, now, bodies[other], parameters):
            return True
    return False


@inner
def release(road: Road, body: Body, track: TrackRecord) -> None:
    """Let a recorded car follow IDM from now on, on the lane it is on, up to the highest speed of its recording."""
    body.kind = IDM
    body.target_lane = body.lane
    body.target_speed = max(track.fastest, RECORDED_SPEED)
    body.changes_lanes = False


@inner
def release_all(road: Road, bodies: Bodies, episode: Episode, recordings: Recordings, parameters: Parameters) -> None:
    """Release every recorded car that must react."""
    if episode.reaction == REPLAY:
        return
    for number in range(1, episode.cars):
        body = bodies[number]
        track = recordings.tracks[episode.first_track + number - 1]
        if body.kind != RECORDED or track.stands or body.x == AWAY or not is_on_lanes(road, body):
            continue
        if episode.reaction == REACTIVE or must_react(road, bodies, episode, number, recordings, parameters):
            release(road, body, track)


@inner
def replay(road: Road, bodies: Bodies, episode: Episode, number: int, recordings: Recordings) -> None:
    """Move a recorded car to its next frame. One that would enter where another car drives stays away for good."""
    body = bodies[number]
    track = recordings.tracks[episode.first_track + number - 1]
    row = frame_of(track, episode.begin + episode.frames)
    if row < 0 or number - 1 == episode.taken:
        send_away(body, RECORDED)
        return
    enters = body.x == AWAY
    put_at(road, body, recordings.frames, row)
    if enters and episode.reaction != REPLAY and not is_free(bodies, episode.cars, number):
        send_away(body, OBSTACLE)


@inner
def find_crash(bodies: Bodies, episode: Episode, dt: float, corners: Floats) -> None:
    """Test the ego against every other body. Recorded cars may touch each other: their places have errors."""
    ego = bodies[episode.ego]
    for number in range(episode.bodies):
        if number != episode.ego and bodies[number].x > AWAY:
            collide(ego, bodies[number], dt, corners)


@inner
def advance(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    frames: int,
    parameters: Parameters,
    corners: Floats,
    recordings: Recordings,
) -> None:
    """Drive some frames among recorded traffic."""
    places = new_places(road.lane_count, bodies.size)
    for _ in range(frames):
        release_all(road, bodies, episode, recordings, parameters)
        act(road, bodies, episode.cars, parameters, places)
        episode.frames += 1
        for number in range(episode.cars):
            body = bodies[number]
            if body.kind == RECORDED:
                replay(road, bodies, episode, number, recordings)
            elif body.kind != OBSTACLE:
                if body.kind == IDM:
                    # highway-env's IDM reverses behind a car that stands.
                    body.acceleration = max(body.acceleration, -body.speed / parameters.dt)
                move(road, body, parameters.dt)
                if body.kind == IDM and number != episode.ego and body.x > road.end + body.length:
                    send_away(body, OBSTACLE)
        find_crash(bodies, episode, parameters.dt, corners)


@inner
def spawn(road: Road, bodies: Bodies, episode: Episode, parameters: Parameters, recordings: Recordings) -> None:
    """Put the ego in the place of a recorded car, and all others where they were at that moment; the seed chooses which."""
    start = recordings.starts[episode.first_start + episode.seed % episode.start_count]
    episode.begin, episode.taken, episode.pace = start.frame, start.track, start.pace
    episode.ego, episode.cars, episode.frames = 0, 1 + episode.track_count, 0
    episode.bodies = episode.cars
    frames = recordings.frames
    row = frame_of(recordings.tracks[episode.first_track + start.track], start.frame)
    put_body(road, bodies[0], parameters.ego, frames[row, 0], frames[row, 1], frames[row, 2], frames[row, 3])
    if parameters.ego == IDM:
        bodies[0].target_speed = road.lanes[bodies[0].lane].speed_limit
    for number in range(1, episode.cars):
        track = recordings.tracks[episode.first_track + number - 1]
        put_obstacle(road, bodies[number], AWAY, 0.0)
        bodies[number].kind = RECORDED
        bodies[number].length, bodies[number].width = track.length, track.width
        row = frame_of(track, start.frame)
        if row >= 0 and number - 1 != start.track:
            put_at(road, bodies[number], frames, row)


@inner
def reward(ego: Body, episode: Episode, on_road: bool, parts: Floats) -> float:
    """1 for the pace of the recorded driver, less for a slower one, 0 for a crash or beside the road; `parts` [2]."""
    parts[0] = 1.0 if ego.crashed else 0.0
    parts[1] = clip(ego.speed * ego.cos_heading / episode.pace, 0.0, 1.0)
    if ego.crashed or not on_road:
        return 0.0
    return (1.0 + 0.5 * parts[1]) / 1.5
