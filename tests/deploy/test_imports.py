"""A daemon imports what its file asks for: a robot's memory and its start are not spent on what is not used."""

import os
import subprocess
import sys

import pytest

ENDPOINTS = ("bag", "dds", "foxglove", "rclpy", "record", "ros1", "synthetic", "unity", "zenoh")
SHOWN = "import sys, {program}; print(*sys.modules)"


def imported_by(program: str) -> set[str]:
    ended = subprocess.run(
        [sys.executable, "-c", SHOWN.format(program=program)], capture_output=True, text=True, check=True
    )
    return set(ended.stdout.split())


@pytest.mark.parametrize(
    "program", ["sern_client.daemon", "sern_client.guard_process", "sern_relay.daemon", "sern_tools.cli"]
)
def test_what_no_file_asked_for_is_not_imported(program: str) -> None:
    there = imported_by(program)
    assert program in there
    for kind in ENDPOINTS:
        assert not {f"sern_client.endpoints.{kind}", f"sern_client.endpoints.{kind}.endpoint"} & there
    assert (
        not {"aiohttp", "foxglove", "zenoh", "cyclonedds", "rclpy", "matplotlib", "rosbags.rosbag1", "rosbags.rosbag2"}
        & there
    )
    assert "sern_runtime.fabric.zenoh_port" not in there
    assert "sern_runtime.config.meanings" not in there, "the source is read for schemas, not for a daemon"


def test_the_guard_needs_neither_link_nor_adaptation() -> None:
    there = imported_by("sern_client.guard_process")
    assert not {"zmq", "sern_core.link.link", "sern_core.adaptation.policy", "prometheus_client"} & there


@pytest.mark.parametrize("first", ["sern_runtime.http", "sern_runtime.watching.page"])
def test_a_daemon_reads_no_certificates_for_a_client_that_it_does_not_use(first: str) -> None:
    program = f"""
import os, ssl
made, contexts = ssl.create_default_context, []
def make(*arguments, **settings):
    contexts.append(made(*arguments, **settings))
    return contexts[-1]
ssl.create_default_context = make
before = dict(os.environ)
import {first}
assert dict(os.environ) == before
print(*(context.cert_store_stats()["x509"] for context in contexts))
"""
    for environment in ({}, {"SSL_CERT_FILE": "/nowhere"}):
        ended = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, check=True, env=os.environ | environment
        )
        assert ended.stdout.split() == ["0"]
