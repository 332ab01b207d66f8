"""`sern recover`, as a person runs it; what it does to files is in tests/sern_client/endpoints/test_leftovers.py."""

import os
from pathlib import Path

from typer.testing import CliRunner

from sern_client.endpoints.leftovers import lock
from sern_core.vocabulary.types import Encoding
from sern_tools.commands import app
from tests.sern_client.endpoints.test_leftovers import interrupted, read


async def test_recover_finishes_what_it_can_and_says_the_rest(tmp_path: Path) -> None:
    bag, _ = await interrupted(tmp_path, Encoding.ROS1)
    (tmp_path / "bad.bag.active").write_bytes(b"precious")
    (tmp_path / "busy.bag.active").write_bytes(b"")
    (tmp_path / "whole.bag").write_bytes(b"")
    handle = lock(tmp_path / "busy.bag.active")
    names = [
        str(bag),
        *(str(tmp_path / name) for name in ("bad.bag.active", "busy.bag.active", "whole.bag", "no.bag.active")),
    ]
    result = CliRunner().invoke(app, ["recover", *names])
    os.close(handle)
    assert result.exit_code == 1
    assert f"{tmp_path / 'run.bag'}: 12 messages" in result.output
    for said in ("nothing of it can be read", "is being recorded now", "left unfinished", "no such file"):
        assert said in result.output
    assert len(read(tmp_path / "run.bag")) == 12
    assert (tmp_path / "bad.bag.broken").read_bytes() == b"precious"
    assert CliRunner().invoke(app, ["recover", str(tmp_path / "busy.bag.active")]).exit_code == 1  # it is empty
