"""The generated files are those of the models, and the schemas take what the loader takes."""

import json
from pathlib import Path

import pytest

from sern_runtime.config import export

ROOT = Path(__file__).resolve().parents[3]
OUTPUTS = export.outputs(ROOT / "schemas", ROOT / "docs" / "configuration.md")


@pytest.mark.parametrize("path", OUTPUTS, ids=lambda path: path.name)
def test_generated_files_are_up_to_date(path: Path) -> None:
    assert path.read_text(encoding="utf-8") == OUTPUTS[path], "run: make schemas"


@pytest.mark.parametrize("path", [path for path in OUTPUTS if path.suffix == ".json"], ids=lambda path: path.name)
def test_every_key_has_a_description(path: Path) -> None:
    schema = json.loads(OUTPUTS[path])
    sections = [schema, *schema.get("$defs", {}).values()]
    bare = [
        f"{section.get('title')}.{key}"
        for section in sections
        for key, part in section.get("properties", {}).items()
        if "description" not in part and "$ref" not in part
    ]
    assert bare == []
    assert all("description" in section for section in sections if section.get("type") == "object")


def test_reference_has_no_empty_cell_and_no_section_twice() -> None:
    text = export.reference_text()
    assert "|  |" not in text
    for part in text.split("\n## ")[1:]:
        headings = [line for line in part.splitlines() if line.startswith("### ")]
        assert len(headings) == len(set(headings))


def test_main_writes_the_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export.main([str(tmp_path / "schemas"), str(tmp_path / "docs" / "c.md")]) == 0
    assert (tmp_path / "schemas" / "client.schema.json").read_text(encoding="utf-8") == export.schema_texts()[
        "client.schema.json"
    ]
    assert (tmp_path / "docs" / "c.md").is_file()
    assert export.main([]) == 2
    assert capsys.readouterr().err.startswith("usage: ")
