"""ROS 2 installations of this machine: where they are, which Python their rclpy is for, what files they have."""

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

SYSTEM: Final = Path("/opt/ros")
_RCLPY: Final = ("lib/python3.*/site-packages/rclpy", "local/lib/python3.*/dist-packages/rclpy")
_PYTHON: Final = re.compile(r"python(3\.\d+)")
_LEVELS: Final = 6
"""How far a Python package may lie below its prefix: lib/python3.12/site-packages, or local/lib/... on Debian."""


def prefixes(environment: Mapping[str, str] = os.environ, system: Path = SYSTEM) -> Iterator[Path]:
    """Prefixes of what is sourced, the nearest overlay first, then of what is installed."""
    yield from dict.fromkeys([*_sourced(environment), *(sorted(system.iterdir()) if system.is_dir() else [])])


def overlays(environment: Mapping[str, str] = os.environ, system: Path = SYSTEM) -> list[tuple[Path, ...]]:
    """The same prefixes in groups that are complete by themselves: what is sourced, then each installation. ROS 1 may
    be installed in the same folder and is none of them."""
    sourced = tuple(_sourced(environment))
    installed = [place for place in prefixes(environment, system) if (place / "share" / "ament_index").is_dir()]
    groups = [sourced, *((place,) for place in installed if place not in sourced)]
    return [group for group in groups if group]


def _sourced(environment: Mapping[str, str]) -> list[Path]:
    return [Path(text) for text in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if text]


def pythons(places: Iterable[Path]) -> dict[Path, str]:
    """Which Python (`3.12`) the rclpy in each of these prefixes is for, for those that have one."""
    found: dict[Path, str] = {}
    for place in places:
        for pattern in _RCLPY:
            for package in sorted(place.glob(pattern)):
                version = _PYTHON.search(package.as_posix())
                if version is not None:
                    found.setdefault(place, version[1])
    return found


def remedy(environment: Mapping[str, str] = os.environ, system: Path = SYSTEM) -> str:
    """What to do where rclpy cannot be imported here, in one phrase that names the Python it needs."""
    mine = f"{sys.version_info.major}.{sys.version_info.minor}"
    found = pythons(prefixes(environment, system))
    if not found:
        return (
            "no ROS 2 installation was found (AMENT_PREFIX_PATH, /opt/ros); source the setup file of one, and run SERN "
            f"with the Python that it was built for (this is {mine}); kinds dds and zenoh need none"
        )
    fitting = [place for place, python in found.items() if python == mine]
    if fitting:
        return f"source {fitting[0]}/setup.bash before this is started, in the same shell or unit"
    place, python = next(iter(found.items()))
    return (
        f"that of {place} is for Python {python}, and this is {mine}: install SERN with python{python} and source "
        f"{place}/setup.bash (docs/ros2.md); kinds dds and zenoh need no installation"
    )


def share_in(*places: Path) -> Callable[[str], Path | None]:
    """Where the files of a package are: `share/PACKAGE` of the first of these prefixes that has it; None where none
    has."""
    return lambda package: next((path for place in places if (path := place / "share" / package).is_dir()), None)


def share_of(package_file: str, package: str) -> Path | None:
    """The `share/PACKAGE` that lies beside an imported package of ROS, where its .msg and .srv files are."""
    for place in list(Path(package_file).parents)[:_LEVELS]:
        share = place / "share" / package
        if share.is_dir():
            return share
    return None
