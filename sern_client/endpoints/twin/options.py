"""What a twin endpoint is told by its file; `sern_runtime/config/twin.py` says what each means."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class FrameOrigin:
    """Where the origin of a robot's frame is in that of the site, and which way its x axis looks."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Datum:
    """Where the origin of the site is on the Earth."""

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0


@dataclass(frozen=True, slots=True)
class RobotOptions:
    name: str
    pose: str
    plan: str | None = None
    max_speed_mps: float = 2.0
    max_yaw_rate_radps: float = 6.0
    gap_s: float = 0.5
    origin: FrameOrigin = FrameOrigin()
    error_m: float = 0.02
    error_mps: float = 0.05
    datum: Datum | None = None


@dataclass(frozen=True, slots=True)
class ViewOptions:
    host: str
    port: int


@dataclass(frozen=True, slots=True)
class TwinOptions:
    robots: tuple[RobotOptions, ...]
    encoding: Literal["ros1", "cdr"] = "cdr"
    rate_hz: float = 20.0
    ahead_s: float = 5.0
    prefix: str = "/twin"
    unity: bool = False
    objects: bool = True
    view: ViewOptions | None = None
