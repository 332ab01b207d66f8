"""The layer contracts of pyproject.toml hold (ARCHITECTURE.md, "Layers")."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PURE_PACKAGES = ("sern_core", "sern_sim", "sern_twin", "sern_navigation")
# `random` may be imported for its type (a seeded Random is handed in), never for the module's own functions.
RANDOM_ALLOWED = {"Random"}
OWN_CLOCK = {"loop.py", "logs.py"}  # how long the loop was held, how often a line was written: nothing of the core
PARTS_OF_A_LINK = {
    "answers", "control", "end", "handshake", "housekeeping", "lane", "lanes", "outgoing", "plane", "reading",
    "reassembly", "receiver", "sender", "taking", "texts",
}  # fmt: skip


def test_layers_import_only_downward() -> None:
    """Check in another process: import-linter sets up logging for its process and silences other loggers."""
    code = "import sys; from importlinter.cli import lint_imports; sys.exit(lint_imports(no_cache=True))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_pure_packages_use_no_global_randomness() -> None:
    offenders = []
    for package in PURE_PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import) and any(alias.name == "random" for alias in node.names):
                    offenders.append(f"{path.relative_to(ROOT)}:{node.lineno}")
                if isinstance(node, ast.ImportFrom) and node.module == "random":
                    extra = {alias.name for alias in node.names} - RANDOM_ALLOWED
                    offenders += [f"{path.relative_to(ROOT)}:{node.lineno} {name}" for name in extra]
    assert offenders == []


def test_the_core_is_given_a_clock_that_goes_on_while_the_machine_sleeps() -> None:
    """`time.monotonic` stands still then, and what it measured would be as young as before (sern_runtime/clock.py)."""
    clocks = {"monotonic", "monotonic_ns", "perf_counter", "time"}
    files = [path for name in ("sern_relay", "sern_client", "sern_runtime") for path in (ROOT / name).glob("*.py")]
    offenders = []
    for path in [*files, ROOT / "sern_tools" / "echo.py"]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module == "time":
                offenders += [f"{path.name}:{node.lineno} {alias.name}" for alias in node.names]
            for argument in node.keywords if isinstance(node, ast.Call) else ():
                called = argument.value.func if isinstance(argument.value, ast.Call) else argument.value
                if argument.arg in ("now", "born_s") and isinstance(called, ast.Attribute) and called.attr in clocks:
                    offenders.append(f"{path.name}:{called.lineno}")
            if isinstance(node, ast.Attribute) and node.attr.startswith("monotonic") and path.name not in OWN_CLOCK:
                offenders.append(f"{path.name}:{node.lineno} {node.attr}")
    assert offenders == []


def test_whoever_watches_or_adapts_a_link_goes_through_its_door() -> None:
    """`Link.observe`, `topics` and `apply` (sern_core/link/view.py), and none of the parts that a link is made of."""
    files = [path for name in ("sern_runtime", "sern_core/adaptation") for path in (ROOT / name).rglob("*.py")]
    assert len(files) > 40
    assert [found for path in files for found in _reached(path.read_text(), str(path.relative_to(ROOT)))] == []
    assert _reached("link.sender.queued(), self.link.lanes, link.observe(now=now).lane", "a.py") == [
        "a.py:1 link.lanes",
        "a.py:1 link.sender",
    ]


def _reached(text: str, file: str) -> list[str]:
    """Parts of a link that a module looks at, wherever the link is called one."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute) and node.attr in PARTS_OF_A_LINK:
            owner = node.value
            if "link" in (getattr(owner, "id", None), getattr(owner, "attr", None)):
                found.append(f"{file}:{node.lineno} link.{node.attr}")
    return sorted(found)
