"""Writes what is generated from the configuration models: JSON Schemas and the reference.

    python -m sern_runtime.config.export schemas docs/configuration.md

A test compares the files in the tree with what this would write.
"""

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from pydantic import TypeAdapter

from sern_runtime.config.base import FileModel, Section
from sern_runtime.config.client import ClientFile
from sern_runtime.config.keys import PublicKeyFile, SecretKeyFile
from sern_runtime.config.load import models_in
from sern_runtime.config.navigation import NavigationFile
from sern_runtime.config.relay import RelayFile

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
Json = dict[str, Any]

_FILES: Final[tuple[tuple[str, str, type[FileModel]], ...]] = (
    ("Client file", "client.yaml", ClientFile),
    ("Relay file", "relay.yaml", RelayFile),
    ("Navigation file", "navigation.yaml", NavigationFile),
    ("Public key file", "NAME.pub", PublicKeyFile),
    ("Secret key file", "NAME.key", SecretKeyFile),
)

_INTRODUCTION: Final = """\
# Configuration reference

Generated from the configuration models by `make schemas`; do not edit.

Files are YAML 1.2, one a daemon; `sern check FILE` validates one without starting anything, and every error is one
line with file, line, key and the accepted values. Unknown keys are errors. Relative paths start at the directory of
the file. Units are in the names of the keys. Patterns are regular expressions that must match the whole
name, in the syntax of RE2 and in printable ASCII: like Python's, without look-around, back-references and possessive or
atomic groups, `{,3}` is written `{0,3}`, and a repeat goes up to 1000. Matching takes time linear in the length of a
name. A pattern of more than 2048 steps (about one a character, times what repeats say) is refused, and so are more than
4096 steps in all that a client subscribes to. The same models as JSON Schema: `schemas/client.schema.json`,
`schemas/relay.schema.json`, `schemas/navigation.schema.json`, `schemas/keys.schema.json`. Examples: `deploy/examples/`.
"""


def schema_texts() -> dict[str, str]:
    """The content of every schema file by its name."""
    keys: TypeAdapter[Any] = TypeAdapter(PublicKeyFile | SecretKeyFile)
    return {
        "client.schema.json": _schema_text("client", ClientFile.model_json_schema()),
        "relay.schema.json": _schema_text("relay", RelayFile.model_json_schema()),
        "navigation.schema.json": _schema_text("navigation", NavigationFile.model_json_schema()),
        "keys.schema.json": _schema_text("keys", keys.json_schema()),
    }


def _schema_text(name: str, schema: Json) -> str:
    return (
        json.dumps(
            _finite({"$schema": DIALECT, "$id": f"urn:sern:schema:{name}", **schema}),
            indent=2,
            ensure_ascii=False,
            allow_nan=False,
        )
        + "\n"
    )


def _finite(value: Any) -> Any:
    """The value without keys that are infinite, which JSON has not: limits that are none unless a file sets them."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items() if not _infinite(each)}
    return [_finite(each) for each in value] if isinstance(value, (list, tuple)) else value


def _infinite(value: Any) -> bool:
    return isinstance(value, float) and not math.isfinite(value)


def reference_text() -> str:
    """The configuration reference in Markdown."""
    parts = [_INTRODUCTION]
    for title, file, model in _FILES:
        parts.append(f"## {title}: `{file}`\n\n{_prose(model)}\n")
        parts.extend(_sections(model, ()))
    return "\n".join(parts)


def _sections(model: type[Section], path: tuple[str, ...]) -> Iterator[str]:
    """A table for `model`, then those of the sections inside it, depth first."""
    schema = model.model_json_schema()
    definitions = schema.get("$defs", {})
    rows = ["| key | accepted | default | meaning |", "|---|---|---|---|"]
    required = set(schema.get("required", ()))
    for key, part in schema["properties"].items():
        default = "required" if key in required else _default(part, definitions)
        # pydantic leaves out a description that is the same as that of the section it refers to.
        meaning = part.get("description") or _resolved(part, definitions).get("description", "")
        cells = (f"`{key}`", _accepted(part, definitions), default, " ".join(meaning.split()))
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    yield "\n".join(rows) + "\n"
    for name, field in model.model_fields.items():
        for inner in dict.fromkeys(models_in(field.annotation)):
            inner_path = (*path, field.alias or name)
            kind = inner.model_json_schema()["properties"].get("kind", {}).get("const")
            which = f", kind `{kind}`" if kind else ""
            yield f"### `{'.'.join(inner_path)}`{which}\n\n{_prose(inner)}\n"
            yield from _sections(inner, inner_path)


def _prose(model: type[Section]) -> str:
    return " ".join((model.__doc__ or "").split())


def _default(part: Json, definitions: Json) -> str:
    value = part.get("default")
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        return "its defaults"
    if isinstance(value, dict) or ("$ref" in part and _resolved(part, definitions).get("type") == "object"):
        return "its defaults"
    return f"`{json.dumps(value, ensure_ascii=False)}`"


def _resolved(part: Json, definitions: Json) -> Json:
    reference = part.get("$ref")
    if reference is None:
        return part
    resolved: Json = definitions[str(reference).rsplit("/", 1)[-1]]
    return resolved


def _accepted(part: Json, definitions: Json) -> str:
    """The values a key takes, in words."""
    part = _resolved(part, definitions)
    for union in ("anyOf", "oneOf"):
        if union in part:
            words = (_accepted(member, definitions) for member in part[union])
            return " or ".join(dict.fromkeys(words))
    if "const" in part:
        return f"`{part['const']}`"
    if "enum" in part:
        return ", ".join(f"`{word}`" for word in part["enum"])
    kind = part.get("type")
    if kind == "array" and "prefixItems" in part:
        return f"list of {len(part['prefixItems'])}: {_accepted(part['prefixItems'][0], definitions)}"
    if kind == "array":
        return f"list of {_accepted(part['items'], definitions)}"
    if kind in ("number", "integer"):
        return " ".join(("number" if kind == "number" else "whole number", *_bounds(part)))
    if kind == "string":
        return {"regex": "pattern", "date-time": "time"}.get(part.get("format", ""), "text")
    return {"object": "mapping", "boolean": "`true`, `false`", "null": "`null`"}[str(kind)]


def _bounds(part: Json) -> Iterator[str]:
    signs = (("exclusiveMinimum", ">"), ("minimum", "≥"), ("exclusiveMaximum", "<"), ("maximum", "≤"))
    for key, sign in signs:
        if key in part:
            yield f"{sign} {part[key]:g}" if part[key] < 1e6 else f"{sign} {part[key]:.4g}"


def outputs(schemas: Path, reference: Path) -> dict[Path, str]:
    """Every generated file and its content."""
    return {**{schemas / name: text for name, text in schema_texts().items()}, reference: reference_text()}


def main(arguments: list[str]) -> int:
    if len(arguments) != 2:
        print("usage: python -m sern_runtime.config.export SCHEMAS_DIR REFERENCE.md", file=sys.stderr)
        return 2
    for path, text in outputs(Path(arguments[0]), Path(arguments[1])).items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
        print(f"wrote {path}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
