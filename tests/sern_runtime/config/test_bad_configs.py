"""Bad files and exactly what is said about each: one line with file, line, key path and what is accepted."""

from pathlib import Path
from typing import Final, NamedTuple

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_runtime.config.base import FileModel
from sern_runtime.config.client import ClientFile, load_client
from sern_runtime.config.load import check_bytes
from sern_runtime.config.relay import RelayFile

HERE: Final = Path(__file__).resolve().parent


class Case(NamedTuple):
    name: str
    text: str
    said: list[str]


def table(file: str) -> list[Case]:
    """`=== name`, the file, `--- said`, one line for each error."""
    cases = []
    for part in (HERE / file).read_text(encoding="utf-8").split("=== ")[1:]:
        name, rest = part.split("\n", 1)
        text, said = rest.split("--- said\n")
        cases.append(Case(name, text, said.splitlines()))
    return cases


CLIENT: Final = table("bad_client.txt")
RELAY: Final = table("bad_relay.txt")


def said(text: str, model: type[FileModel], file: str) -> list[str]:
    checked = check_bytes(text.encode(), Path(file), model)
    assert checked.loaded is None
    return [str(error) for error in checked.errors]


def test_the_table_is_large() -> None:
    names = [case.name for case in (*CLIENT, *RELAY)]
    assert len(names) >= 70
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("case", CLIENT, ids=lambda case: case.name)
def test_bad_client_file(case: Case) -> None:
    assert said(case.text, ClientFile, "client.yaml") == case.said


@pytest.mark.parametrize("case", RELAY, ids=lambda case: case.name)
def test_bad_relay_file(case: Case) -> None:
    assert said(case.text, RelayFile, "relay.yaml") == case.said


def test_load_raises_the_first_of_several(tmp_path: Path) -> None:
    path = tmp_path / "client.yaml"
    path.write_text("client: {name: jackal1}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_client(path)
    assert (caught.value.file, caught.value.line, caught.value.key) == (str(path), 1, "relay")
    assert str(caught.value) == f"{path}:1: relay: is missing; or write relays, a list of several"


def test_every_problem_is_reported_in_the_order_of_the_file() -> None:
    text = (
        "client: {name: jackal1}\nrelay: {endpoint: 'ipc:///run/sern.sock', insecure: true}\n"
        "endpoint: {kind: synthetic, role: robot}\ndiscovery: {mde: manual}\n"
        "topics:\n  - {match: /a, depth: 0}\n  - {match: /b, class: contrl}\nlog: {level: loud}\n"
    )
    assert said(text, ClientFile, "c.yaml") == [
        "c.yaml:4: discovery.mde: unknown key (did you mean mode?); "
        "accepted: mode, allow, deny, allow_types, deny_types",
        "c.yaml:6: topics.0.depth: must be >= 1, not 0",
        "c.yaml:7: topics.1.class: 'contrl' is not accepted (did you mean control?); accepted: control, state, bulk",
        "c.yaml:8: log.level: 'loud' is not accepted; accepted: debug, info, warning, error",
    ]
