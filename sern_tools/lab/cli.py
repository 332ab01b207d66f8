"""`sern lab`: make a degraded link on this machine, use it, change it, remove it. Needs root."""

import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Final, NoReturn

import typer

from sern_core.vocabulary.errors import SernError, UsageError
from sern_runtime.profiles import load_profile
from sern_tools.lab.control import Control, ask, describe, running, take_down
from sern_tools.lab.host import missing_rights
from sern_tools.lab.lab import Lab
from sern_tools.lab.removal import sweep

EXIT_ERROR: Final = 2
EXIT_INTERRUPTED: Final = 130
_POLL_S: Final = 0.05
_LAST_WORDS_S: Final = 1.0
_RATES: Final = {"bit": 1.0, "kbit": 1e3, "mbit": 1e6, "gbit": 1e9}
_TIMES: Final = {"s": 1.0, "ms": 1e-3, "us": 1e-6}

app = typer.Typer(
    help="A degraded link between network namespaces, made by the kernel's own netem. Needs root.",
    no_args_is_help=True,
)

_Profile = Annotated[str, typer.Option("--profile", "-p", help="A named link profile; its script is played.")]
_Profiles = Annotated[Path | None, typer.Option("--profiles", help="A file with profiles of your own.")]
_Backend = Annotated[str, typer.Option("--backend", help="auto, native (netem here) or appliance (netem in a guest).")]
_SideA = Annotated[str, typer.Option("--a", help="Namespaces on side a, separated by commas; up is from here.")]
_SideB = Annotated[str, typer.Option("--b", help="Namespaces on side b.")]
_Congestion = Annotated[str, typer.Option("--congestion", help="TCP congestion control inside; machine: unchanged.")]


class _Stopped(Exception):  # noqa: N818 - an order, not an error
    """SIGINT, SIGTERM or SIGHUP has come."""


def _stop(number: int, frame: FrameType | None) -> NoReturn:
    del number, frame
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)  # removing the lab is not to be interrupted in its turn
    raise _Stopped


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def _errors_in_one_line() -> Iterator[None]:
    before = {number: signal.signal(number, _stop) for number in _SIGNALS}
    try:
        yield
    except _Stopped:
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except SernError as error:
        typer.echo(f"sern lab: {error}", err=True)
        raise typer.Exit(EXIT_ERROR) from error
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _require_root() -> None:
    lacking = missing_rights()
    if lacking:
        raise UsageError(f"the lab needs {', '.join(lacking)}")


def _lab(a: str, b: str, backend: str, congestion: str) -> Lab:
    sides = [[name for name in side.split(",") if name] for side in (a, b)]
    wanted = None if backend == "auto" else backend
    return Lab(*sides, backend=wanted, congestion=None if congestion == "machine" else congestion)


@app.command()
def up(
    profile: _Profile = "wifi",
    profiles: _Profiles = None,
    backend: _Backend = "auto",
    a: _SideA = "a",
    b: _SideB = "b",
    congestion: _Congestion = "cubic",
) -> None:
    """Make a lab and keep it until Ctrl-C or `sern lab down`."""
    with _errors_in_one_line():
        _require_root()
        chosen = load_profile(profile, profiles)
        try:
            with _lab(a, b, backend, congestion) as lab:
                control = Control(lab, lambda name: load_profile(name, profiles))
                try:
                    control.play(chosen)
                    typer.echo(_welcome(lab, profile))
                    control.serve()
                finally:
                    control.close()
        except _Stopped:
            typer.echo("removed")
            return
        typer.echo("removed")


def _welcome(lab: Lab, profile: str) -> str:
    width = max(len(node.namespace) for node in lab.nodes)
    first, last = lab.nodes[0], lab.nodes[-1]
    lines = [f"lab {lab.id} ({lab.backend}), profile {profile}"]
    lines += [f"  {node.namespace:{width}}  {node.address}" for node in lab.nodes]
    lines += [f"  {line}" for line in describe(lab).splitlines()]
    lines += [
        "run something inside:",
        f"  ip netns exec {first.namespace} ping {last.address}",
        "change the link, from another terminal:",
        "  sern lab link --rate 1mbit --delay 250ms --loss 2%",
        "Ctrl-C or `sern lab down` removes everything.",
    ]
    return "\n".join(lines)


@app.command()
def link(
    rate: Annotated[str | None, typer.Option(help="As 500kbit, 4mbit; none for no limit.")] = None,
    delay: Annotated[str | None, typer.Option(help="One way, as 25ms.")] = None,
    jitter: Annotated[str | None, typer.Option(help="Standard deviation of the delay, as 5ms.")] = None,
    loss: Annotated[str | None, typer.Option(help="As 2%.")] = None,
    duplicate: Annotated[str | None, typer.Option(help="As 1%.")] = None,
    reorder: Annotated[str | None, typer.Option(help="Share of packets that overtake the others, as 1%.")] = None,
    queue: Annotated[int | None, typer.Option(help="Packets that the bottleneck holds.")] = None,
    blackout: Annotated[bool | None, typer.Option("--blackout/--no-blackout", help="Lose everything.")] = None,
    direction: Annotated[str, typer.Option(help="up (a to b), down, or both.")] = "both",
    profile: Annotated[str | None, typer.Option("--profile", "-p", help="Play a named profile instead.")] = None,
    lab: Annotated[str | None, typer.Option(help="Which lab, when several run.")] = None,
) -> None:
    """Change the link of a lab that runs, and show what it is now; without options, only show it."""
    with _errors_in_one_line():
        _require_root()
        changes = _changes(rate, delay, jitter, loss, duplicate, reorder, queue)
        request: dict[str, Any] = {"do": "show"}
        if profile is not None:
            if changes or blackout is not None:
                raise UsageError("give either --profile or single changes")
            request = {"do": "profile", "name": profile}
        elif changes or blackout is not None:
            request = {"do": "link", "direction": direction, "changes": changes, "blackout": blackout}
        typer.echo(ask(_one(lab), request)["link"])


