"""Good files, what they become for the core, and the second step: the files that they name."""

import os
import re
import shutil
from pathlib import Path

import pytest

from sern_core.relay.access import AccessTable
from sern_core.topics.rules import Direction, DiscoveryMode, Lease, LossAction
from sern_core.vocabulary.message import TopicInfo
from sern_core.vocabulary.params import LinkParams, SchedulerParams, WindowAlgorithm
from sern_core.vocabulary.types import ClientName, Encoding, Ordering, PriorityClass, Reliability, TopicName
from sern_runtime.config import base as config_base
from sern_runtime.config import keys
from sern_runtime.config.base import FileModel, is_local
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.endpoints import BagEndpoint, RecordEndpoint, SyntheticEndpoint
from sern_runtime.config.load import check, check_bytes, load
from sern_runtime.config.relay import RelayFile, load_relay

HEAD = "client: {name: jackal1}\nrelay: {endpoint: 'ipc:///run/sern.sock', insecure: true}\n"
ROBOT = HEAD + "endpoint: {kind: synthetic, role: robot}\n"


def client(text: str) -> ClientFile:
    checked = check_bytes(text.encode(), Path("c.yaml"), ClientFile)
    assert checked.loaded is not None, [str(error) for error in checked.errors]
    return checked.loaded.model


def relay(text: str) -> RelayFile:
    checked = check_bytes(text.encode(), Path("r.yaml"), RelayFile)
    assert checked.loaded is not None, [str(error) for error in checked.errors]
    return checked.loaded.model


def problems(path: Path, model: type[FileModel]) -> list[str]:
    return [str(error).removeprefix(str(path.parent)) for error in check(path, model).errors]


def test_defaults_are_those_of_the_core() -> None:
    model = client(ROBOT)
    assert model.scheduler.params() == SchedulerParams()
    assert model.link.params() == LinkParams()
    assert (model.name, model.namespace, model.http.listen) == ("jackal1", "/jackal1", None)
    assert model.discovery.filter().mode is DiscoveryMode.MANUAL
    assert relay("relay: {name: hub, listen: ['ipc://x'], insecure: true}\n").http.listen == "127.0.0.1:5580"


def test_settings_reach_the_core() -> None:
    model = client(
        ROBOT + "scheduler: {ordering: paper, eta: 0, floor: 0}\nlink: {window: {algorithm: fixed, fixed_bytes: 9}, "
        "retention_s: 5}\ntopics: [{match: /a, reliability: reliable}]\n"
    )
    assert model.scheduler.params() == SchedulerParams(ordering=Ordering.PAPER, eta=0.0, floor=0.0)
    assert model.link.params().window.algorithm is WindowAlgorithm.FIXED
    info = TopicInfo(TopicName("/a"), "std_msgs/String", Encoding.ROS1)
    spec = model.rules().resolve(info, local_name=TopicName("/a")).spec
    assert (spec.reliability, spec.retention_s) == (Reliability.RELIABLE, 5.0)


def test_topic_rules_and_subscriptions() -> None:
    model = client(
        ROBOT + "topics:\n"
        "  - {match: /cmd_vel, class: control, direction: receive, on_link_loss: {publish: zero, after_s: 0.5}}\n"
        "  - {match: /goal, direction: receive, remap: /target}\n"
        "  - {match: '/map|/costmap.*', class: state, lifespan_s: null, weight: 7}\n"
        "subscribe: ['/site/.*']\n"
    )
    rules = model.rules()
    twist = TopicInfo(TopicName("/cmd_vel"), "geometry_msgs/msg/Twist", Encoding.CDR)
    resolved = rules.resolve(twist, local_name=TopicName("/cmd_vel"))
    assert resolved.lease == Lease(LossAction.ZERO, 0.5)
    assert resolved.direction is Direction.RECEIVE
    assert (resolved.spec.priority, resolved.spec.lifespan_s) == (PriorityClass.CONTROL, 0.3)
    grid = TopicInfo(TopicName("/costmap/a"), "nav_msgs/OccupancyGrid", Encoding.ROS1)
    spec = rules.resolve(grid, local_name=TopicName("/costmap/a")).spec
    assert (spec.weight, spec.lifespan_s) == (7.0, None)
    assert model.subscribe_patterns() == ("/site/.*", "/jackal1(?:/cmd_vel)", "/jackal1(?:/target)")


