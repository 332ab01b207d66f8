"""`sern demo-twin` as its user runs it, over a short blackout."""

import json
import subprocess
import sys
from pathlib import Path

from tests.support import until

PROFILES = """\
profiles:
  short:
    description: 2 Mbit/s, gone for 3 s
    link: {rate_bps: 2000000, delay_s: 0.02, queue_packets: 100, overhead_bytes: 28}
    schedule: [{at_s: 2, blackout_s: 3}]
    duration_s: 10
"""


def start(tmp_path: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "sern_tools.cli", "demo-twin", "--out", str(tmp_path / "out"), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


async def test_it_says_how_far_off_the_twin_was(tmp_path: Path) -> None:
    (tmp_path / "profiles.yaml").write_text(PROFILES)
    process = start(tmp_path, "--profiles", str(tmp_path / "profiles.yaml"), "--profile", "short")
    await until(lambda: process.poll() is not None, "it ends")
    said, wrong = process.communicate()
    assert process.returncode in (0, 1), said + wrong  # a promise may break on a machine that stands still
    told = json.loads((tmp_path / "out" / "twin.json").read_text())
    assert len(told["promises"]) == 8 and len(told["samples"]) > 10
    assert told["blackouts_s"] == [[2.0, 5.0]]
    assert any(sample["goes_by"] == "trajectory" for sample in told["samples"])
    assert "further off than it said" in (tmp_path / "out" / "twin.html").read_text()


async def test_what_it_cannot_do_is_one_line(tmp_path: Path) -> None:
    process = start(tmp_path, "--profile", "nowhere")
    await until(lambda: process.poll() is not None, "it ends")
    _said, wrong = process.communicate()
    assert process.returncode == 2 and len(wrong.splitlines()) == 1 and "nowhere" in wrong
