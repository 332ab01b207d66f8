"""`sern demo` ends the site's client once nothing waits for it at the relay, and not before."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sern_core.vocabulary.errors import SernError
from sern_tools import demo
from sern_tools.demo_scenario import ROBOT, SITE
from sern_tools.harness.processes import Children


def waiting(queued_bytes: int, inflight_bytes: int = 0) -> list[dict[str, Any]]:
    """An answer of the relay at /api/link."""
    site = {"peer": SITE, "queue": {"state": {"bytes": queued_bytes}}, "inflight_bytes": inflight_bytes}
    return [site, {"peer": ROBOT, "queue": {"state": {"bytes": 10}}, "inflight_bytes": 10}]


async def test_what_waits_for_the_site_is_waited_for(tmp_path: Path) -> None:
    """A relay that does not answer for a moment has not said that nothing waits."""
    async with Children(tmp_path) as children:
        answers = iter([None, waiting(5), None, waiting(0, 3), waiting(0), waiting(7)])

        async def ask() -> Any:
            return next(answers)

        await demo._drained(children, ask)
        assert next(answers) == waiting(7)


async def test_what_never_leaves_is_given_up_in_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now_s, asked_s = 100.0, list[float]()

    async def ask() -> Any:
        nonlocal now_s
        asked_s.append(now_s)
        now_s += 30.0
        return waiting(max(3, 7 - len(asked_s)))  # 6, 5, 4, 3, 3, ...

    monkeypatch.setattr(demo, "time", SimpleNamespace(monotonic=lambda: now_s))
    async with Children(tmp_path) as children:
        await demo._drained(children, ask)
        assert asked_s == [100.0, 130.0, 160.0, 190.0, 220.0, 250.0]
        child = await children.start("site", [sys.executable, "-c", "raise SystemExit(3)"])
        await child.process.wait()
        with pytest.raises(SernError, match=r"site ended \(exit status 3\)"):
            await demo._drained(children, ask)