def test_services_and_actions_become_rules_and_subscriptions() -> None:
    robot = client(
        ROBOT + "services: {offer: [{match: '/set_.*', timeout_s: 2, class: control}]}\n"
        "actions: {offer: [{match: /dock, timeout_s: 60}]}\n"
        "topics: [{match: '.*'}]\n"
    )
    modes, ask, result = robot.offered_services()
    assert (modes.match.pattern, modes.timeout_s, modes.priority) == ("/set_.*", 2.0, PriorityClass.CONTROL)
    assert ask.match.fullmatch("/dock/_action/send_goal") and ask.timeout_s == 5.0
    assert result.match.fullmatch("/dock/_action/get_result") and result.timeout_s == 60.0
    assert robot.used_services() == ()
    rules = robot.rules()

    def treated(name: str) -> tuple[Direction, PriorityClass, bool]:
        resolved = rules.resolve(TopicInfo(TopicName(name), "a/B", Encoding.CDR), local_name=TopicName(name))
        return resolved.direction, resolved.spec.priority, resolved.spec.reliable

    assert treated("/dock/goal") == (Direction.RECEIVE, PriorityClass.CONTROL, True)
    assert treated("/dock/result") == (Direction.SEND, PriorityClass.STATE, True)
    assert treated("/dock/_action/feedback") == (Direction.SEND, PriorityClass.STATE, False)
    goal, cancel = (
        rules.resolve(TopicInfo(TopicName(name), "a/B", Encoding.ROS1), local_name=TopicName(name)).spec
        for name in ("/dock/goal", "/dock/cancel")
    )
    assert (goal.lifespan_s, cancel.lifespan_s) == (5.0, None), "nothing sets off late, and to stop is never too late"
    assert treated("/docks/goal") == (Direction.BOTH, PriorityClass.BULK, False)
    patterns = [re.compile(text) for text in robot.subscribe_patterns()]

    def heard(name: str) -> bool:
        return any(pattern.fullmatch(name) for pattern in patterns)

    assert heard("/jackal1/set_mode/_call/site") and heard("/jackal1/dock/_action/get_result/_call/site")
    assert heard("/jackal1/dock/goal") and not heard("/jackal1/dock/result") and not heard("/jackal2/dock/goal")

    site = client(
        ROBOT.replace("jackal1", "site")
        + "services: {use: [{match: '/jackal1/.*'}]}\nactions: {use: [{match: /jackal1/dock}]}\n"
    )
    patterns = [re.compile(text) for text in site.subscribe_patterns()]
    assert heard("/jackal1/set_mode/_service") and heard("/jackal1/set_mode/_reply/site")
    assert heard("/jackal1/dock/status") and heard("/jackal1/dock/_action/feedback") and heard("/jackal1/dock/result")
    assert not heard("/jackal1/set_mode/_reply/other") and not heard("/jackal1/dock/goal")


def test_one_endpoint_or_several() -> None:
    assert client(ROBOT).endpoints == (SyntheticEndpoint(kind="synthetic", role="robot"),)
    several = client(
        HEAD + "endpoint:\n  - {kind: bag, path: a.bag, rate: 0, topics: ['/a.*']}\n  - {kind: record, path: b}\n"
    )
    assert several.endpoints == (
        BagEndpoint(kind="bag", path="a.bag", rate=0, topics=("/a.*",)),
        RecordEndpoint(kind="record", path="b"),
    )
    named = client(HEAD + "endpoint: {kind: synthetic, role: robot, topics: [/odom, /scan]}\n").endpoints[0]
    assert isinstance(named, SyntheticEndpoint)
    assert named.topics == ("/odom", "/scan")


def test_access_rules_reach_the_table() -> None:
    model = relay(
        "relay: {name: hub, listen: ['ipc://x', 'tcp://127.0.0.1:5555'], insecure: true}\n"
        "access:\n  - {client: site1, subscribe: ['.*'], replay: []}\n"
        "  - {client: 'jackal.*', publish: ['/{self}/.*'], max_rate_hz: 100}\n"
    )
    table = AccessTable(model.access_rules())
    robot, site, odom = ClientName("jackal1"), ClientName("site1"), TopicName("/jackal1/odom")
    assert table.may_publish(robot, odom)
    assert not table.may_publish(robot, TopicName("/jackal2/odom"))
    assert table.limits(robot).max_rate_hz == 100
    assert table.may_subscribe(site, odom)
    assert not table.may_replay(site, odom)
    assert not table.may_publish(site, odom)


