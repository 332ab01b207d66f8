"""A real Prometheus, Debian's, that scrapes daemons of a test: what dashboards ask is answered, alerts fire.

The alerts of a test are a copy whose `for` and windows are shorter (`scaled`): the expressions are those of the file.
"""

import json
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final
from urllib.error import URLError
from urllib.parse import urlencode
from urllib.request import urlopen

from ruamel.yaml import YAML

from sern_tools.ports import free_ports
from tests.daemons import HOST, Process
from tests.support import until

NEEDED: Final = ("prometheus", "promtool")
FACTOR: Final = 30.0
SHORTEST_WINDOW_S: Final = 8.0
SHORTEST_FOR_S: Final = 1.0
Jobs = Mapping[str, Sequence[Process | str]]
"""What is scraped by the name of its job: daemons, or addresses."""
_SECONDS: Final = {"s": 1.0, "m": 60.0, "h": 3600.0}
_WINDOW: Final = re.compile(r"\[(\d+)([smh])\]")


def missing() -> str | None:
    """Why there can be no Prometheus here; None: there can."""
    lacking = [name for name in NEEDED if shutil.which(name) is None]
    return f"needs {' and '.join(lacking)}: install Debian's package prometheus" if lacking else None


def scaled(rules: Mapping[str, Any]) -> dict[str, Any]:
    """The rules with `for` and windows FACTOR times as short, and not below what scrapes of a second can fill."""

    def window(found: "re.Match[str]") -> str:
        seconds = float(found[1]) * _SECONDS[found[2]] / FACTOR
        return f"[{max(SHORTEST_WINDOW_S, seconds):.0f}s]"

    groups = []
    for group in rules["groups"]:
        copies = []
        for rule in group["rules"]:
            copy = {**rule, "expr": _WINDOW.sub(window, rule["expr"])}
            if "for" in rule:
                seconds = float(rule["for"][:-1]) * _SECONDS[rule["for"][-1]] / FACTOR
                copy["for"] = f"{max(SHORTEST_FOR_S, seconds):.0f}s"
            copies.append(copy)
        groups.append({**group, "rules": copies})
    return {"groups": groups}


class Prometheus:
    """One that runs."""

    def __init__(self, port: int, log: Path) -> None:
        self._api = f"http://127.0.0.1:{port}/api/v1"
        self._log = log

    def _get(self, path: str, **parameters: str) -> Any:
        with urlopen(f"{self._api}/{path}?{urlencode(parameters)}", timeout=60) as answer:
            content = json.load(answer)
        assert content["status"] == "success", content
        return content["data"]

    @staticmethod
    def target(of: Process | str) -> str:
        """The label `instance` of what is scraped."""
        return of if isinstance(of, str) else f"{HOST}:{of.port}"

    async def until_up(self) -> None:
        """Wait until it answers and every target was scraped."""
        await until(self._up, "every daemon is scraped")

    def _up(self) -> bool:
        try:
            return all(target["health"] == "up" for target in self._targets())
        except (URLError, ConnectionError):
            return False

    def _targets(self) -> list[Any]:
        targets: list[Any] = self._get("targets")["activeTargets"]
        return targets or [{"health": "unknown"}]

    def asked(self, expression: str) -> list[Any]:
        """What an expression has now: its series."""
        result: list[Any] = self._get("query", query=expression)["result"]
        return result

    def firing(self) -> set[str]:
        """The names of the alerts that fire."""
        return {alert["labels"]["alertname"] for alert in self._get("alerts")["alerts"] if alert["state"] == "firing"}

    async def until_asked(self, expression: str) -> None:
        """Wait until an expression has data."""
        await until(lambda: self.asked(expression), f"{expression} has data")

    async def until_fired(self, name: str, **labels: str) -> None:
        """Wait until the alert has fired with these labels, now or before: what happens once is soon over."""
        wanted = {"alertname": name, "alertstate": "firing", **labels}
        matchers = ",".join(f'{label}="{value}"' for label, value in wanted.items())
        await until(lambda: self.asked(f"count_over_time(ALERTS{{{matchers}}}[1h])"), f"{name} fires, {labels}")

    async def until_clear(self, *names: str) -> None:
        """Wait until none of them fires."""
        await until(lambda: not self.firing() & set(names), f"{', '.join(names)} are over")


@contextmanager
def prometheus(directory: Path, rules: Mapping[str, Any], jobs: Jobs) -> Iterator[Prometheus]:
    """One that scrapes these targets by job each second, while the block runs; `rules` are looked at each second."""
    (port,) = free_ports(1)
    yaml = YAML()
    with (directory / "rules.yml").open("w") as file:
        yaml.dump(dict(rules), file)
    config = {
        "global": {"scrape_interval": "1s", "scrape_timeout": "1s", "evaluation_interval": "1s"},
        "rule_files": ["rules.yml"],
        "scrape_configs": [
            {"job_name": job, "static_configs": [{"targets": [Prometheus.target(each) for each in targets]}]}
            for job, targets in jobs.items()
        ],
    }
    with (directory / "prometheus.yml").open("w") as file:
        yaml.dump(config, file)
    log = directory / "prometheus.log"
    command = [
        NEEDED[0], f"--config.file={directory / 'prometheus.yml'}", f"--storage.tsdb.path={directory / 'tsdb'}",
        f"--web.listen-address=127.0.0.1:{port}",
    ]  # fmt: skip
    with log.open("wb") as stream, subprocess.Popen(command, stdout=stream, stderr=stream, cwd=directory) as process:
        try:
            yield Prometheus(port, log)
        finally:
            process.terminate()
            try:
                process.wait(30)
            except subprocess.TimeoutExpired:
                process.kill()
