"""The layer contracts of pyproject.toml hold (ARCHITECTURE.md, "Layers")."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PURE_PACKAGES = ("sern_core", "sern_sim")
# `random` may be imported for its type (a seeded Random is handed in), never for the module's own functions.
RANDOM_ALLOWED = {"Random"}


def test_layers_import_only_downward() -> None:
    """In a process of its own: import-linter sets up logging for its process and would silence other tests' loggers."""
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
