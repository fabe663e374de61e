"""Physics frames: highway-env's AbstractEnv._simulate and Road.step."""

from __future__ import annotations

from cavbench.compiled import inner
from cavbench.envs.roads.collision import find_collisions
from cavbench.envs.roads.motion import move
from cavbench.envs.roads.regulation import enforce_rules
from cavbench.envs.roads.sliding import slide
from cavbench.envs.roads.state import Bodies, Episode, Floats, Kind, Parameters, Road
from cavbench.envs.roads.traffic import act, new_places

IDM = int(Kind.IDM)


@inner
def advance(road: Road, bodies: Bodies, episode: Episode, frames: int, parameters: Parameters, corners: Floats) -> None:
    """Drive some frames; `bodies` are those of the episode, without the empty records after them."""
    places = new_places(road.lane_count, bodies.size)
    for _ in range(frames):
        act(road, bodies, episode.cars, parameters, places)
        if parameters.ego == IDM and episode.ego >= 0:
            # highway-env's IDM reverses behind a car that stands; a rule-based driver of the ego does not.
            ego = bodies[episode.ego]
            ego.acceleration = max(ego.acceleration, -ego.speed / parameters.dt)
        episode.frames += 1
        if parameters.regulation > 0 and episode.frames % parameters.regulation == 0:
            enforce_rules(road, bodies, episode.cars)
        for number in range(episode.cars):
            if bodies[number].slides:
                slide(road, bodies[number], parameters.dt)
            else:
                move(road, bodies[number], parameters.dt)
        find_collisions(bodies, episode.cars, parameters.dt, corners)