def test_feed_roles_reach_the_core() -> None:
    model = relay(
        "relay: {name: hub, listen: ['ipc://x'], insecure: true}\nfeed:\n  roles:\n"
        "    - {name: unity, publish_endpoint: 'tcp://127.0.0.1:5570', ingest_endpoint: 'tcp://127.0.0.1:5571',\n"
        "       subscribe: ['/r/odom'], publish: ['/r/goal']}\n"
        "    - {name: lan, publish_endpoint: 'tcp://192.168.1.2:5570', insecure: true}\n"
    )
    unity, lan = model.feed_roles()
    assert unity.may_see(TopicName("/r/odom"))
    assert not unity.may_see(TopicName("/r/odom_filtered"))
    assert unity.may_publish(TopicName("/r/goal"), PriorityClass.STATE)
    assert not unity.may_publish(TopicName("/r/goal"), PriorityClass.CONTROL)
    assert not lan.may_see(TopicName("/r/odom"))


@pytest.mark.parametrize(
    ("endpoint", "local"),
    [
        ("ipc:///run/x", True),
        ("tcp://127.0.0.1:1", True),
        ("tcp://127.9.9.9:1", True),
        ("tcp://[::1]:1", True),
        ("tcp://localhost:1", True),
        ("tcp://0.0.0.0:1", False),
        ("tcp://*:1", False),
        ("tcp://[::]:1", False),
        ("tcp://192.168.0.1:1", False),
        ("tcp://localhost.example:1", False),
    ],
)
def test_what_counts_as_local(endpoint: str, local: bool) -> None:
    assert is_local(endpoint) is local


@pytest.fixture
def keyed(tmp_path: Path) -> Path:
    """A directory with the keys of relay `hub` and client `jackal1`."""
    (tmp_path / "clients").mkdir()
    for name in ("hub", "jackal1"):
        pair = keys.generate(ClientName(name))
        keys.write_secret(tmp_path / f"{name}.key", pair)
        public = keys.PublicKeys(pair.name, (keys.PublicKey(pair.public_key),))
        keys.write_public(tmp_path / f"{name}.pub", public)
        if name != "hub":
            keys.write_public(tmp_path / "clients" / f"{name}.pub", public)
    return tmp_path


CLIENT_KEYED = (
    "client: {name: jackal1}\nrelay:\n  endpoint: tcp://relay.example:5555\n"
    "  server_key_file: hub.pub\n  secret_key_file: jackal1.key\n"
)
RELAY_KEYED = "relay:\n  name: hub\n  listen: ['tcp://*:5555']\n  secret_key_file: hub.key\n  clients_dir: clients\n"


def test_files_that_are_there(keyed: Path) -> None:
    path = keyed / "client.yaml"
    path.write_text(CLIENT_KEYED + "endpoint: {kind: record, path: new.bag}\nsummary: s.json\n", encoding="utf-8")
    loaded = load_client(path)
    assert loaded.warnings == ()
    assert loaded.resolve("s.json") == keyed / "s.json"
    assert loaded.resolve("/abs") == Path("/abs")
    path = keyed / "relay.yaml"
    path.write_text(RELAY_KEYED + "access: [{client: '.*', publish: ['/{self}/.*']}]\n", encoding="utf-8")
    assert load_relay(path).warnings == ()


@pytest.mark.parametrize("named", ["message_log: log.csv", "summary: s.json"])
def test_what_the_units_cannot_write_is_warned_of(keyed: Path, monkeypatch: pytest.MonkeyPatch, named: str) -> None:
    path = keyed / "client.yaml"
    path.write_text(CLIENT_KEYED + f"endpoint: {{kind: record, path: .}}\n{named}\n", encoding="utf-8")
    assert load_client(path).warnings == ()
    monkeypatch.setattr(config_base, "UNITS_CONFIGURED", keyed)
    loaded = load_client(path)
    key, _, name = named.partition(": ")
    outside = "under the systemd units nothing can be written outside of /var/lib/sern"
    assert [warning.removeprefix(str(path)).split(";")[0] for warning in loaded.warnings] == [
        f":6: endpoint.path: {keyed}: {outside}",
        f":7: {key}: {keyed / name}: {outside}",
    ]
    path = keyed / "relay.yaml"
    path.write_text(RELAY_KEYED + f"{named}\n", encoding="utf-8")
    assert sum(f"{key}: {keyed / name}: under the systemd units" in said for said in load_relay(path).warnings) == 1


