"""docs/faults.md names a test for each of its rows, and every test of this package."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROW = re.compile(r"\| `(tests/\S+\.py)(?:::(\w+))?` \|$")


def names_in(file: Path) -> set[str]:
    return set(re.findall(r"^(?:async )?def (test_\w+)\(", file.read_text(), re.MULTILINE))


def test_the_table_and_the_tests_are_the_same() -> None:
    lines = (ROOT / "docs" / "faults.md").read_text().splitlines()
    rows = [line for line in lines if line.startswith("| ") and not line.startswith("| what happens |")]
    named: set[tuple[str, str]] = set()
    for row in rows:
        found = ROW.search(row)
        assert found, f"no test in the last column: {row}"
        file, name = found.groups()
        names = names_in(ROOT / file)
        assert names if name is None else name in names, f"no such test: {found.group(0)}"
        named.add((file, name))
    here = {
        (str(file.relative_to(ROOT)), name)
        for file in Path(__file__).parent.glob("test_*.py")
        if file != Path(__file__)
        for name in names_in(file)
    }
    assert here <= named, f"not in the table: {sorted(here - named)}"
    assert len(rows) > 30
