"""Findings of all commands, their sentences and their verdict.

A module determines the codes and values of its findings. A text file (.toml) contains the sentences.
`mdnum/verbs/__init__.toml` explains the format of these text files and of fields in sentences.
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from mdnum.plain import beside, headed, plain
from mdnum.report import words
from mdnum.report.browse import Browse, Column
from mdnum.report.section import Key, Plot, Series, cell
from mdnum.units import Measured, Units, revived

Severity = Literal["info", "warning", "error"]
Tone = Literal["good", "info", "warning", "error"]
_ORDER = ("error", "warning", "info")


@dataclass(frozen=True)
class Finding:
    """A result that the reader of a report should know about."""

    code: str  # stable name, for scripts
    # error: do not use the numbers; warning: look before you do; info: good to know, which changes neither
    # the exit code nor the tone
    severity: Severity
    title: str  # one line, without a capital or a full stop
    text: str  # what was seen, with its numbers
    remedy: str = ""  # what to do, empty if nothing
    values: Mapping[str, Any] = field(default_factory=dict)  # the numbers in it, by name, plain
    section: str = ""  # title of the section of the page that shows it, empty if none does
    cause: str = ""  # code of the finding that this one may follow from, empty if none


class _Fields(string.Formatter):
    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Measured):
            digits, milli, _ = format_spec.partition("m")
            shown = value.to(milli)
            text = shown.digits if digits == "=" else self.format_field(shown.value, digits)
            return f"{text} {shown.unit}".rstrip()
        if format_spec.startswith("#"):
            return words.many(value, *(word.replace("_", " ") for word in format_spec[1:].split()))
        if format_spec.startswith("?"):
            one, several = (word.replace("_", " ") for word in format_spec[1:].split())
            return one if value == 1 else several
        if format_spec == "%":
            return words.percent(value)
        if format_spec == "g":
            return words.plain(value)
        if format_spec.lstrip("+").isdigit():
            return words.number(value, int(format_spec), signed=format_spec.startswith("+"))
        if format_spec:
            raise ValueError(f"{format_spec!r} is not a valid format of a field in a report sentence")
        return cell(value)

    def get_value(self, key: int | str, args: Any, kwargs: Any) -> Any:
        try:
            return revived(super().get_value(key, args, kwargs))
        except (KeyError, IndexError):
            raise KeyError(
                f"the field {key!r} of a sentence has no value; given fields: {', '.join(kwargs) or 'none'}"
            ) from None


class Texts:
    """Sentences of a command, read from the text file of its module.

    Args:
        module: `__file__` of the module; the text file is in the same folder, with the suffix .toml.
        units: unit system that provides the unit names for fields such as `{units.energy}`.
    """

    def __init__(self, module: str | Path, units: Units | None = None):
        self.entries: Mapping[str, Any] = beside(str(module))
        self.units = units

    def finding(
        self,
        code: str,
        *variants: str,
        severity: Severity | None = None,
        section: str = "",
        cause: str = "",
        **values: Any,
    ) -> Finding:
        """Return the finding with a given code. Values fill the fields of its sentences.

        Args:
            variants: alternatives to title, text and remedy, and further sentences (see the module).
            severity, section: replace the severity and section in the text file.
            values: values inserted into the fields of the sentences.

        Raises:
            KeyError: the text file does not contain the code, or a field has no value.
        """
        entry = self.entries[code]
        values = {name: value if isinstance(value, str) else _plain(value) for name, value in values.items()}
        known = {"units": self.units, **values}

        def text(part: str) -> str:
            chosen = next(
                (entry[f"{part}_{v}"] for v in variants if f"{part}_{v}" in entry), entry.get(part, "")
            )
            return fill(chosen, known)

        more = [fill(entry[f"more_{v}"], known) for v in variants if f"more_{v}" in entry]
        worst = severity or next((entry[f"severity_{v}"] for v in variants if f"severity_{v}" in entry), None)
        return Finding(
            code, worst or entry["severity"], text("title"), " ".join(filter(None, [text("text"), *more])),
            text("remedy"), values, section or entry.get("section", ""), cause,
        )  # fmt: skip

    def __call__(self, name: str, /, **values: Any) -> str:
        """Return a sentence from the table [sentences]. Values fill its fields."""
        return fill(self.entries["sentences"][name], {"units": self.units, **values})

    def plot(
        self,
        name: str,
        series: Iterable[Series],
        verticals: Iterable[tuple[float, str]] = (),
        horizontals: Iterable[tuple[float, str]] = (),
        **values: Any,
    ) -> Plot:
        """Return a figure from the table [plots]. Values fill its texts."""
        told: Any = {part: fill(text, values) for part, text in self.entries["plots"][name].items()}
        marks = {"verticals": tuple(verticals), "horizontals": tuple(horizontals)}
        return Plot(name, series=tuple(series), **marks, **told)

    def rows(self, table: str, /, **values: Any) -> list[tuple[str, str]]:
        """Return the rows (name, text) of a table. Rows with a missing value are omitted."""
        rows = ((_first(name, values), _first(text, values)) for name, text in self.entries[table].items())
        return [(name, text) for name, text in rows if name is not None and text is not None]

    def keys(self, table: str = "keys", /, **values: Any) -> list[Key]:
        """Return the key numbers of a page. Missing numbers are omitted."""
        keys = []
        for label, texts in self.entries[table].items():
            for value, note in [texts] if isinstance(texts[0], str) else texts:
                if all(_known(text, values) for text in (label, value, note)):
                    keys.append(Key(fill(label, values), fill(value, values), fill(note, values)))
                    break
        return keys

    def browse(
        self,
        name: str,
        rows: Mapping[str, Any],
        choices: Mapping[str, Sequence[str]] = MappingProxyType({}),
        /,
        **values: Any,
    ) -> Browse:
        """Return a searchable table from [browse]. Columns that `rows` lacks are omitted.

        Args:
            rows: columns of equal length; a column "pair" is made from two of these columns.
            choices: possible words of each column of words, if the text file does not list them.
            values: values inserted into the names and units of columns.
        """
        entry, columns = self.entries["browse"][name], []
        for column in entry["columns"]:
            of, options = column["of"], {"words": choices.get(column["name"], ()), **column}
            if all(rows.get(end) is not None for end in ([of] if isinstance(of, str) else of)):
                texts = {key: fill(options[key], values) for key in ("name", "unit") if key in options}
                data = rows[of] if isinstance(of, str) else [rows[end] for end in of]
                columns.append(Column(**{**options, **texts, "of": data}))
        return Browse(entry.get("name", name), entry["noun"], entry["placeholder"], columns)


def _plain(value: Any) -> Any:
    # infinite numbers are written as such in a sentence
    return value if isinstance(value, float | Measured) else revived(plain(value))


def _first(texts: str | Sequence[str], values: Mapping[str, Any]) -> str | None:
    """Return the first text that has values for all its fields, or None."""
    several = [texts] if isinstance(texts, str) else texts
    return next((fill(text, values) for text in several if _known(text, values)), None)


def _known(text: str, values: Mapping[str, Any]) -> bool:
    """Return True if no field of a text has the value None."""
    names = (name for _, name, _, _ in string.Formatter().parse(text) if name)
    with suppress(TypeError):
        return all(_Fields().get_field(name, (), values)[0] is not None for name in names)
    return False


def fill(text: str, values: Mapping[str, Any]) -> str:
    """Return a sentence with the given values inserted into its fields.

    Raises:
        KeyError: a field has no value.
    """
    return _Fields().vformat(text, (), values)


@dataclass(frozen=True)
class Verdict:
    """Overall verdict on a result."""

    # the worst severity; with neither error nor warning "good", or "info" where nothing was to be good
    tone: Tone
    headline: str  # one sentence, which names the worst thing on its page
    evidence: tuple[str, ...]  # what it rests on, a sentence each
    findings: tuple[Finding, ...]  # errors first

    @property
    def text(self) -> str:
        """Headline and evidence of the verdict as one text."""
        return " ".join((self.headline, *self.evidence))

    def judged(self, kind: str, summary: Mapping[str, Any]) -> dict[str, Any]:
        """Add verdict and findings to a summary. An empty `summary` has the status "unfinished"."""
        usual = {"status": "complete" if summary else "unfinished", "seconds": None}
        found = {"headline": self.headline, "findings": plain(self.findings), "verdict": self.text}
        return headed(kind, {**usual, **summary, **found})


def conclude(
    found: Iterable[Finding],
    evidence: Iterable[str] = (),
    *,
    headline: str,
    best: Tone = "info",
    judged: bool = False,
) -> Verdict:
    """Return a verdict whose tone and headline follow from the most severe finding.

    Args:
        found: findings in the order in which they are to be read, regardless of severity.
        evidence: facts on which the verdict is based, one sentence each.
        headline: the answer to the question of the command.
        best: the tone of the verdict if there is neither an error nor a warning.
        judged: True if the headline already takes the findings into account.
    """
    findings = tuple(sorted(found, key=lambda finding: _ORDER.index(finding.severity)))
    worst = findings[0] if findings else None
    tone = best if worst is None or worst.severity == "info" else worst.severity
    if worst is not None and not judged and worst.title.lower() not in headline.lower():
        if worst.severity == "error":
            headline = f"{worst.title[:1].upper()}{worst.title[1:]}. {headline}"
        elif worst.severity == "warning":
            more = sum(finding.severity == "warning" for finding in findings) - 1
            rest = f", and {words.many(more, 'more warning')}" if more else ""
            headline = f"{headline} Look first: {worst.title}{rest}."
    return Verdict(tone, headline, tuple(evidence), findings)


def restore(kept: Mapping[str, Any]) -> Finding:
    """Restore a finding from its entry in summary.json."""
    severity: Any = kept.get("severity") if kept.get("severity") in _ORDER else "info"
    named = ("code", "title", "text", "remedy", "section", "cause")
    texts = {name: str(kept.get(name) or "") for name in named}
    values = {name: revived(value) for name, value in dict(kept.get("values") or {}).items()}
    return Finding(severity=severity, values=values, **texts)