def test_a_file_of_the_units_that_writes_elsewhere_is_warned_of(keyed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A home directory is read-only there, as everything is but the state directory."""
    kept, home, etc = keyed / "kept", keyed / "home", keyed / "etc"
    for directory in (kept, home):
        directory.mkdir()
    shutil.copytree(keyed, etc)
    path = etc / "client.yaml"
    path.write_text(
        CLIENT_KEYED + f"endpoint: {{kind: record, path: '{kept}/'}}\nsummary: '{home}/s.json'\n", encoding="utf-8"
    )
    assert load_client(path).warnings == ()
    monkeypatch.setattr(config_base, "UNITS_CONFIGURED", etc)
    monkeypatch.setattr(config_base, "UNITS_WRITE", kept)
    (warning,) = load_client(path).warnings
    assert warning.removeprefix(str(path)) == (
        f":7: summary: {home}/s.json: under the systemd units nothing can be written outside of {kept}; name a path "
        "there, or add ReadWritePaths= to the unit"
    )


def test_the_folder_that_systemd_makes_need_not_be_there(keyed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file is checked before the unit is started for the first time."""
    state = keyed / "state"
    path = keyed / "client.yaml"
    path.write_text(
        CLIENT_KEYED + f"endpoint: {{kind: record, path: '{state}/bags/'}}\nsummary: '{state}/s.json'\n",
        encoding="utf-8",
    )
    missing = f"{state}: no such directory; create it first"
    monkeypatch.setattr(config_base, "UNITS_WRITE", state)
    assert problems(path, ClientFile) == [
        f"/client.yaml:6: endpoint.path: {missing}", f"/client.yaml:7: summary: {missing}",
    ]  # fmt: skip
    monkeypatch.setattr(config_base, "UNITS_CONFIGURED", keyed)
    assert load_client(path).warnings == ()


def test_a_folder_for_recordings_that_may_not_be_written_is_an_error(
    keyed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (keyed / "bags").mkdir()
    path = keyed / "client.yaml"
    path.write_text(CLIENT_KEYED + "endpoint: {kind: record, path: bags}\n", encoding="utf-8")
    assert problems(path, ClientFile) == []
    access = os.access
    monkeypatch.setattr(os, "access", lambda file, mode: file != keyed / "bags" and access(file, mode))  # root may all
    assert problems(path, ClientFile) == [f"/client.yaml:6: endpoint.path: {keyed}/bags: may not be written"]


def test_files_that_are_not_there(keyed: Path) -> None:
    path = keyed / "client.yaml"
    path.write_text(
        CLIENT_KEYED.replace("hub.pub", "hub.key").replace("jackal1.key", "hub.key")
        + "endpoint:\n  - {kind: bag, path: none.bag}\n  - {kind: synthetic, role: robot, cloud_files: [no.ply]}\n"
        + "  - {kind: record, path: client.yaml}\nmessage_log: clients\nsummary: none/s.json\n",
        encoding="utf-8",
    )
    base = str(keyed)
    assert problems(path, ClientFile) == [
        f"/client.yaml:4: relay.server_key_file: {base}/hub.key:2: is a secret key file; the public one is needed here "
        "(NAME.pub)",
        f"/client.yaml:5: relay.secret_key_file: {base}/hub.key is the key of hub, and this is jackal1; "
        "use the key of jackal1",
        f"/client.yaml:7: endpoint.0.path: {base}/none.bag: no such file or directory",
        f"/client.yaml:8: endpoint.1.cloud_files.0: {base}/no.ply: no such file",
        f"/client.yaml:9: endpoint.2.path: {base}/client.yaml exists; set overwrite: true or name another file",
        f"/client.yaml:10: message_log: {base}/clients is a directory; a file is needed",
        f"/client.yaml:11: summary: {base}/none: no such directory; create it first",
    ]
    assert load(path, ClientFile, files=False).model.name == "jackal1"


def test_warnings_do_not_stop(keyed: Path) -> None:
    (keyed / "hub.key").chmod(0o644)
    (keyed / "clients" / "README").write_text("hello", encoding="utf-8")
    path = keyed / "relay.yaml"
    path.write_text(RELAY_KEYED, encoding="utf-8")
    base = str(keyed)
    assert [warning.removeprefix(base) for warning in load_relay(path).warnings] == [
        f"/relay.yaml:4: relay.secret_key_file: {base}/hub.key is open to others than its owner (mode 0644); "
        f"run: chmod 600 {base}/hub.key",
        f"/relay.yaml:5: relay.clients_dir: {base}/clients/README: is not read, its name does not end in .pub",
        "/relay.yaml:1: access: no rule matches client jackal1: it may connect and do nothing",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("ipc://sern.sock", "ipc://{here}/sern.sock"),
        ("ipc://run/sern.sock", "ipc://{here}/run/sern.sock"),
        ("ipc://~/sern.sock", "ipc:///home/robot/sern.sock"),
        ("ipc:///run/sern.sock", "ipc:///run/sern.sock"),
        ("ipc://@sern", "ipc://@sern"),  # a name in Linux's abstract namespace is no path
        ("tcp://127.0.0.1:5555", "tcp://127.0.0.1:5555"),
    ],
)
def test_sockets_of_this_machine_are_where_the_file_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, expected: str
) -> None:
    monkeypatch.setenv("HOME", "/home/robot")
    found = expected.format(here=tmp_path)
    client, hub, other = tmp_path / "client.yaml", tmp_path / "hub.yaml", tmp_path / "other.yaml"
    client.write_text(
        f"client: {{name: jackal1}}\nrelay: {{endpoint: '{text}', insecure: true}}\n"
        "endpoint: {kind: synthetic, role: robot}\n"
    )
    hub.write_text(f"relay: {{name: hub, listen: ['{text}'], insecure: true}}\n")
    other.write_text(
        "relay: {name: hub, listen: ['tcp://127.0.0.1:1'], insecure: true}\nfeed: {roles: [{name: one, "
        f"publish_endpoint: '{text}', ingest_endpoint: 'tcp://127.0.0.1:3', publish: ['/a']}}, "
        f"{{name: two, publish_endpoint: 'tcp://127.0.0.1:2', ingest_endpoint: '{text}2', publish: ['/a']}}]}}\n"
    )
    assert load_client(client).model.all_relays[0].endpoint == found
    assert load_relay(hub).model.relay.listen == (found,)
    one, two = load_relay(other).model.feed_roles()
    assert (one.publish_endpoint, one.ingest_endpoint) == (found, "tcp://127.0.0.1:3")
    assert (two.publish_endpoint, two.ingest_endpoint) == ("tcp://127.0.0.1:2", found + "2")


@pytest.mark.parametrize("key", ["relay.endpoint", "relay.listen.0", "feed.roles.0.publish_endpoint"])
def test_a_socket_too_deep_in_the_file_system_is_an_error(tmp_path: Path, key: str) -> None:
    file = tmp_path / ("deep" * 30) / "f.yaml"
    file.parent.mkdir()
    socket = "ipc://sern.sock"
    if key == "relay.endpoint":
        file.write_text(
            f"client: {{name: jackal1}}\nrelay: {{endpoint: '{socket}', insecure: true}}\n"
            "endpoint: {kind: synthetic, role: robot}\n"
        )
    else:
        listen, feed = (socket, "tcp://127.0.0.1:2") if key == "relay.listen.0" else ("tcp://127.0.0.1:2", socket)
        file.write_text(
            f"relay: {{name: hub, listen: ['{listen}'], insecure: true}}\n"
            f"feed: {{roles: [{{name: one, publish_endpoint: '{feed}'}}]}}\n"
        )
    model: type[FileModel] = ClientFile if key == "relay.endpoint" else RelayFile
    (error,) = check(file, model).errors
    assert f"{key}: ipc://{file.parent}/sern.sock: a path of 1 to 107 bytes is needed" in str(error)
