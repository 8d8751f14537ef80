"""Words and numbers as people read them, findings from text files, verdicts from findings."""

from __future__ import annotations

import re
import string
import tomllib
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

import mdnum
from mdnum.report import words
from mdnum.report.finding import Finding, Texts, conclude, fill, restore
from mdnum.units import METAL, Measured

TEXTS = sorted(Path(mdnum.__file__).parent.rglob("*.toml"))


def sentences(path: Path) -> list[str]:
    """Those of a text file: they are in tables; what is outside of these, such as a script, is none."""
    entries = tomllib.loads(path.read_text())
    tables = [
        each for each in (*entries.values(), *entries.get("plots", {}).values()) if isinstance(each, dict)
    ]
    return [text for table in tables for text in table.values() if isinstance(text, str)]


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ("at -8.3e-17 m and 1.4e-16 m", "at −8.3\u00a0×\u00a010⁻¹⁷ m and 1.4\u00a0×\u00a010⁻¹⁶ m"),
        ("below 1e-12", "below 10⁻¹²"),
        ("1.5E+06.", "1.5\u00a0×\u00a010⁶."),
        ("2^15 and 10^-3", "2¹⁵ and 10⁻³"),
        ("from h sqrt(k) = 0.23 on", "from h √k = 0.23 on"),
        ("(-1, -.5)", "(−1, −.5)"),
        *(
            (same, same)
            for same in ("0x1.03ecfe9b7bf1fp+0", "2-3 steps of tf32-in-solver", "float32e-3, v1.2e3x")
        ),
    ],
)
def test_typeset(written, read):
    assert words.typeset(written) == read
    assert words.typeset(read) == read


@pytest.mark.parametrize(
    ("write", "read"),
    [
        (words.number, {
            0.0: "0", None: "–", float("nan"): "–", float("-inf"): "−∞", 123456.0: "123,456",
            1234567.0: "1.23\u00a0×\u00a010⁶", -1.681e-4: "−1.68\u00a0×\u00a010⁻⁴", 0.00123: "0.00123",
            9.999e-4: "0.00100", 999.96: "1,000", 0.5: "0.500",
        }),
        # never all or nothing
        (words.percent, {
            0.0: "0 %", 1.0: "100 %", 1e-9: "under 0.1 %", 0.99999: "over 99.9 %", 0.021: "2.1 %",
            1.08: "108 %",
        }),
        # a capital, unless it begins with a name
        (words.heading, {
            "the pair": "The pair", "a column": "A column", "k against y": "k against y", "TF32": "TF32",
            "": "", "jnp.sum hides it": "jnp.sum hides it", "dloss/dk": "dloss/dk",
        }),
    ],
    ids=["number", "percent", "heading"],
)  # fmt: skip
def test_words(write, read):
    assert {value: write(value) for value in read} == read


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
    with pytest.raises(KeyError, match="speed"):
        fill(text + "{speed}", values)


def test_variants_replace_and_add_and_a_finding_comes_back_from_a_summary(tmp_path):
    (tmp_path / "verb.toml").write_text(
        '[LOST]\nseverity = "error"\nseverity_few = "warning"\ntitle = "lost {n:# pair}"\ntext = "Seen."\n'
        'more_first = "First at {step}."\nremedy = "Mend."\nremedy_blind = "Look."\n'
    )
    texts = Texts(tmp_path / "verb.py")
    plain = texts.finding("LOST", n=2)
    assert plain == Finding("LOST", "error", "lost 2 pairs", "Seen.", "Mend.", {"n": 2})
    other = texts.finding("LOST", "blind", "first", "few", n=1, step=4, section="Lists", cause="X")
    values = {"n": 1, "step": 4}
    assert other == Finding(
        "LOST", "warning", "lost 1 pair", "Seen. First at 4.", "Look.", values, "Lists", "X"
    )
    with pytest.raises(KeyError):
        texts.finding("FOUND")
    assert restore(vars(other)) == other
    assert restore({"code": "X", "severity": "bad"}).severity == "info"


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.stem)
def test_every_sentence_can_be_filled(path):
    """A field that is misspelled or a format that is none would show only when its finding comes up."""
    for text in sentences(path):
        parts = [(name, form or "") for _, name, form, _ in string.Formatter().parse(text) if name]
        fields: dict[str, Any] = {
            name.partition("[")[0]: defaultdict(lambda: 2) for name, _ in parts if "[" in name
        }
        fields = {name: 2 for name, _ in parts} | fields
        # a number with its unit is one of which the floor is written, or thousandths
        known = {name.split(".")[0] for name, form in parts if "." in name or re.match(r"[+]?\d*m|=", form)}
        known -= {"units"}
        fields |= dict.fromkeys(known, Measured(2.0, "energy", 1.0, 1.0))
        # errors below the report have formats of Python's
        filled = text.format(**fields) if path.stem == "trial" else fill(text, {"units": METAL, **fields})
        assert "{" not in filled


def test_sentences_are_found_with_their_fields():
    found = {path.stem: sentences(path) for path in TEXTS}
    for verb in ("audit", "ball", "check", "conform", "flips", "fork", "grad", "run"):
        assert len(found[verb]) > 40 and sum("{" in text for text in found[verb]) > 10, verb


def test_the_headline_names_the_worst_thing():
    error, warning, note = (Finding(code, code, f"the {code}", "") for code in ("error", "warning", "info"))

    def judged(found, headline):
        verdict = conclude(found, headline=headline, best="good")
        return verdict.tone, verdict.headline, [each.code for each in verdict.findings]

    assert judged([], "Fine.") == ("good", "Fine.", [])
    assert judged([note], "Fine.") == ("good", "Fine.", ["info"])
    tone, several, found = judged([note, warning, warning], "Ran.")
    assert (tone, found) == ("warning", ["warning", "warning", "info"])
    assert several.startswith("Ran. ") and "the warning, and 1 more" in several
    assert judged([note, warning, error], "Ran.") == (
        "error",
        "The error. Ran.",
        ["error", "warning", "info"],
    )
    assert judged([error], "It is the error.") == ("error", "It is the error.", ["error"])
