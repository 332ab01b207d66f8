"""Two operators and one robot: who is obeyed, how command changes hands, and what both see of it."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import pytest
from typer.testing import CliRunner

from sern_client.daemon import ClientDaemon
from sern_core.vocabulary.errors import SernError, UsageError
from sern_core.vocabulary.types import DropReason, TopicName
from sern_tools.commands import app
from tests.daemons import Lab
from tests.loopback.test_commands import RAMP_RULES, STILL, Commands
from tests.support import until

TOPIC: Final = TopicName("/robot1/cmd_vel")
LAPSE_S: Final = 1.0
RULES: Final[list[dict[str, Any]]] = [{**RAMP_RULES[0], "holder": {"lapse_s": LAPSE_S}}, *RAMP_RULES[1:]]


@pytest.fixture
def directory() -> Iterator[str]:
    with TemporaryDirectory(prefix="sern-", dir="/tmp") as made:
        yield made


def robot_file(lab: Lab) -> Path:
    endpoint = {"kind": "synthetic", "role": "robot", "topics": ["/pose"]}
    return lab.client_file("robot1", endpoint, topics=RULES, discovery={"mode": "manual"})


def operator_file(lab: Lab, name: str, directory: str) -> Path:
    endpoint = {"kind": "synthetic", "role": "operator", "command_topic": TOPIC, "command_rate_hz": 20}
    rule = {"match": TOPIC, "class": "control", "direction": "send", "lifespan_s": 0.3, "holder": {}}
    local = {"socket": f"{directory}/{name}.sock"}
    return lab.client_file(name, endpoint, client={"namespace": "/"}, topics=[rule], local=local)


def holder(daemon: ClientDaemon) -> str | None:
    said = daemon.bridge.holding.to_json().get(TOPIC)
    return None if said is None else said["holder"]


def sent(daemon: ClientDaemon) -> int:
    """Commands of an operator that the relay has taken."""
    return int(daemon.topics()[TOPIC]["delivered"])


def withheld(daemon: ClientDaemon) -> int:
    counters = daemon.core.link.sender.ledger.topics[TOPIC]
    return counters.by_reason[DropReason.NOT_HOLDER]


async def test_command_changes_hands_and_both_see_it(
    tmp_path: Path, directory: str, caplog: pytest.LogCaptureFixture
) -> None:
    commands = Commands()
    async with Lab(tmp_path, "robot1", "anna", "bert") as lab:
        relay = await lab.relay()
        robot = await lab.client(robot_file(lab), commands.watch)
        anna = await lab.connected(operator_file(lab, "anna", directory))
        await until(lambda: holder(robot) == holder(anna) == "anna" and len(commands.moving) > 5, "she drives")
        bert = await lab.connected(operator_file(lab, "bert", directory))
        await until(lambda: holder(bert) == "anna" and withheld(bert) > 5, "his commands are not sent, and counted")
        said = f"{TOPIC}: anna holds it, and commands from here are not sent; `sern take {TOPIC}` asks for it"
        assert said in caplog.text
        # He asks, she gives.
        asked = await bert.operating.answer({"do": "take", "topic": TOPIC, "how": None})
        assert asked["held"][TOPIC]["holder"] == "anna"
        with pytest.raises(UsageError, match="is not yours to give: anna holds it"):
            await bert.operating.answer({"do": "take", "topic": TOPIC, "how": "give"})
        await bert.bridge.asking.ask(TopicName(f"{TOPIC}/take"), "ask")
        await until(lambda: f"{TOPIC}: bert asks to take it; `sern take {TOPIC} --give` gives it" in caplog.text)
        given = await anna.operating.answer({"do": "take", "topic": TOPIC, "how": "give"})
        assert given == {"topic": TOPIC, "before": "anna", "holder": "bert"}
        await until(lambda: holder(robot) == holder(bert) == "bert" and sent(bert) > 5, "he drives")
        before = withheld(anna)
        await until(lambda: withheld(anna) > before + 5, "she does not")
        for daemon in (robot, anna, bert):
            texts = [event["text"] for event in daemon.events.after(0) if event["kind"] == "holder"]
            assert texts[-1] == f"{TOPIC}: held by bert, before by anna"
        # She takes it back.
        taken = await anna.operating.answer({"do": "take", "topic": TOPIC, "how": "force"})
        assert taken["holder"] == "anna"
        count = len(commands.moving)
        await until(lambda: len(commands.moving) > count + 5 and holder(bert) == "anna")
        # Her link is gone: after a while nobody holds it, and the robot stands although he goes on commanding.
        await lab.drop(anna)
        await until(lambda: holder(robot) is None and holder(bert) is None, "it has lapsed")
        await until(lambda: commands.obeyed[-1].twist == STILL and robot.bridge.inbound.commands.due_s is None)
        before = withheld(bert)
        await until(lambda: withheld(bert) > before + 5)
        assert commands.obeyed[-1].twist == STILL
        taken = await bert.operating.answer({"do": "take", "topic": TOPIC, "how": "ask"})
        assert taken == {"topic": TOPIC, "before": None, "holder": "bert"}
        await until(lambda: commands.obeyed[-1].twist != STILL, "he drives")
        await lab.end(bert)
        await lab.end(robot)
        await lab.end(relay)


async def test_a_topic_of_which_nothing_is_known_is_said_in_one_line(tmp_path: Path, directory: str) -> None:
    async with Lab(tmp_path, "anna") as lab:
        anna = await lab.client(operator_file(lab, "anna", directory))
        with pytest.raises(SernError, match="nothing is known of who holds /robot1/cmd_vel: has it a rule"):
            await anna.operating.answer({"do": "take", "topic": TOPIC, "how": "ask"})
        await lab.end(anna)


def test_the_command_says_what_does_not_fit_together() -> None:
    result = CliRunner().invoke(app, ["take", TOPIC, "--force", "--give"])
    assert result.exit_code == 2 and result.stderr == "sern take: --force and --give are one too many\n"
