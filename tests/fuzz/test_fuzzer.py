"""The fuzzer finds what is there to be found, keeps what it has learned, and says which input it was."""

from functools import partial
from pathlib import Path

import pytest

from tests.fuzz.__main__ import TARGETS, main
from tests.fuzz.fuzzer import Corpus, FoundError, Fuzzer

WORD = b"SERN"


def fails_at_the_word(data: bytes) -> None:
    """Each letter is a branch of its own, as in a parser: nobody finds all four at once."""
    if data[:1] != WORD[:1]:
        return
    if data[1:2] != WORD[1:2]:
        return
    if data[2:3] != WORD[2:3]:
        return
    if data[3:4] == WORD[3:4]:
        raise ZeroDivisionError


def fuzzer(directory: Path, seed: int = 1) -> Fuzzer:
    corpus = Corpus(directory)
    return Fuzzer(lambda data: partial(fails_at_the_word, data), [b"...."], corpus, watched=(__file__,), seed=seed)


def test_it_gets_behind_branches_one_by_one(tmp_path: Path) -> None:
    with pytest.raises(FoundError) as found:
        fuzzer(tmp_path).run(runs=200_000)
    assert found.value.path.read_bytes()[:4] == WORD
    kept = [path.read_bytes() for path in tmp_path.glob("input-*")]
    assert {WORD[:n] for n in (1, 2, 3)} <= {data[:n] for data in kept for n in (1, 2, 3)}


def test_what_it_has_learned_is_there_in_the_next_run(tmp_path: Path) -> None:
    corpus = Corpus(tmp_path)
    corpus.add(b"SE..")
    again = fuzzer(tmp_path)
    lines = again.lines
    assert lines > fuzzer(tmp_path / "other").lines
    again.run(runs=50)
    assert again.tried == 50


@pytest.mark.interpreted  # no line of compiled code is seen
@pytest.mark.parametrize("name", TARGETS)
def test_each_target_takes_its_seeds_and_some_more(name: str, tmp_path: Path) -> None:
    target = TARGETS[name]
    seeds = list(target.seeds())[:20]
    tried = Fuzzer(target.ready, seeds, Corpus(tmp_path), watched=target.watched)
    tried.run(runs=len(seeds) + 20)
    assert tried.lines > 20
    assert not list(tmp_path.glob("failure-*"))


def test_as_a_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["wire", "--seconds", "0", "--corpus", str(tmp_path)]) == 0
    assert capsys.readouterr().out.startswith("wire: ")
