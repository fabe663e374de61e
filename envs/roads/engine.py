"""The engine of road networks: B episodes at once, with the results of highway-env at every step.

Episodes are independent. A finished episode does not change, and costs no time, until it is reset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner, uncounted
from cavbench.envs.highway.ego import FASTER, IDLE, SLOWER
from cavbench.envs.highway.engine import PROGRESS, REWARD, Flag, Number, X, check_seeds, physical_controls
from cavbench.envs.highway.engine import report as copy_record
from cavbench.envs.roads import exit_rules as leave
from cavbench.envs.roads import intersection_rules as intersection
from cavbench.envs.roads import merge_rules as merge
from cavbench.envs.roads import racetrack_rules as racetrack
from cavbench.envs.roads import replay
from cavbench.envs.roads import roundabout_rules as roundabout
from cavbench.envs.roads import two_way_rules as two_way
from cavbench.envs.roads import u_turn_rules as u_turn
from cavbench.envs.roads.bodies import settle_ego
from cavbench.envs.roads.config import RoadsConfig, Scene, TaskKind, parameters
from cavbench.envs.roads.generator import WORDS, Generator, seed_generator
from cavbench.envs.roads.grids import occupancy, times_to_collision
from cavbench.envs.roads.lanes import is_on
from cavbench.envs.roads.motion import apply_meta_action
from cavbench.envs.roads.network import ROAD, WIDTH
from cavbench.envs.roads.progress import progress, way_left
from cavbench.envs.roads.recordings import Recordings, joined
from cavbench.envs.roads.rows import observe
from cavbench.envs.roads.simulation import advance
from cavbench.envs.roads.state import (
    BODY,
    EPISODE,
    PLACE,
    Bodies,
    Body,
    Episode,
    Floats,
    Integers,
    Kind,
    Measure,
    Parameters,
    Road,
    ViewKind,
)
from cavbench.envs.roads.traffic import find_places, lane_distance, neighbours_in

MOST_SIDE_LANES = 16
OF_SCENE = (
    "traffic",
    "oncoming",
    "density",
    "opposing",
    "arrivals",
    "goal",
    "sensor_range",
    "noise_sigma",
    "reaction",
)
"""Fields of a scene that its episode has, too."""
PARTS = 5
"""Largest number of parts of a task's reward."""
MERGE_CLASSIC, MERGE_GENERIC = int(TaskKind.MERGE_CLASSIC), int(TaskKind.MERGE_GENERIC)
ROUNDABOUT, INTERSECTION, EXIT = int(TaskKind.ROUNDABOUT), int(TaskKind.INTERSECTION), int(TaskKind.EXIT)
TWO_WAY, U_TURN, RACETRACK = int(TaskKind.TWO_WAY), int(TaskKind.U_TURN), int(TaskKind.RACETRACK)
RECORDED = int(TaskKind.RECORDED)
OCCUPANCY, TIMES = int(ViewKind.OCCUPANCY), int(ViewKind.TIMES)
DISCRETE, CONTINUOUS = int(Kind.DISCRETE), int(Kind.CONTINUOUS)
WAY, PACE = int(Measure.WAY), int(Measure.PACE)


@inner
def spawn(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    generator: Generator,
    parameters: Parameters,
    corners: Floats,
    recordings: Recordings,
) -> None:
    """The start of an episode, from its random numbers."""
    if parameters.task == MERGE_CLASSIC:
        merge.spawn_classic(road, bodies, episode, generator, parameters)
    elif parameters.task == MERGE_GENERIC:
        merge.spawn_generic(road, bodies, episode, generator, parameters)
    elif parameters.task == ROUNDABOUT:
        roundabout.spawn(road, bodies, episode, generator, parameters)
    elif parameters.task == INTERSECTION:
        intersection.spawn(road, bodies, episode, generator, parameters, corners)
    elif parameters.task == EXIT:
        leave.spawn(road, bodies, episode, generator, parameters)
    elif parameters.task == TWO_WAY:
        two_way.spawn(road, bodies, episode, generator, parameters)
    elif parameters.task == U_TURN:
        u_turn.spawn(road, bodies, episode, generator, parameters)
    elif parameters.task == RECORDED:
        replay.spawn(road, bodies, episode, parameters, recordings)
    else:
        racetrack.spawn(road, bodies, episode, generator, parameters)
    ego = bodies[episode.ego]
    settle_ego(ego, parameters)
    episode.driven, episode.arrived = 0.0, False
    episode.ahead = way_left(road, ego) if parameters.progress == WAY else ego.x
    episode.range_y = WIDTH * road.edges[road.lanes[ego.lane].edge].lanes


