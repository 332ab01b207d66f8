"""Which pinned dependencies come as wheels for computers with an ARM processor: `python -m benchmarks.arm_wheels`.

Asks pip what it would install there of each pin, and downloads none of them (`pip install --dry-run`). The table says
for each extra how many packages it takes, which of them have no wheel, and what glibc the others ask for. By `--write`
it goes into docs/install.md. Needs an environment with all extras (make setup): its metadata says what needs what.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Final

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from benchmarks.document import ROOT, insert

DOCUMENT: Final = ROOT / "docs" / "install.md"
PYTHONS: Final = ("3.11", "3.12", "3.13")
EXTRAS: Final = ("dds", "zenoh", "foxglove", "lossy", "twin", "viz", "geo", "seg", "sim", "report")
GLIBC_MINORS: Final = range(17, 40)
"""Minor versions of glibc 2, from that of manylinux2014 to that of Ubuntu 24.04."""
PLATFORMS: Final = ("manylinux2014_aarch64", *(f"manylinux_2_{minor}_aarch64" for minor in GLIBC_MINORS))
"""The lowest first: pip takes the wheel that asks for least."""


@dataclass(frozen=True, slots=True)
class Wheel:
    """What pip would take. `glibc_minor`: the least of glibc 2 that it runs with; 0: any."""

    name: str
    glibc_minor: int


def closure(extra: str, python: str) -> set[str]:
    """What `sern[extra]` takes on Linux on ARM with this Python, without `sern` itself; canonical names."""
    environment: dict[str, str] = {key: str(value) for key, value in default_environment().items()}
    environment |= {"platform_machine": "aarch64", "python_version": python, "python_full_version": f"{python}.0"}
    seen: set[tuple[str, str]] = set()
    waiting = [("sern", extra), ("sern", "")]
    while waiting:
        name, of = waiting.pop()
        if (name, of) in seen:
            continue
        seen.add((name, of))
        for line in metadata.requires(name) or ():
            need = Requirement(line)
            if need.marker is None or need.marker.evaluate(environment | {"extra": of}):
                waiting += [(canonicalize_name(need.name), asked) for asked in ("", *need.extras)]
    return {name for name, _ in seen} - {"sern"}


def pins() -> dict[str, str]:
    """`constraints.txt` by canonical name."""
    lines = (ROOT / "constraints.txt").read_text().split()
    return {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}


def glibc_minor(filename: str) -> int:
    """What a wheel asks for at the least, by its name."""
    found = [int(minor) for minor in re.findall(r"manylinux_2_(\d+)_aarch64", filename)]
    found += [17] * ("manylinux2014_aarch64" in filename)
    return min(found, default=0)


def ask(wanted: Sequence[str], python: str) -> Iterator[Wheel]:
    """What pip would install of these pins; halves of them where it refuses the whole. What has no wheel is left out.

    Raises RuntimeError where pip fails for another reason.
    """
    with tempfile.TemporaryDirectory() as directory:
        report = Path(directory) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--dry-run",
                   "--ignore-installed", "--no-deps", "--only-binary", ":all:", "--implementation", "cp",
                   "--python-version", python, "--target", directory, "--report", str(report),
                   *(f"--platform={platform}" for platform in PLATFORMS), *wanted]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            for entry in json.loads(report.read_text())["install"]:
                filename = entry["download_info"]["url"].rpartition("/")[2]
                yield Wheel(canonicalize_name(entry["metadata"]["name"]), glibc_minor(filename))
            return
    if "No matching distribution found" not in done.stderr:
        raise RuntimeError(f"pip fails: {done.stderr.strip()}")
    if len(wanted) > 1:
        half = len(wanted) // 2
        yield from ask(wanted[:half], python)
        yield from ask(wanted[half:], python)


def table() -> str:
    pinned = pins()
    takes = {(extra, python): closure(extra, python) for extra in ("", *EXTRAS) for python in PYTHONS}
    lines = [
        "| `pip install sern` with | packages beside those of the first line | without a wheel for aarch64 | glibc |",
        "|---|---|---|---|",
    ]
    wheels: dict[str, dict[str, Wheel]] = {}
    for python in PYTHONS:
        names = sorted(set().union(*(takes[extra, python] for extra in ("", *EXTRAS))))
        wheels[python] = {wheel.name: wheel for wheel in ask([f"{name}=={pinned[name]}" for name in names], python)}
    for extra in ("", *EXTRAS):
        more: set[str] = set()
        lacking: dict[str, list[str]] = {}
        minor = 0
        for python in PYTHONS:
            here = takes[extra, python] - (takes["", python] if extra else set())
            more |= here
            for name in here:
                if name not in wheels[python]:
                    lacking.setdefault(f"{name} {pinned[name]}", []).append(python)
                else:
                    minor = max(minor, wheels[python][name].glibc_minor)
        missing = ", ".join(
            name if len(where) == len(PYTHONS) else f"{name} (Python {', '.join(where)})"
            for name, where in sorted(lacking.items())
        )
        title = f"`[{extra}]`" if extra else "no extra: relay, ROS 1, Unity, recordings"
        lines.append(f"| {title} | {len(more)} | {missing or 'none'} | {f'2.{minor}' if minor else 'any'} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--write", action="store_true", help="put the table into docs/install.md")
    write = parser.parse_args().write
    text = table()
    print(text)
    if write:
        DOCUMENT.write_text(insert(DOCUMENT.read_text(), "arm_wheels", f"\n{text}\n"))


if __name__ == "__main__":
    main()
