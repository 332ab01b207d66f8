"""A private name is used in the file that defines it, and nowhere else (ARCHITECTURE.md, "Packages and layers")."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Final

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = (
    "sern_core", "sern_sim", "sern_runtime", "sern_relay", "sern_client", "sern_twin", "sern_navigation", "sern_tools",
)  # fmt: skip

PUBLIC: Final = frozenset({"_asdict", "_fields", "_make", "_replace"})
"""The documented methods of named tuples, whose names only keep out of the way of the fields."""
FOREIGN: Final = {
    # The constructor that the SDK has for a channel keeps each one for ever; this is what it calls.
    "sern_client/endpoints/foxglove/server.py": {"_create_channel"},
    "sern_runtime/loop.py": {"_current_frames", "_exit"},  # documented: where a thread is, and an end without clean-up
    # What cyclonedds has no public name for: its C layer, and the handles that it takes.
    "sern_client/endpoints/dds/raw.py": {
        "_CQos", "_clayer", "_dll_handle", "_get_deadline", "_get_durability", "_get_entity_name", "_get_lifespan",
        "_get_liveliness", "_get_matched_publications", "_get_matched_subscriptions", "_get_ownership",
        "_get_partition", "_get_reliability", "_get_userdata", "_ref", "_waitset_attach", "_waitset_detach",
        "_waitset_wait",
    },
}  # fmt: skip
"""Names of other projects. None of ours: those belong where they are used, or become public."""
FIELDS_OF: Final = {"sern_client/endpoints/dds/idl.py": {"_sern_store"}}
"""What is put on objects of other projects."""


def _private(name: str) -> bool:
    return name.startswith("_") and name.strip("_") != "" and not name.endswith("__") and name not in PUBLIC


def _targets(node: ast.AST) -> Iterator[ast.expr]:
    if isinstance(node, ast.Assign):
        for target in node.targets:
            yield from target.elts if isinstance(target, ast.Tuple) else (target,)
    elif isinstance(node, ast.AnnAssign | ast.NamedExpr | ast.For):
        yield node.target


def _is_own(node: ast.expr) -> bool:
    return isinstance(node, ast.Name) and node.id in ("self", "cls")


def _defined(tree: ast.AST) -> Iterator[str]:
    """Names that this file gives to functions, classes, constants and attributes of its own classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        for target in _targets(node):
            if isinstance(target, ast.Name):
                yield target.id
                if target.id == "__slots__" and isinstance(node, ast.Assign):
                    yield from filter(None, map(_text, ast.walk(node.value)))
            elif isinstance(target, ast.Attribute) and _is_own(target.value):
                yield target.attr


def _text(node: ast.AST) -> str:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def _used(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Names of attributes and of what is imported, with their lines; those written as text for `getattr` as well."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            yield node.lineno, node.attr
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("getattr", "setattr"):
            yield node.lineno, _text(node.args[1])


def strangers(text: str) -> list[tuple[int, str]]:
    """Private names that a module uses and does not define, with their lines."""
    tree = ast.parse(text)
    defined = set(_defined(tree))
    return sorted({(line, name) for line, name in _used(tree) if _private(name) and name not in defined})


def test_no_private_name_is_used_outside_its_file() -> None:
    found = {
        f"{path.relative_to(ROOT)}:{line} {name}"
        for package in PACKAGES
        for path in (ROOT / package).rglob("*.py")
        for line, name in strangers(path.read_text())
        if name not in _allowed(path)
    }
    assert found == set()


def test_what_is_allowed_is_used() -> None:
    """The lists only shrink."""
    for listed in (FOREIGN, FIELDS_OF):
        for file, names in listed.items():
            assert names == names & {name for _line, name in strangers((ROOT / file).read_text())}, file


def _allowed(path: Path) -> set[str]:
    file = str(path.relative_to(ROOT))
    return FOREIGN.get(file, set()) | FIELDS_OF.get(file, set())


def test_a_stranger_is_found_in_every_way_it_may_come() -> None:
    text = """
from elsewhere import _helper

class Own:
    __slots__ = ("_slot",)
    def __init__(self, other):
        self._mine = other._mine
        self._inherited()
        other._set = other._slot
        getattr(other, "_asked")
        other._replace(a=1).__class__
"""
    assert [name for _line, name in strangers(text)] == ["_helper", "_inherited", "_set", "_asked"]
