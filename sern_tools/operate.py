"""`sern set`: change what a running client does with a topic, over the client's local socket."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from sern_core.vocabulary.errors import SernError, UsageError
from sern_runtime.local_socket import ask, sockets
from sern_tools.api import say

Client = Annotated[
    str | None,
    typer.Option(
        "--client", "-c", help="Which client of this machine: its name, or its socket [default: the only one]."
    ),
]
SHOWN: Final = 8


def socket_of(client: str | None, found: Callable[[], dict[str, Path]] = sockets) -> Path:
    """The local socket of a client of this machine. Raises SernError when it is not clear which one is meant."""
    if client is not None and "/" in client:
        return Path(client)
    there = found()
    names = ", ".join(sorted(there)[:SHOWN])
    if client is not None:
        if client not in there:
            known = (
                f"there are {names}" if there else "there is none; is a client running, as this user or under systemd?"
            )
            raise SernError(f"no client {client[:80]} has a local socket here: {known}")
        return there[client]
    if not there:
        raise SernError(
            "no client has a local socket here; is one running, as this user or under systemd? --client PATH names one"
        )
    if len(there) > 1:
        raise UsageError(f"several clients run here: {names}; name one with --client")
    return next(iter(there.values()))


def _words(keys: dict[str, Any]) -> str:
    return " ".join(f"{key}={_text(value)}" for key, value in keys.items())


def _text(value: object) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _listed(answer: dict[str, Any]) -> list[str]:
    """What is set by hand, a line each."""
    lines = [f"{name}  {_words(keys)}" for name, keys in sorted(answer["topics"].items())]
    if answer["profile"] is not None:
        lines.append(f"profile  {answer['profile']}")
    return lines or ["nothing is set by hand: all is as the file says"]


def _request(topic: str | None, words: list[str], *, reset: bool, profile: str | None) -> dict[str, Any]:
    """What is asked of the client. Raises UsageError where the options do not fit together."""
    if profile is not None:
        if topic is not None or words:
            raise UsageError("--profile is of all topics; set a topic in another call")
        if reset:
            raise UsageError("--profile and --reset are one too many: `sern set --profile file` is the file's again")
        return {"do": "profile", "name": None if profile == "file" else profile}
    if topic is None:
        if reset:
            raise UsageError("say of which topic: sern set /scan --reset")
        return {"do": "list"}
    if reset and words:
        raise UsageError("--reset takes no key=value: it has the file's rule for the topic again")
    if reset:
        return {"do": "reset", "topic": topic}
    if not words:
        raise UsageError(f"say what to set, such as: sern set {topic[:80]} max_rate_hz=2 (or --reset)")
    return {"do": "set", "topic": topic, "words": words}


def _done(answer: dict[str, Any]) -> str:
    """One line of what was done."""
    if "profile" in answer:
        return f"profile {answer['profile'] or 'of the file'}"
    waits = "; from when all that it owes is delivered" if answer["changing"] else ""
    if "set" not in answer:
        return f"{answer['topic']}  as the file says{waits}"
    return f"{answer['topic']}  {_words(answer['set'])}{waits}"


def release_command(
    topic: Annotated[str, typer.Argument(help="This client's e-stop, or another site's by its global name.")],
    client: Client = None,
) -> None:
    """Release an e-stop that is latched, so that commands are obeyed again. Look at the robot first.

    Who may release the e-stop of another site is who may publish it there (the relay's access rules).

    Exit code 0 when it is done, 1 when it could not be, 2 for wrong usage.
    """
    try:
        answer = ask(socket_of(client), {"do": "release", "topic": topic})
    except SernError as error:
        raise typer.Exit(say("sern release", error)) from None
    done = f"{answer['at']} was told to release it" if answer["at"] else "released"
    print(f"{answer['topic']}  {done}")


def take_command(
    topic: Annotated[
        str | None, typer.Argument(help="The command topic, by its global name; none: who holds what.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Take it, whoever holds it.")] = False,
    give: Annotated[bool, typer.Option("--give", help="Give it to who has asked for it first, or to nobody.")] = False,
    client: Client = None,
) -> None:
    """Take command of a robot over from another operator, or give it.

    Who holds it now is said first. Without --force it is asked for: the holder's site is told (`sern events`, its log),
    and has 15 s to give it. Nobody holds it who has sent no command for a while (holder.lapse_s in the robot's file).

    Exit code 0 when it is done, 1 when it was not given or its robot is not there, 2 for wrong usage.
    """
    try:
        if force and give:
            raise UsageError("--force and --give are one too many")
        path = socket_of(client)
        held = ask(path, {"do": "take", "topic": topic, "how": None})["held"]
        for name, said in sorted(held.items()):
            if topic is None or name == topic:
                asked = f", asked for by {', '.join(said['asked'])}" if said["asked"] else ""
                print(f"{name}  held by {said['holder'] or 'nobody'}{asked}", flush=True)
        if topic is None:
            if not held:
                print("no command topic with `holder` is known here")
            return
        how = "force" if force else "give" if give else "ask"
        answer = ask(path, {"do": "take", "topic": topic, "how": how})
    except SernError as error:
        raise typer.Exit(say("sern take", error)) from None
    print(f"{answer['topic']}  held by {answer['holder'] or 'nobody'} now")


def set_command(
    topic: Annotated[
        str | None, typer.Argument(help="A topic that this client sends; nothing: list what is set.")
    ] = None,
    words: Annotated[list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Such as max_rate_hz=2.")] = None,
    reset: Annotated[bool, typer.Option("--reset", help="Have the file's rule for the topic again.")] = False,
    profile: Annotated[
        str | None, typer.Option("--profile", help="Profile of the adaptation; `file`: the file's again.")
    ] = None,
    client: Client = None,
) -> None:
    """Change how a running client sends a topic, at once and until it ends; or list what is set so.

    Keys are those of a rule in `topics`: class, weight, reliability, depth, lifespan_s, deadline_s, max_rate_hz,
    retention_s, max_queue_bytes, compression, too_large. What should last is written into the file as well, and read
    by SIGHUP.

    Exit code 0 when it is done, 1 when there is no such client, 2 for wrong usage.
    """
    try:
        request = _request(topic, words or [], reset=reset, profile=profile)
        answer = ask(socket_of(client), request)
        lines = _listed(answer) if request["do"] == "list" else [_done(answer)]
    except SernError as error:
        raise typer.Exit(say("sern set", error)) from None
    for line in lines:
        print(line)