@inner
def reward(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    action: int,
    control: Floats,
    on_road: bool,
    parameters: Parameters,
    parts: Floats,
) -> float:
    """The reward of the task, and its parts."""
    ego = bodies[episode.ego]
    if parameters.task == ROUNDABOUT:
        return roundabout.reward(bodies, episode, action, on_road, parameters, parts)
    if parameters.task == INTERSECTION:
        return intersection.reward(road, ego, on_road, parameters, parts)
    if parameters.task == EXIT:
        return leave.reward(road, ego, parameters, parts)
    if parameters.task == TWO_WAY:
        return two_way.reward(road, bodies, episode, parameters, parts)
    if parameters.task == U_TURN:
        return u_turn.reward(road, bodies, episode, on_road, parameters, parts)
    if parameters.task == RACETRACK:
        return racetrack.reward(road, ego, control[2], on_road, parts)
    if parameters.task == RECORDED:
        return replay.reward(ego, episode, on_road, parts)
    return merge.reward(road, bodies, episode, action, parameters, parts)


@inner
def look(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    parameters: Parameters,
    rows: Integers,
    work: Floats,
    grid: NDArray[np.float64],
    observation: NDArray[np.float32],
) -> None:
    """Fill an observation; `rows`, `work` and `grid` are work arrays."""
    if parameters.layout == OCCUPANCY:
        occupancy(road, bodies, episode, observation)
    elif parameters.layout == TIMES:
        times_to_collision(road, bodies, episode, parameters, grid, observation)
    else:
        observe(road, bodies, episode, parameters, rows, work, observation)


@inner
def score(
    road: Road, bodies: Bodies, episode: Episode, action: int, control: Floats, parameters: Parameters, parts: Floats
) -> None:
    """Update the episode's record after one decision; reward and progress are sums over a held action."""
    ego = bodies[episode.ego]
    on_road = is_on(road.lanes[ego.lane], ego.along, ego.across, 0.0)
    episode.reward += reward(road, bodies, episode, action, control, on_road, parameters, parts)
    episode.crashed = ego.crashed
    near = on_road or is_on(road.lanes[ego.lane], ego.along, ego.across, parameters.shoulder)
    episode.offroad = not near or road.astray[ego.lane] > 0
    episode.driven += ego.speed * parameters.period
    episode.arrived = ego.x > road.end or (parameters.task == INTERSECTION and intersection.has_arrived(road, ego))
    if not (episode.offroad or ego.crashed):
        episode.progress += progress(road, bodies, episode, parameters)
        if parameters.progress == WAY and way_left(road, ego) <= 0.0:
            episode.arrived = True
            episode.progress += parameters.full_steps - episode.steps
        elif parameters.progress == PACE and episode.arrived:
            episode.progress += parameters.full_steps - episode.steps
    episode.terminated = ego.crashed or episode.arrived or (parameters.offroad_terminal and episode.offroad)
    episode.truncated = episode.steps >= parameters.max_steps or episode.time >= parameters.duration


@inner
def time_to_collision(road: Road, bodies: Bodies, episode: Episode) -> float:
    """Seconds until the ego hits the body ahead in its lane at their current speeds; inf if never."""
    ego = bodies[episode.ego]
    on_lane = np.empty(1 + bodies.size, PLACE)
    find_places(road, bodies, ego.lane, on_lane)
    leader, _ = neighbours_in(on_lane, episode.ego, ego.along)
    if leader < 0:
        return np.inf
    other = bodies[leader]
    closing = ego.speed - other.speed * (other.cos_heading * ego.cos_heading + other.sin_heading * ego.sin_heading)
    if closing <= 0:
        return np.inf
    return max(lane_distance(road, ego, other) - (ego.length + other.length) / 2, 0.0) / closing


@inner
def apply_action(road: Road, ego: Body, action: int, control: Floats, first: bool, parameters: Parameters) -> None:
    """Apply the action to the ego; if an action is held, a lane change is applied only the `first` time."""
    if parameters.ego == DISCRETE:
        held = first or action in (FASTER, SLOWER)
        apply_meta_action(road, ego, action if held else IDLE, parameters)
    elif parameters.ego == CONTINUOUS:
        ego.acceleration, ego.steering = control[0], control[1]


@inner
def drive(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    action: int,
    control: Floats,
    parameters: Parameters,
    corners: Floats,
    parts: Floats,
    recordings: Recordings,
) -> None:
    """One action of one episode: up to `action_repeat` decisions, fewer if the episode ends."""
    episode.reward = episode.progress = 0.0
    for held in range(parameters.action_repeat):
        apply_action(road, bodies[episode.ego], action, control, held == 0, parameters)
        episode.time += parameters.period
        there = bodies[: episode.bodies]
        if parameters.task == RECORDED:
            replay.advance(road, there, episode, parameters.substeps, parameters, corners, recordings)
        else:
            advance(road, there, episode, parameters.substeps, parameters, corners)
        episode.steps += 1
        score(road, bodies, episode, action, control, parameters, parts)
        if episode.terminated or episode.truncated:
            break


