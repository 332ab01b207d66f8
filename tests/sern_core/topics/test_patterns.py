"""Patterns: what is accepted, the same answers as Python's `re` where both know the syntax, and a bounded cost."""

import re
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sern_core.topics import patterns
from sern_core.topics.patterns import MAX_CLIENT_PROGRAM, MAX_PROGRAM, PatternError, PatternSet, compile_pattern
from sern_core.vocabulary.errors import UsageError
from tests.exploring import cases

PURE = settings(max_examples=cases(80))


@pytest.mark.parametrize(
    ("text", "matched", "not_matched"),
    [
        (".*", "/a", "/ä"),
        ("/map|/costmap.*", "/costmap_1", "/maps"),
        (".*/odom", "/r/odom", "/odometry"),
        ("/.*/camera/.*/image.*", "/r/camera/left/image_raw", "/r/camera/image"),
        ("/(robot1|robot2)/(odom|imu|tf|cmd_vel)|.*/points.*", "/robot2/imu", "/robot3/imu"),
        ("(?:/[a-z]+)?/odom", "/odom", "/a/b/odom"),
        ("/jackal[0-9]{1,3}/.*", "/jackal12/x", "/jackal1234/x"),
        (r"/a\.b/[^/]+", "/a.b/c", "/a.b/c/d"),
        ("/x{2}y{0,3}z{}", "/xxyyz{}", "/xxyyz"),
        ("[]/]x[^]/]", "]xa", "]x]"),
        ("(?i)/ab", "/aB", "/ac"),
        ("/a(?i:b)c", "/aBc", "/aBC"),
        ("[{,3}]", "{", "a"),
        (r"\{,3}", "{,3}", "a"),
        (r"/[[:alpha:]{,3}]+", "/a{3", "/4"),
        ("(a*)*b?", "aaa", "c"),
        ("/tf", "/tf", "/tf\n"),
        ("/t.*", "/tf", "/t\nf"),
    ],
)
def test_what_matches(text: str, matched: str, not_matched: str) -> None:
    for pattern in (compile_pattern(text), PatternSet(["/other/x+", text])):
        assert pattern.fullmatch(matched)
        assert not pattern.fullmatch(not_matched)
    assert compile_pattern(text).pattern == text


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty; '.*' matches everything"),
        ("a" * 513, "is longer than 512 characters"),
        ("/ä.*", "holds something else than printable ASCII"),
        ("/a\n", "holds something else than printable ASCII"),
        ("/a\0", "holds something else than printable ASCII"),
        ("(", "is not a regular expression (missing ))"),
        ("[a", "is not a regular expression (missing ])"),
        ("a)(b", "is not a regular expression (unexpected ): a)(b)"),
        ("*", "is not a regular expression (no argument for repetition operator: *)"),
        ("\\", "is not a regular expression (trailing \\)"),
        ("(?=x).*", "is not a regular expression ((?=: RE2 has no look-around and no conditions)"),
        ("(?<!x)a", "is not a regular expression ((?<!: RE2 has no look-around and no conditions)"),
        (r"(.*)\1", r"is not a regular expression (\1: RE2 has no back-references)"),
        ("(?>a)", "is not a regular expression ((?>: RE2 has no look-around and no conditions)"),
        ("a++", "is not a regular expression (bad repetition operator: ++)"),
        ("a{,3}", "has {,3}, which is no repeat in RE2; write {0,3}"),
        ("a{99999999999999999999}", "has a repeat of "),
        ("a{1001}", "is not a regular expression (invalid repetition size: {1001})"),
        ("((a{100}){100}){10}", "is not a regular expression (invalid repetition size: {100})"),
        (r"/a\Q", r"has \Q; put '\' before each special character instead"),
        (".{0,1000}", f"is too large (more than {MAX_PROGRAM} steps)"),
        (".{0,1000}" * 50, f"is too large (more than {MAX_PROGRAM} steps)"),
    ],
)
def test_what_is_no_pattern_is_told_in_one_line(text: str, said: str, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(PatternError) as caught:
        PatternSet(["/fine/.+", text])
    assert isinstance(caught.value, UsageError)
    assert caught.value.text == text
    assert str(caught.value).startswith(said)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 200
    assert capfd.readouterr() == ("", "")  # RE2 itself says nothing


def test_a_pattern_stays_in_its_own_alternative() -> None:
    both = PatternSet(["/a|(?i)/b", "/c"])
    assert [name for name in ("/a", "/B", "/C", "/c", "/ab", "/b/c") if both.fullmatch(name)] == ["/a", "/B", "/c"]


def test_the_size_of_all_patterns_together_is_bounded() -> None:
    large = [f"/{letter}(?:.{{0,100}}){{0,6}}" for letter in "abcd"]
    assert PatternSet(large).program > MAX_CLIENT_PROGRAM  # a file may have any number
    assert PatternSet(large).fullmatch("/dx")
    with pytest.raises(PatternError, match="too large together") as caught:
        PatternSet(large, max_program=MAX_CLIENT_PROGRAM)
    assert caught.value.text is None
    names = [f"/robot{number}/odom" for number in range(256)]
    assert PatternSet(names, max_program=0).fullmatch("/robot255/odom")  # plain names cost nothing


# Beside Python's own -------------------------------------------------------------------------------------------------

ATOMS = st.sampled_from([*"ab/_1.", "[ab]", "[^a]", "[/-9]", "[]a]", r"\d", r"\w", r"\W", r"\.", r"\x61"])
QUANTIFIERS = st.sampled_from(["", "*", "+", "?", "{2}", "{0,2}", "{1,}", "*?", "+?", "??", "{1,2}?"])


def _sequence(parts: list[tuple[str, str]]) -> str:
    return "".join(f"(?:{atom}){quantifier}" if len(atom) > 1 else atom + quantifier for atom, quantifier in parts)


def _larger(inner: st.SearchStrategy[str]) -> st.SearchStrategy[str]:
    grouped = inner.map(lambda text: f"({text})")
    either = st.lists(inner, min_size=1, max_size=3).map("|".join)
    return st.lists(st.tuples(grouped | ATOMS, QUANTIFIERS), min_size=1, max_size=3).map(_sequence) | either


SEQUENCES = st.lists(st.tuples(ATOMS, QUANTIFIERS), min_size=1, max_size=3).map(_sequence)
TEXTS = st.recursive(SEQUENCES, _larger, max_leaves=5)
SIMPLE = st.lists(st.sampled_from(["/a", "/b", "ab", "_1", ".*", "|"]), min_size=1, max_size=4).map("".join)
NAMES = st.text(alphabet="ab/_19.\n", max_size=9)


@PURE
@given(st.lists(TEXTS | SIMPLE, min_size=1, max_size=3), st.lists(NAMES, max_size=8))
def test_the_same_answers_as_pythons_own(texts: list[str], names: list[str]) -> None:
    try:
        ours = PatternSet(texts)
    except PatternError:
        return  # such as a repeat of a repeat
    assert ours == PatternSet(texts) and hash(ours) == hash(PatternSet(texts))
    theirs = [re.compile(text, re.ASCII) for text in texts]
    for name in names:
        # A name with a line break is no name: nothing matches it here.
        expected = "\n" not in name and any(pattern.fullmatch(name) for pattern in theirs)
        assert ours.fullmatch(name) is expected, (texts, name)


@PURE
@given(st.text(alphabet="ab/.*+?(|){}[]^\\1,:P<Q$", max_size=30) | st.text(max_size=20), st.text(max_size=20))
def test_accepted_or_refused_and_nothing_else(text: str, name: str) -> None:
    try:
        pattern = compile_pattern(text)
    except PatternError:
        return
    for other in (name, "/" + "ab" * 20, text, "\ud800"):
        assert PatternSet([text, "x+y"]).fullmatch(other) is pattern.fullmatch(other) or other[:1] == "x"
    assert not pattern.fullmatch("/ä")


# Cost ----------------------------------------------------------------------------------------------------------------

HOSTILE = [
    ".*.*.*!",
    ".*a.*a.*a!",
    ".*[a-z].*[a-z].*[a-z]!",
    "(?:.)*(?:.)*(?:.)*!",
    "(?:a|/)*(?:.)*!",
    ".?" * 26 + "!",
    "(?:.?){17}!",
    ".{0,99}.{0,99}.{0,99}[a-z].?.?.?!",
    "[a-z/]*?[a-z]*?[a-z]*?[a-z]!",
    "(a?){500}a{500}",
    "(.*)*!",
    "(a|a)*!",
    "((a*)*)*!",
    "(?:.{0,100}){0,6}",
    "(.?.?.?.?.?.?.?.?.?.?){40}!",
    ".*a.{250}|.*b.{250}|.*[ab].{240}!",
    "(.*[a-m].*[n-z]){60}!",
    "(?i:[!-~])" * 30,
    "(?:" * 80 + "a" + ")" * 80,
    "(" * 90 + "a" + ")" * 90,
    "(?:a|" * 80 + "a" + ")" * 80,
    "x{0,255}" * 3,
]


@pytest.mark.parametrize("text", HOSTILE)
def test_no_pattern_takes_long(text: str) -> None:
    """A backtracking matcher needs seconds to hours for most of these."""
    names = ["/" + "a" * 254, "/" + "ab" * 127, "/" + "anz" * 84, "/" + "a" * 40]
    begun_s = time.thread_time()
    pattern = compile_pattern(text)
    for name in names:
        pattern.fullmatch(name)
    assert time.thread_time() - begun_s < 1.0  # some milliseconds


def test_what_cannot_match_costs_no_steps() -> None:
    pattern = PatternSet(["/robot1/(?:odom|imu)_.*", "/robot2/x+", "/map"])
    assert pattern.steps("/robot1/odom_1") == pattern.program > 0
    assert pattern.steps("/robot3/odom_1") == pattern.steps("/map") == 0
    assert PatternSet(["(?:x|)/a", "/b+"]).steps("/c") > 0  # may begin with anything


def test_what_is_compiled_is_not_kept() -> None:
    """Hostile patterns come in any number; only whoever uses one keeps it."""
    kept = patterns.re2._Regexp._make.cache_info  # type: ignore[attr-defined]
    for number in range(20):
        compile_pattern(f"/a{number}.+")
    assert kept().currsize == 0
