"""What a scene is told by its file; `sern_runtime/config/scene.py` says what each means."""

from dataclasses import dataclass

from sern_twin.world.update_rates import UpdateRateOptions


@dataclass(frozen=True, slots=True)
class ScannerOptions:
    scan: str
    pose: str
    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    pose_error_m: float = 0.05


@dataclass(frozen=True, slots=True)
class SceneOptions:
    name: str
    scanners: tuple[ScannerOptions, ...] = ()
    obstacles: str | None = None
    publish: str = "/scene/map"
    discrepancies: str = "/scene/discrepancies"
    corrects: bool = True
    lasting: tuple[str, ...] = ("lasting",)
    rates: UpdateRateOptions | None = None
