"""Weather and light in physical units, shared by the sensors of all worlds."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Weather:
    """The air between a sensor and the road, in the units a weather station reports.

    Args:
        name: name in tables and on the command line.
        visibility_m: meteorological optical range in metres (the distance at which contrast falls to 5 %); inf for clear air.
        precipitation_mm_h: rain rate in mm/h.
        sun_elevation_deg: elevation of the sun above the horizon in degrees; below 0 is night. Only cameras use it.

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
        """Optical extinction coefficient in 1/m: Koschmieder's law for the visibility, plus the extinction of rain.

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
