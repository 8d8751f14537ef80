"""Findings from text files, verdicts from findings."""

from __future__ import annotations

import string
import tomllib
from pathlib import Path

import pytest

import mdnum
from mdnum.report.finding import Finding, Texts, conclude, fill, restore

TEXTS = sorted(Path(mdnum.__file__).parent.rglob("*.toml"))


@pytest.mark.parametrize(
    ("text", "values", "written"),
    [
        ("{n:# pair}", {"n": 0}, "no pairs"),
        ("{n:# life lives} {n:? was were}", {"n": 1}, "1 life was"),
        ("{n:# life lives} {n:? was were}", {"n": 1200}, "1,200 lives were"),
        ("{x:2}, {x:+3}, {x}", {"x": 0.0123456}, "0.012, +0.0123, 0.0123"),
        ("{x:%}", {"x": 0.0004}, "under 0.1 %"),
        ("{x:g} {missing}", {"x": 2.50, "missing": None}, "2.5 –"),
        ("{name} {yes}", {"name": "a{b", "yes": True}, "a{b yes"),
    ],
)
def test_fields_are_written_as_people_read_them(text, values, written):
    assert fill(text, values) == written


def test_a_field_without_a_value_is_named():
    with pytest.raises(KeyError, match="speed"):
        fill("{speed} now", {"time": 1})


def test_variants_replace_and_add(tmp_path):
    (tmp_path / "verb.toml").write_text(
        '[LOST]\nseverity = "error"\nseverity_few = "warning"\ntitle = "lost {n:# pair}"\ntext = "Seen."\n'
        'more_first = "First at {step}."\nremedy = "Mend."\nremedy_blind = "Look."\n'
    )
    texts = Texts(tmp_path / "verb.py")
    plain = texts.finding("LOST", n=2)
    assert (plain.severity, plain.title, plain.text, plain.remedy) == (
        "error",
        "lost 2 pairs",
        "Seen.",
        "Mend.",
    )
    other = texts.finding("LOST", "blind", "first", "few", n=1, step=4, section="Lists")
    assert (other.severity, other.text, other.remedy) == ("warning", "Seen. First at 4.", "Look.")
    assert other.values == {"n": 1, "step": 4}
    with pytest.raises(KeyError):
        texts.finding("FOUND")


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_every_sentence_can_be_filled(path):
    """A field that is misspelled or a format that is none would show only when its finding comes up."""
    for entry in tomllib.loads(path.read_text()).values():
        for text in (each for each in entry.values() if isinstance(each, str)):
            fields = {name: 2 for _, name, _, _ in string.Formatter().parse(text) if name}
            assert "{" not in fill(text, fields)


def test_the_headline_names_the_worst_thing():
    error, warning, note = (Finding(code, code, f"the {code}", "") for code in ("error", "warning", "info"))
    assert conclude([], headline="Fine.", best="good").tone == "good"
    assert conclude([note], headline="Fine.", best="good").headline == "Fine."
    judged = conclude([note, warning, warning], headline="Ran.")
    assert (judged.tone, judged.headline) == (
        "warning",
        "Ran. Look first: the warning, and 1 more point below.",
    )
    worst = conclude([note, warning, error], headline="Ran.")
    assert (worst.tone, worst.headline) == ("error", "The error. Ran.")
    assert [each.code for each in worst.findings] == ["error", "warning", "info"]
    assert conclude([error], headline="It is the error.").headline == "It is the error."


def test_a_finding_comes_back_from_a_summary():
    finding = Finding("X", "warning", "t", "u", "v", {"n": 1.5}, "S", "Y")
    assert restore(vars(finding)) == finding
    assert restore({"code": "X", "severity": "bad"}).severity == "info"
