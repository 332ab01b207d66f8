"""Dashboard and alerts against the metrics of real daemons: what they ask for exists, with the labels they name."""

import asyncio
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families
from ruamel.yaml import YAML

from sern_client.endpoints.foxglove.endpoint import FoxgloveEndpoint
from sern_client.endpoints.foxglove.options import FoxgloveOptions
from sern_client.endpoints.unity.endpoint import UnityEndpoint
from sern_client.endpoints.unity.options import UnityOptions
from sern_client.navigation.metrics import register_navigation
from sern_client.navigation.node import NavigationNode
from sern_client.navigation.options import NodeOptions
from sern_core.vocabulary.types import ClientName, DropReason, Encoding
from sern_relay.fabric_metrics import register_relays
from sern_runtime.fabric.metrics import register_fabric
from sern_runtime.fabric.port import FabricCounters
from sern_runtime.metrics import Metrics
from sern_twin.world.grid import Grid
from tests.daemons import Lab, write_bag
from tests.sern_client.navigation.graph import Graph

DEPLOY: Final = Path(__file__).resolve().parents[2] / "deploy"
OPERATIONS: Final = DEPLOY.parent / "docs" / "operations.md"
DASHBOARDS: Final[dict[str, dict[str, Any]]] = {
    path.name: json.loads(path.read_text()) for path in sorted((DEPLOY / "grafana").glob("*.json"))
}
VARIABLES: Final = {
    "sern.json": ["datasource", "instance", "peer", "topic"],
    "sern-fleet.json": ["datasource", "instance"],
}
RULES: Final[dict[str, Any]] = YAML(typ="safe").load((DEPLOY / "prometheus" / "sern.rules.yml").read_text())
OF_PROMETHEUS: Final = {"up"}
TARGET_LABELS: Final = {"instance", "job"}
_SELECTOR: Final = re.compile(r"\b((?:sern|process)_\w+|up)\b(?:\{([^}]*)\})?")
_GROUPING: Final = re.compile(r"\b(?:by|without)\s*\(([^)]*)\)")


def panels(name: str) -> list[dict[str, Any]]:
    return [panel for panel in DASHBOARDS[name]["panels"] if panel["type"] != "row"]


def alerts() -> list[dict[str, Any]]:
    return [rule for group in RULES["groups"] for rule in group["rules"]]


def expressions_of(name: str) -> list[str]:
    """Every expression of a dashboard, with its variables filled in."""
    return [re.sub(r"\$\w+", ".*", target["expr"]) for panel in panels(name) for target in panel["targets"]]


def expressions() -> list[str]:
    """Every expression of dashboards and rules."""
    return [text for name in DASHBOARDS for text in expressions_of(name)] + [rule["expr"] for rule in alerts()]


def navigation() -> str:
    """What a node that navigates says of itself."""
    registry = CollectorRegistry()
    node = NavigationNode(NodeOptions(), Grid(0.0, 0.0, 0.1, 10, 10), Graph().endpoint, Encoding.CDR)
    register_navigation(Metrics(registry), node)
    return generate_latest(registry).decode()


def viewers() -> str:
    """What an endpoint at which people look says of itself."""
    registry = CollectorRegistry()
    metrics = Metrics(registry)
    FoxgloveEndpoint(FoxgloveOptions()).register_metrics(metrics)
    UnityEndpoint(UnityOptions()).register_metrics(metrics)
    return generate_latest(registry).decode()


def fabric() -> str:
    """What a relay says of its port to other relays, and of them."""
    registry = CollectorRegistry()
    metrics = Metrics(registry)
    register_fabric(metrics, FabricCounters)
    other = {ClientName("hub2"): 1}
    relays = SimpleNamespace(unknown=0, reached=lambda: other, clients=lambda: other, rules_differ=lambda: other)
    register_relays(metrics, lambda: relays, SimpleNamespace(taken=0, unkept=0), lambda: 0)
    return generate_latest(registry).decode()


