"""The table of the study of adaptations."""

import math
from pathlib import Path

import pytest

from sern_core.vocabulary.errors import ConfigError
from sern_perception.training.table import NONE, Study, Tried, interval, joined, ratios, read, table

DOCS = Path(__file__).resolve().parents[2] / "docs"


def test_the_document_has_the_table_of_the_file_beside_it() -> None:
    """`python -m sern_perception.training study --table docs/perception-study.json` prints it."""
    text = (DOCS / "perception.md").read_text()
    between = text.partition("<!-- study begin -->\n")[2].partition("<!-- study end -->")[0]
    assert between == table(read(DOCS / "perception-study.json")) + "\n"


def ious(share: float) -> dict[str, float]:
    return {"ground": share + 0.1, "car": share - 0.1}


def study(*seeds: int, gain: float = 1.5) -> Study:
    rows = [
        Tried(seed, name, ious(0.2 * seed * times)) for seed in seeds for name, times in ((NONE, 1.0), ("more", gain))
    ]
    return Study("abc123", {"steps": 500}, rows)


def test_ratios_are_paired_by_seed() -> None:
    found = study(1, 2, 3)
    assert ratios(found.tried, "more") == pytest.approx([1.5, 1.5, 1.5])
    without = [each for each in found.tried if (each.seed, each.name) != (2, NONE)]
    assert len(ratios(without, "more")) == 2


def test_an_interval_is_students() -> None:
    mean, half = interval([1.0, 2.0, 3.0])
    assert (mean, half) == pytest.approx((2.0, 4.3027 / math.sqrt(3)), abs=1e-3)
    assert interval([4.0])[0] == 4.0 and math.isnan(interval([4.0])[1])


def test_a_row_has_mean_interval_ratio_and_classes() -> None:
    lines = table(study(1, 2)).splitlines()
    half = 100 * 12.7062 * 0.1  # of 0.2 and 0.4: s / sqrt(2) is 0.1
    assert lines[2] == f"| {NONE} | 30.0 ± {half:.1f} |  | 40 | 20 |  |  |  |"
    assert lines[3].startswith("| more | 45.0 ± ") and "| 1.50 ± 0.00 |" in lines[3]
    assert "`abc123`, seeds 1 to 2, steps 500" in lines[-1]


def test_a_file_gives_the_same_study_and_several_give_one(tmp_path: Path) -> None:
    file = tmp_path / "study.json"
    file.write_text(study(1, 2).as_json())
    assert read(file) == study(1, 2)
    assert table(joined([study(3), study(1, 2)])) == table(study(1, 2, 3))


def test_what_is_no_study_or_not_one_study_is_one_line(tmp_path: Path) -> None:
    file = tmp_path / "study.json"
    with pytest.raises(ConfigError, match="No such file"):
        read(file)
    for text in ("no JSON", "[]", '{"commit": "a", "budget": {}, "tried": [{"seed": 1}]}'):
        file.write_text(text)
        with pytest.raises(ConfigError, match="is no study's file") as raised:
            read(file)
        assert "\n" not in str(raised.value)
    for others in ([study(1), study(1)], [study(1), study(2)._replace(commit="other")]):
        with pytest.raises(ConfigError, match="are not one"):
            joined(others)