@inner
def report(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    parameters: Parameters,
    numbers: NDArray[np.float32],
    flags: NDArray[np.bool_],
    number: int,
) -> None:
    """Copy an episode's record into column `number` of the outputs; where roads bend, x is the distance driven."""
    episode.ttc = time_to_collision(road, bodies[: episode.bodies], episode)
    copy_record(bodies[episode.ego], episode, numbers, flags, number)
    if parameters.odometer:
        numbers[X, number] = episode.driven


@entry_point
def step_batch(
    roads: NDArray[np.void],
    bodies: NDArray[np.void],
    episodes: NDArray[np.void],
    actions: Integers,
    controls: Floats,
    paused: NDArray[np.bool_],
    generators: NDArray[np.uint64],
    parameters: NDArray[np.void],
    observation: NDArray[np.float32],
    numbers: NDArray[np.float32],
    flags: NDArray[np.bool_],
    parts: Floats,
    recordings: Recordings,
) -> bool:
    """One action of every unfinished episode, or False and nothing if there is no such action. See `RoadsEngine.step`."""
    corners, given = np.empty((2, 5, 2)), parameters[0]
    for number in range(episodes.size):
        if not 0 <= actions[number] < given.choices:
            return False
    rows, work = np.empty(observation.shape[1] - 1, np.int64), np.empty(observation.shape[1] + 3)
    grid = np.zeros((given.speeds, MOST_SIDE_LANES, max(given.horizon, 1)))
    for number in range(episodes.size):
        episode, cars = episodes[number], uncounted(bodies[number])
        if paused[number] or episode.terminated or episode.truncated:
            numbers[REWARD, number] = 0.0
            numbers[PROGRESS, number] = 0.0
            continue
        road = roads[episode.network]
        action = given.actions[actions[number]]
        drive(road, cars, episode, action, controls[number], given, corners, parts[number], recordings)
        look(road, cars, episode, given, rows, work, grid, observation[number])
        report(road, cars, episode, given, numbers, flags, number)
        if given.task == INTERSECTION:
            intersection.after_step(road, cars, episode, generators[number])
    return True


@entry_point
def start_batch(
    roads: NDArray[np.void],
    bodies: NDArray[np.void],
    episodes: NDArray[np.void],
    chosen: Integers,
    seeds: Integers,
    generators: NDArray[np.uint64],
    parameters: NDArray[np.void],
    observation: NDArray[np.float32],
    numbers: NDArray[np.float32],
    flags: NDArray[np.bool_],
    recordings: Recordings,
) -> bool:
    """Start the episodes `chosen` [R] from `seeds` [R], or nothing and False if one is negative. See `RoadsEngine.reset`."""
    for row in range(seeds.size):
        if seeds[row] < 0:
            return False
    rows, work = np.empty(observation.shape[1] - 1, np.int64), np.empty(observation.shape[1] + 3)
    corners, given = np.empty((2, 5, 2)), parameters[0]
    grid = np.zeros((given.speeds, MOST_SIDE_LANES, max(given.horizon, 1)))
    for row in range(chosen.size):
        number = chosen[row]
        episode, cars = episodes[number], uncounted(bodies[number])
        road = roads[episode.network]
        episode.seed, episode.steps, episode.frames, episode.time = seeds[row], 0, 0, 0.0
        episode.reward = episode.progress = 0.0
        episode.crashed = episode.offroad = episode.terminated = episode.truncated = False
        seed_generator(generators[number], seeds[row])
        spawn(road, cars, episode, generators[number], given, corners, recordings)
        look(road, cars, episode, given, rows, work, grid, observation[number])
        report(road, cars, episode, given, numbers, flags, number)
    return True


@entry_point
def look_batch(
    roads: NDArray[np.void],
    bodies: NDArray[np.void],
    episodes: NDArray[np.void],
    parameters: NDArray[np.void],
    observation: NDArray[np.float32],
    numbers: NDArray[np.float32],
    flags: NDArray[np.bool_],
) -> None:
    """Write the observation and the record of every episode. See `RoadsEngine.look`."""
    rows, work = np.empty(observation.shape[1] - 1, np.int64), np.empty(observation.shape[1] + 3)
    given = parameters[0]
    grid = np.zeros((given.speeds, MOST_SIDE_LANES, max(given.horizon, 1)))
    for number in range(episodes.size):
        episode, cars = episodes[number], uncounted(bodies[number])
        look(roads[episode.network], cars, episode, given, rows, work, grid, observation[number])
        report(roads[episode.network], cars, episode, given, numbers, flags, number)


