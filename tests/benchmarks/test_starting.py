"""Every benchmark starts from anywhere, in an environment that has nothing, and comes to its report."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("psutil")

from benchmarks import child
from tests.support import DEADLINE_S

ROUND = ["--rounds", "1", "--seconds", "0.2"]
CARRYING = ["--rounds", "1", "--seconds", "1"]
"""Messages of class state come twice a second: something of every class arrives, also where a process stands still for
some hundred milliseconds. A time without any has no figures."""
KINDS = ["1", *(["2, DDS"] if importlib.util.find_spec("cyclonedds") else [])]
OF_ROS = {f"robot with ROS {kind}{part}" for kind in KINDS for part in ("", ": guard of its commands")}


@pytest.mark.parametrize(
    ("name", "arguments", "cases"),
    [
        (
            "estimator",
            ["--parts", "steady", "cost", "--cases", "4 Mbit/s 50 ms"],
            {"4 Mbit/s 50 ms", "one acknowledgement"},
        ),
        *(
            [("fabric", ["--only", "loopback", *ROUND], {"idle loopback, TLS"})]
            if importlib.util.find_spec("zenoh")
            else []
        ),
        ("footprint", ["--seconds", "0.2"], {"libraries", "relay", "simulated robot", "simulated site", *OF_ROS}),
        ("relay", ["--systems", "sern", "--cases", "1 kB", *CARRYING], {"1 kB"}),
        ("robots", ["--robots", "1", *CARRYING], {"1 robots"}),
        ("scheduler", [], {"10 topics", "100 topics", "1000 topics", "single control", "single bulk"}),
        ("summaries", [], {"cloud", "map", "/tf, 1 s"}),
        ("udp", ["--cases", "seal", "junk, unknown", *ROUND], {"seal", "junk, unknown"}),
    ],
)
def test_a_benchmark_starts_from_an_empty_environment(
    tmp_path: Path, name: str, arguments: list[str], cases: set[str]
) -> None:
    command = [sys.executable, "-P", "-m", f"benchmarks.{name}", "--quick", *arguments, "--json", "found.json"]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={"PYTHONPATH": str(child.ROOT)},  # the benchmarks are not installed
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["benchmark"] == name and found["notes"]
    assert {row["case"] for row in found["rows"]} == cases
    assert [path.name for path in tmp_path.iterdir()] == ["found.json"]