def _changes(
    rate: str | None, delay: str | None, jitter: str | None, loss: str | None, duplicate: str | None,
    reorder: str | None, queue: int | None,
) -> dict[str, Any]:  # fmt: skip
    changes: dict[str, Any] = {}
    if rate is not None:
        changes["rate_bps"] = None if rate == "none" else quantity("--rate", rate, _RATES, "4mbit")
    for name, text in (("delay", delay), ("jitter", jitter)):
        if text is not None:
            changes[f"{name}_s"] = quantity(f"--{name}", text, _TIMES, "25ms")
    for name, text in (("loss", loss), ("duplicate", duplicate), ("reorder", reorder)):
        if text is not None:
            changes[name] = quantity(f"--{name}", text, {"%": 0.01}, "2%")
    if queue is not None:
        changes["queue_packets"] = queue
    return changes


def quantity(option: str, text: str, units: dict[str, float], example: str) -> float:
    """A number with its unit. UsageError that names the option and the units."""
    match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)\s*([a-z%]+)", text.strip().lower())
    if match is None or match[2] not in units:
        raise UsageError(f"{option} {text}: give a number and one of {', '.join(units)}, as {example}")
    return float(match[1]) * units[match[2]]


def _one(lab: str | None) -> str:
    there = running()
    if lab is not None:
        if lab not in there:
            raise UsageError(f"no lab {lab}; running: {', '.join(there) or 'none'}")
        return lab
    if len(there) != 1:
        what = f"several labs run ({', '.join(there)}): choose one with --lab" if there else "no lab runs: sern lab up"
        raise UsageError(what)
    return there[0]


@app.command()
def down(lab: Annotated[str | None, typer.Argument(help="Which lab; all of them when left out.")] = None) -> None:
    """Remove labs that run, and whatever labs of dead processes have left."""
    with _errors_in_one_line():
        _require_root()
        for each in running() if lab is None else [_one(lab)]:
            take_down(each)
            typer.echo(f"lab {each} removed")
        for each in sweep():
            typer.echo(f"removed what lab {each} had left")


@app.command(
    "run",
    context_settings={
        "ignore_unknown_options": True,
        "allow_interspersed_args": False,
        "help_option_names": ["--help"],
    },
)
def run_command(
    profile: Annotated[str, typer.Argument(help="A named link profile; its script is played.")],
    commands: Annotated[list[str], typer.Argument(help="COMMAND_A -- COMMAND_B", metavar="-- CMD_A -- CMD_B")],
    profiles: _Profiles = None,
    backend: _Backend = "auto",
    congestion: _Congestion = "cubic",
) -> None:
    """Run a command on each side of a new lab; when one ends, the other is stopped and the lab removed.

    {a} and {b} in a command stand for the addresses of the sides. The exit status is that of the first to end.
    """
    with _errors_in_one_line():
        _require_root()
        chosen = load_profile(profile, profiles)
        sides = split_commands(commands)
        with _lab("a", "b", backend, congestion) as lab:
            status = _run_both(lab, chosen, sides)
    raise typer.Exit(status)


def split_commands(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The two commands around the last separating `--`. UsageError when there are not two."""
    rest = list(words)
    if rest and rest[0] == "--":
        rest = rest[1:]
    if rest.count("--") != 1 or rest[0] == "--" or rest[-1] == "--":
        raise UsageError("give two commands, each after a --: sern lab run PROFILE -- CMD_A -- CMD_B")
    middle = rest.index("--")
    return rest[:middle], rest[middle + 1 :]


def _run_both(lab: Lab, profile: Any, sides: Sequence[Sequence[str]]) -> int:
    control = Control(lab, load_profile)
    try:
        control.play(profile)
        processes: list[subprocess.Popen[Any]] = []
        for node, words in zip((lab.a, lab.b), sides, strict=True):
            command = [word.replace("{a}", lab.a.address).replace("{b}", lab.b.address) for word in words]
            typer.echo(f"{node.namespace}: {shlex.join(command)}", err=True)
            processes.append(lab.popen(node, command, stdin=subprocess.DEVNULL))
        while not any(process.poll() is not None for process in processes):
            left_s = control.step()
            time.sleep(_POLL_S if left_s is None else min(_POLL_S, left_s))
        # Often the end of one ends the other too: it may have its last words.
        give_up_s = time.monotonic() + _LAST_WORDS_S
        first = next(process for process in processes if process.poll() is not None)
        while any(process.poll() is None for process in processes) and time.monotonic() < give_up_s:
            time.sleep(_POLL_S)
        return first.returncode if first.returncode >= 0 else 128 - first.returncode
    finally:
        control.close()


if __name__ == "__main__":
    sys.exit(app())
