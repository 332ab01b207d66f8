"""The file of a node that navigates: what it makes of its keys, and what it says of wrong ones."""

from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_navigation.navigator import NavigatorOptions
from sern_navigation.scan import ScanOptions
from sern_runtime.config.navigation import NavigationFile, load_navigation

GRID = "grid: {west_m: -20, south_m: -20, width_m: 40, length_m: 40}\n"
PLAIN = "# what drives\nendpoint: {kind: ros1}\n" + GRID


def load(tmp_path: Path, text: str) -> NavigationFile:
    path = tmp_path / "navigation.yaml"
    path.write_text(text, encoding="utf-8")
    return load_navigation(path).model


def test_a_short_file_is_the_librarys_defaults(tmp_path: Path) -> None:
    model = load(tmp_path, PLAIN)
    options = model.options()
    assert options == NavigatorOptions(scan=ScanOptions(origin_m=(0.0, 0.0, 0.4)))
    assert model.grid.grid.shape == (400, 400) and model.grid.grid.frame_id == "map"


def test_keys_of_nav2s_parts_are_options_of_the_library(tmp_path: Path) -> None:
    text = PLAIN + (
        "controller: {batch_size: 500, critics: {cost: {cost_weight: 3.0}}}\n"
        "inflation_layer: {inflation_radius: 0.9}\n"
        "behaviors: {number_of_retries: 2}\n"
        "navigator: {xy_goal_tolerance: 0.5}\n"
        "lidar: {z_m: 0.6, x_m: 0.1}\n"
        "collision_monitor:\n"
        "  polygons:\n"
        "    - {name: stop, points: [[0.4, 0.3], [0.4, -0.3], [-0.4, 0.0]], action_type: stop}\n"
    )
    options = load(tmp_path, text).options()
    assert options.controller.batch_size == 500 and options.controller.critics.cost.cost_weight == 3.0
    assert options.costmap.inflation.inflation_radius == 0.9 and options.recovery.number_of_retries == 2
    assert options.xy_goal_tolerance == 0.5 and options.scan.origin_m == (0.1, 0.0, 0.6)
    assert [polygon.name for polygon in options.monitor.polygons] == ["stop"]


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ("controller: {batch_sise: 5}\n", r"navigation.yaml:4: controller.batch_sise: unknown key .*batch_size"),
        ("controller: {time_steps: 0}\n", r"navigation.yaml:4: controller: .*steps"),
        ("twin_layer: {cost: 254}\n", r"navigation.yaml:4: twin_layer: .*so that it never blocks"),
        ("on_link_loss: wait\n", r"navigation.yaml:4: on_link_loss: needs topics.link"),
        ("perception: {low_deg: 10, high_deg: 5}\n", r"navigation.yaml:4: perception.high_deg: 5.0 is to be more"),
        ("perception: {model: none.onnx}\n", r"navigation.yaml:4: perception.model: .*none.onnx: no such file"),
        ("scan: {origin_m: [0, 0, 1]}\n", r"scan.origin_m: unknown key"),
        ("start: [0, 0]\n", r"navigation.yaml:4: start"),
        ("type_paths: [nowhere]\n", r"type_paths.0: .*no such directory"),
        ("relay: {listen: []}\n", r"is a file that sern-client reads; a navigation file is needed here"),
        ("sern_key: 1\n", r"is a key file"),
    ],
)
def test_a_wrong_key_is_one_line(tmp_path: Path, more: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as raised:
        load(tmp_path, PLAIN + more)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("endpoint: {kind: bag}\n" + GRID, "endpoint.kind: unknown kind"),
        ("endpoint: [{kind: ros1}, {kind: dds}]\n" + GRID, "ROS 1 and of ROS 2"),
        ("endpoint: 3\n" + GRID, "expected an endpoint of kind ros1"),
        ("endpoint: {kind: ros1}\n" + GRID.replace("40}", "9000}"), "grid.cell_m: a grid of 400 x 90000 cells"),
        ("endpoint: {kind: ros1}\n", "grid: is missing"),
    ],
)
def test_a_file_that_is_none_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        load(tmp_path, text)