class RoadsEngine:
    """B episodes of `config`, in numpy. The engine owns the outputs and overwrites them in the next call.

    Attributes:
        observation: float32 [B, V, F].
        numbers: float32 [5, B]; rows as in `cavbench.envs.highway.engine.Number`.
        flags: bool [5, B]; rows as in `cavbench.envs.highway.engine.Flag`.
        parts: [B, 5] the parts of the last reward, in the order of highway-env's `_rewards`.
        bodies: [B, N] records `BODY`.
        episodes: [B] records `EPISODE`.
    """

    def __init__(self, config: RoadsConfig) -> None:
        batch = config.batch
        self.config = config
        different: dict[int, Scene] = {id(scene.road): scene for scene in config.scenes}
        scenes, places = list(different.values()), {key: place for place, key in enumerate(different)}
        # The very dtype: numba finds the type of an array fast by that object, and compares all its fields by any other.
        self.roads = np.concatenate([scene.road for scene in scenes]).view(ROAD)
        self.parameters = parameters(config)
        self.bodies = np.zeros((batch, max(scene.capacity for scene in config.scenes)), dtype=BODY)
        self.episodes = np.zeros(batch, dtype=EPISODE)
        self.generators = np.zeros((batch, WORDS), dtype=np.uint64)
        self.observation = np.zeros((batch, *config.observed), dtype=np.float32)
        self.numbers = np.zeros((len(Number), batch), dtype=np.float32)
        self.flags = np.zeros((len(Flag), batch), dtype=np.bool_)
        self.parts = np.zeros((batch, PARTS))
        recorded = {id(scene.recordings): scene.recordings for scene in config.scenes}
        self.recordings, bounds = joined(list(recorded.values()))
        parts = [list(recorded).index(id(scene.recordings)) for scene in config.scenes]
        for column, name in enumerate(("first_track", "track_count", "first_start", "start_count")):
            self.episodes[name] = bounds[parts, column]
        self.episodes["network"] = [places[id(scene.road)] for scene in config.scenes]
        for name in OF_SCENE:
            self.episodes[name] = [getattr(scene, name) for scene in config.scenes]
        # No episode runs before its reset.
        self.episodes["truncated"] = True
        self._no_actions = np.full(batch, IDLE, dtype=np.int64)
        self._no_controls = np.zeros((batch, 3))
        self._no_pause = np.zeros(batch, dtype=np.bool_)

    def reset(self, chosen: NDArray[np.int64], seeds: NDArray[np.int64]) -> None:
        """Start the episodes `chosen` [R] (row numbers) from the scenario seeds [R].

        Raises:
            ValueError: if a seed is negative.
        """
        started = start_batch(
            self.roads,
            self.bodies,
            self.episodes,
            chosen,
            seeds,
            self.generators,
            self.parameters,
            self.observation,
            self.numbers,
            self.flags,
            self.recordings,
        )
        if not started:
            check_seeds(seeds)

    def look(self) -> None:
        """Write the current observation and record of every episode, without a step."""
        look_batch(self.roads, self.bodies, self.episodes, self.parameters, self.observation, self.numbers, self.flags)

    def controls(self, action: NDArray[np.floating]) -> Floats:
        """[B, 3] acceleration in m/s2, steering in rad, and the size of the action; one column [B, 1] is steering alone."""
        both = action if action.shape[1] == 2 else np.concatenate([np.zeros_like(action), action], 1)
        return np.concatenate(
            [physical_controls(both, self.config.steering_limit), np.linalg.norm(action, axis=1)[:, None]], 1
        )

    def step(self, action: NDArray[np.generic], paused: NDArray[np.bool_] | None = None) -> None:
        """Execute one action in each episode; finished and paused episodes do not change and have reward 0.

        Args:
            action: int64 [B] numbers of actions, or float32 [B, 2] acceleration and steering in [-1, 1] (clipped).
            paused: bool [B], episodes that do not step, besides the finished ones.

        Raises:
            ValueError: if a discrete action is not one of the five.
        """
        actions, controls = self._no_actions, self._no_controls
        if self.config.ego == Kind.DISCRETE:
            # Always one memory layout: numba would compile again for another one.
            actions = np.ascontiguousarray(action, dtype=np.int64)
        elif self.config.ego == Kind.CONTINUOUS:
            controls = self.controls(np.asarray(action))
        stepped = step_batch(
            self.roads,
            self.bodies,
            self.episodes,
            actions,
            controls,
            self._no_pause if paused is None else paused,
            self.generators,
            self.parameters,
            self.observation,
            self.numbers,
            self.flags,
            self.parts,
            self.recordings,
        )
        if not stepped:
            raise ValueError(f"actions must be between 0 and {len(self.config.actions) - 1}, got {actions.tolist()}")
