"""The layer contracts of pyproject.toml hold (ARCHITECTURE.md, "Layers")."""

import ast
from pathlib import Path

from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parent.parent
PURE_PACKAGES = ("sern_core", "sern_sim")
# `random` may be imported for its type (a seeded Random is handed in), never for the module's own functions.
RANDOM_ALLOWED = {"Random"}


def test_layers_import_only_downward() -> None:
    assert lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True) == 0


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