@pytest.fixture(scope="module")
def metrics(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Sample name -> labels, of a relay with a robot and a site, of twins, and of a node that navigates. A family
    without samples yet has the label `?`."""

    async def collect() -> list[str]:
        directory = tmp_path_factory.mktemp("metrics")
        async with Lab(directory, "robot1", "site", "twin") as lab:
            relay = lab.process(lab.relay_file())
            scene = {"name": "yard", "west_m": 0, "south_m": 0, "width_m": 1, "length_m": 1}
            site = lab.process(lab.recorder_file("site", "/robot1/.*", scene=scene))
            bag = write_bag(directory / "a.bag", {"/text": 20})
            twins = {"kind": "twin", "robots": [{"name": "robot1", "pose": "/robot1/odom"}]}
            twin = lab.process(lab.client_file("twin", twins, client={"namespace": "/"}))
            adaptation = {"interval_s": 0.2}
            robot = lab.process(lab.player_file("robot1", bag, play={"rate": 1.0, "loop": True}, adaptation=adaptation))
            for process in (relay, site, robot, twin):
                await process.ready()
            known = 'sern_link_rtt_seconds{peer="site"}'
            await site.until(lambda: "sern_topic_age_seconds{" in site.get("/metrics")[1], "receives")
            await relay.until(lambda: known in relay.get("/metrics")[1], "knows the link")
            await robot.until(lambda: "sern_mmcf_predicted_term{" in robot.get("/metrics")[1], "adapts")
            return [process.get("/metrics")[1] for process in (relay, site, robot, twin)]

    found: dict[str, set[str]] = {}
    for text in (*asyncio.run(collect()), navigation(), viewers(), fabric()):
        for family in text_string_to_metric_families(text):
            name = family.name + ("_total" if family.type == "counter" else "")
            found.setdefault(name, {"?"})
            for sample in family.samples:
                labels = found.setdefault(sample.name, set())
                labels.discard("?")
                labels.update(sample.labels)
    return found


def test_every_metric_that_is_asked_for_exists_with_its_labels(metrics: dict[str, set[str]]) -> None:
    asked = 0
    for text in expressions():
        grouped = {label.strip() for part in _GROUPING.findall(text) for label in part.split(",")}
        for name, matchers in _SELECTOR.findall(text):
            if name in OF_PROMETHEUS:
                continue
            asked += 1
            assert name in metrics, f"no daemon has {name}: {text}"
            known = metrics[name] | TARGET_LABELS
            if "?" in known:
                continue
            assert set(re.findall(r"(\w+)\s*(?:=|!)", matchers)) <= known, f"{name} has only {sorted(known)}: {text}"
            if len(_SELECTOR.findall(text)) == 1:
                assert grouped <= known, f"{name} has only {sorted(known)}: {text}"
    assert asked > 40


def test_values_of_labels_exist() -> None:
    for text in expressions():
        for reasons in re.findall(r'reason=~"([a-z|_]+)"', text):
            assert set(reasons.split("|")) <= set(DropReason)


def test_every_metric_is_explained(metrics: dict[str, set[str]]) -> None:
    text = OPERATIONS.read_text()
    names = {re.sub(r"_(bucket|count|sum)$", "", name) for name in metrics if name.startswith("sern_")}
    assert sorted(name for name in names if f"`{name}`" not in text) == []
    assert sorted(set(re.findall(r"`(sern_\w+)`", text)) - names) == []


def test_every_alert_and_drop_reason_is_explained() -> None:
    text = OPERATIONS.read_text()
    assert [rule["alert"] for rule in alerts() if f"`{rule['alert']}`" not in text] == []
    assert [reason for reason in DropReason if f"| `{reason}` |" not in text] == []


def balanced(text: str) -> Iterator[str]:
    """What is left open or closed too often; strings do not count."""
    pairs = {")": "(", "]": "[", "}": "{"}
    stack: list[str] = []
    for character in re.sub(r'"[^"]*"', "", text):
        if character in pairs.values():
            stack.append(character)
        elif character in pairs and (not stack or stack.pop() != pairs[character]):
            yield character
    yield from stack


def test_prometheus_asks_for_nothing_that_is_not_there() -> None:
    """Beside a relay as the guide sets it up no client runs: a target that never answers would page for ever."""
    text = (DEPLOY / "prometheus" / "prometheus.yml").read_text()
    relay = YAML(typ="safe").load((DEPLOY / "examples" / "relay.yaml").read_text())
    config = YAML(typ="safe").load(text)
    assert config["rule_files"] == ["sern.rules.yml"]
    jobs = {job["job_name"]: job["static_configs"] for job in config["scrape_configs"]}
    assert jobs == {"sern-relay": [{"targets": [relay["http"]["listen"]]}]}
    enabled = re.sub(r"^  # ((?:- job_name:|  ).*)$", r"  \1", text, flags=re.M)
    jobs = {job["job_name"]: job["static_configs"] for job in YAML(typ="safe").load(enabled)["scrape_configs"]}
    assert jobs.keys() == {"sern-relay", "sern-client"}, "its marks taken off, the other job is whole"
    ports = {target.rpartition(":")[2] for target in jobs["sern-client"][0]["targets"]}
    examples = [YAML(typ="safe").load((DEPLOY / "examples" / name).read_text()) for name in ("robot.yaml", "site.yaml")]
    assert ports == {example["http"]["listen"].rpartition(":")[2] for example in examples}


def test_expressions_parse(tmp_path: Path) -> None:
    promtool = shutil.which("promtool")
    if promtool is None:  # the Debian package `prometheus` has it
        for text in expressions():
            assert not list(balanced(text)), text
            assert not re.search(r"\$\w", text), text
        return
    shutil.copytree(DEPLOY / "prometheus", tmp_path, dirs_exist_ok=True)
    rules = [{"record": f"panel:{index}", "expr": text} for index, text in enumerate(expressions())]
    (tmp_path / "panels.yml").write_text(json.dumps({"groups": [{"name": "panels", "rules": rules}]}))
    for arguments in (
        ["check", "config", "prometheus.yml"],
        ["check", "rules", "--lint=all", "--lint-fatal", "sern.rules.yml"],
        ["check", "rules", "--lint=none", "panels.yml"],
    ):
        result = subprocess.run(
            [promtool, *arguments], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
        )
        assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize("name", VARIABLES)
def test_a_dashboard_is_whole(name: str) -> None:
    ids = [panel["id"] for panel in DASHBOARDS[name]["panels"]]
    assert len(ids) == len(set(ids)) > 9
    titles = [panel["title"] for panel in panels(name)]
    assert len(titles) == len(set(titles))
    assert [item["name"] for item in DASHBOARDS[name]["templating"]["list"]] == VARIABLES[name]
    for panel in panels(name):
        defaults = panel["fieldConfig"]["defaults"]
        assert defaults["unit"], panel["title"]
        values = [step["value"] for step in defaults["thresholds"]["steps"]]
        assert values[0] is None, panel["title"]
        assert values[1:] == sorted(values[1:]), panel["title"]
        references = [target["refId"] for target in panel["targets"]]
        assert len(references) == len(set(references))
        assert panel["description"], panel["title"]
        assert panel["datasource"] == {"type": "prometheus", "uid": "${datasource}"}


def test_dashboards_are_known_and_told_apart() -> None:
    assert DASHBOARDS.keys() == VARIABLES.keys()
    for key in ("uid", "title"):
        assert len({dashboard[key] for dashboard in DASHBOARDS.values()}) == len(DASHBOARDS)


@pytest.mark.parametrize("name", VARIABLES)
def test_panels_do_not_overlap(name: str) -> None:
    taken: dict[tuple[int, int], str] = {}
    for panel in DASHBOARDS[name]["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        for x in range(place["x"], place["x"] + place["w"]):
            for y in range(place["y"], place["y"] + place["h"]):
                assert (x, y) not in taken, f"{panel['title']} lies on {taken[x, y]}"
                taken[x, y] = panel["title"]


def test_alerts_say_what_and_how_bad() -> None:
    for rule in alerts():
        assert rule["labels"]["severity"] in {"page", "warn", "info"}
        assert rule["annotations"]["summary"]
