"""What is driven: weather, cells, and the named grids every pair is scored on."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.plugins.contracts import Track


@dataclass(frozen=True, kw_only=True)
class Weather:
    """The air between a sensor and the road, in the units a weather station reports.

    Args:
        name: how tables and command lines call it.
        visibility_m: meteorological optical range in metres (the distance at which contrast falls to 5 %); inf is clean air.
        precipitation_mm_h: rain rate in millimetres an hour.
        sun_elevation_deg: height of the sun over the horizon in degrees; below 0 is night. Only cameras look at it.

    Raises:
        ValueError: if a quantity is outside its physical range.
    """

    name: str
    visibility_m: float = math.inf
    precipitation_mm_h: float = 0.0
    sun_elevation_deg: float = 45.0

    def __post_init__(self) -> None:
        if not self.visibility_m > 0:
            raise ValueError(f"visibility_m must be positive, got {self.visibility_m}")
        if not 0 <= self.precipitation_mm_h < math.inf:
            raise ValueError(f"precipitation_mm_h must be a finite number of at least 0, got {self.precipitation_mm_h}")
        if not -90 <= self.sun_elevation_deg <= 90:
            raise ValueError(f"sun_elevation_deg must be in [-90, 90], got {self.sun_elevation_deg}")

    @property
    def extinction_per_m(self) -> float:
        """Optical extinction coefficient in 1/m: Koschmieder's law for the visibility, plus the rain's own.

        Koschmieder at the 5 % contrast of the meteorological optical range: sigma = 3.0 / visibility. Rain: 1.076 R^0.67 dB/km
        (Carbonneau and Wisely 1998, adopted by ITU-R P.1814).
        """
        rain_db_per_km = 1.076 * self.precipitation_mm_h**0.67
        return 3.0 / self.visibility_m + rain_db_per_km / (10 * math.log10(math.e)) / 1000


WEATHERS: dict[str, Weather] = {
    w.name: w
    for w in (
        Weather(name="clear"),
        Weather(name="rain", visibility_m=2000.0, precipitation_mm_h=25.0, sun_elevation_deg=30.0),
        Weather(name="fog", visibility_m=120.0, sun_elevation_deg=30.0),
        Weather(name="night", sun_elevation_deg=-10.0),
    )
}


class SeedBlock(IntEnum):
    """Where each use of scenario seeds begins. Seeds that select or tune are never the seeds that are reported."""

    REPORT = 1_000_000
    SELECT = 2_000_000
    TUNE = 3_000_000
    TRAIN = 10_000_000


@dataclass(frozen=True, order=True, kw_only=True)
class Cell:
    """One square of a grid: a kind of road and weather, without a seed.

    Args:
        lanes: number of lanes (2 to 8).
        density: traffic density factor of highway-env (spacing is divided by it), in (0, 4].
        weather: a name in `WEATHERS`.
    """

    lanes: int
    density: float
    weather: str = "clear"

    def __post_init__(self) -> None:
        if not 2 <= self.lanes <= 8:
            raise ValueError(f"lanes must be between 2 and 8, got {self.lanes}")
        if not 0 < self.density <= 4:
            raise ValueError(f"density must be in (0, 4], got {self.density}")
        if self.weather not in WEATHERS:
            raise ValueError(f"unknown weather {self.weather!r}; known: {', '.join(WEATHERS)}")

    def __str__(self) -> str:
        return f"{self.lanes} lanes, density {self.density:g}, {self.weather}"


@dataclass(frozen=True, kw_only=True)
class Grid:
    """A named, versioned list of scenarios of a track: the product of lanes, density and weather, `episodes` seeds a cell."""

    name: str
    lanes: tuple[int, ...]
    density: tuple[float, ...]
    weather: tuple[str, ...]
    episodes: int
    first_seed: int = SeedBlock.REPORT
    track: Track = "driving"

    def __post_init__(self) -> None:
        if not 1 <= self.episodes <= SeedBlock.SELECT - SeedBlock.REPORT:
            raise ValueError(f"episodes must be between 1 and 1000000, got {self.episodes}")
        for name in ("lanes", "density", "weather"):
            if not getattr(self, name):
                raise ValueError(f"a grid needs at least one value of {name}")
        self.cells()

    def cells(self) -> tuple[Cell, ...]:
        """The cells of the grid, weather outermost."""
        return tuple(
            Cell(lanes=lanes, density=density, weather=weather)
            for weather in self.weather
            for lanes in self.lanes
            for density in self.density
        )

    def seeds(self) -> range:
        """The scenario seeds of every cell."""
        return range(self.first_seed, self.first_seed + self.episodes)

    def with_(self, **changes: object) -> Grid:
        """A copy with other values; its name says that it is no longer the standard grid."""
        changed = replace(self, **changes)  # type: ignore[arg-type]
        return self if changed == self else replace(changed, name="custom")


GRIDS: dict[str, Grid] = {
    "standard-v1": Grid(
        name="standard-v1",
        lanes=(3, 4, 5),
        density=(1.0, 2.0),
        weather=("clear", "rain", "fog"),
        episodes=100,
    ),
    "approach-v1": Grid(
        name="approach-v1",
        lanes=(3, 4, 5),
        density=(1.0, 2.0),
        weather=("clear", "rain", "fog"),
        episodes=3,
        track="detection",
    ),
}
