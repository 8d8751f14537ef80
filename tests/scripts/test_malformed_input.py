"""Input that no careful person writes: one printable line and exit code 2, or a run; never a traceback."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from command_line import call
from programs import module_of

from mdnum.errors import InputError, MdnumError, printable
from mdnum.report.finding import Finding
from mdnum.systems import load, toml


@pytest.fixture(scope="module")
def campaign() -> Any:
    """The script, whose whole campaign takes minutes."""
    return module_of("scripts/campaigns/malformed_input.py")


def test_a_short_campaign(campaign: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Checked and shown, not run: that has to be compiled."""
    monkeypatch.chdir(tmp_path)
    seen = set()
    for number, (kind, files) in enumerate(campaign.cases(45, 2)):
        for name, data in files.items():
            (tmp_path / name).write_bytes(data)
        for verb in ("check", "show"):
            outcome, said = campaign.call(["systems", verb, "system.toml"])
            assert outcome in ("refused", "ran"), (number, kind, outcome, said)
            seen.add(outcome)
    for words in campaign.COMMANDS:
        outcome, said = campaign.call(list(words))
        assert outcome in ("refused", "ran"), (words, outcome, said)
    assert seen == {"refused", "ran"}


def write(folder: Path, text: str, **files: str) -> Path:
    for name, content in files.items():
        (folder / f"{name}.extxyz").write_text(content)
    (folder / "system.toml").write_text(text)
    return folder / "system.toml"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # sizes from which no distance can be told
        ("22.0 0.0 0.0 0.0 22.0", "1e300 0.0 0.0 0.0 22.0", "cell vector a is 1e+300 Å long"),
        ("5.1 1.0 1.0", "1e200 1.0 1.0", "atom 1 (Ar) has a coordinate of 1e+200 Å"),
        ("5.1 1.0 1.0", "1e17 1.0 1.0", "coordinate is 16 Å"),
        # values that cannot be computed with
        ("steps = 4", "steps = " + "[" * 50 + "]" * 50, "nested more than 20 deep"),
        ("steps = 4", "steps = " + "[" * 50_000 + "]" * 50_000, "nested more than 20 deep"),
        ("steps = 4", "steps = " + "9" * 5000, "not valid TOML"),
        ("steps = 4", "steps = 9223372036854775808", "at most 2^62"),
        ("timestep = 0.002", "timestep = 1e-300", "timestep = 1e-300; expected 0 … from 1e-150"),
        ("sigma = 3.405", "sigma = 1e-300", "sigma = 1e-300"),
    ],
)
def test_sizes_and_values_that_mean_nothing(campaign: Any, tmp_path: Path, old: str, new: str, words: str):
    assert (old in campaign.STRUCTURE) != (old in campaign.ATOMS)
    path = write(tmp_path, campaign.ATOMS.replace(old, new), atoms=campaign.STRUCTURE.replace(old, new))
    with pytest.raises(InputError) as refused:
        load(path)
    said = str(refused.value)
    assert all(part in said for part in words.split(" … ")) and len(said) < 1000


def test_a_small_sigma_and_a_wide_box_are_searched_for_overlaps(campaign: Any, tmp_path: Path):
    flat = campaign.STRUCTURE.replace("5.1 1.0 1.0", "5.1 1.0 3e8").replace('pbc="T T T"', 'pbc="T T F"')
    path = write(tmp_path, campaign.ATOMS.replace("3.405", "1e-12"), atoms=flat)
    assert len(load(path).atoms) == 4
    close = flat.replace("1.0 9.4 1.0", "1.0 22.99999999999999 1.0")
    with pytest.raises(InputError, match=r"atoms 0 \(Ar\) and 2 \(Ar\) overlap"):
        load(write(tmp_path, campaign.ATOMS.replace("3.405", "1e-12"), atoms=close))


def test_what_a_message_quotes_is_printable_and_short():
    error = InputError("unknown \x1b[31m\x9b2J\u202e key " + "x" * 10_000, remedy="see \x07", where="a\x1bb")
    said = str(error)
    assert "\\x1b[31m\\x9b2J\\u202e" in said and "[9,900 more]" in said and len(said) < 300
    assert error.where == "a\\x1bb" and error.remedy == "see \\x07" and "\x1b" not in error.message
    assert len(str(MdnumError("word " * 10_000))) < 1000
    assert printable("Å, σ³ and\n\ttabs; 3\u00a0×\u00a010⁻³") == "Å, σ³ and\n\ttabs; 3\u00a0×\u00a010⁻³"
    # an error that is raised again with what it said is not escaped twice
    assert InputError(error.message).message == error.message


def test_names_of_a_system_reach_no_terminal_raw(campaign: Any, tmp_path: Path, capsys):
    text = campaign.ATOMS.replace('"argon"', '"a\\u001b[31mb\\u009b\\u202e"')
    path = write(tmp_path, text, atoms=campaign.STRUCTURE)
    for words in (("check",), ("show",), ("show", "--json")):
        assert call("systems", words[0], str(path), *words[1:]) == 0
        out = capsys.readouterr().out
        assert not {"\x1b", "\x9b", "\u202e"} & set(out) and "31mb" in out
    shown = toml.parse(load(path).to_toml(), "shown")
    assert shown["name"] == "a\x1b[31mb\x9b\u202e", "escaped, and the same when it is read"
    from mdnum.cli import output

    output.print_table("\x1b[2J", ("a",), [["\x9bx"]])
    output.print_findings([Finding("X", "info", "\x1b[31m", "\u202e")])
    assert not {"\x1b", "\x9b", "\u202e"} & set(capsys.readouterr().out)


def test_a_backend_that_jax_does_not_have_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys):
    def run(*_: Any, **__: Any) -> None:
        raise RuntimeError("Unable to initialize backend 'nonsense': Backend 'nonsense' is not in the list")

    monkeypatch.setenv("JAX_PLATFORMS", "nonsense")
    monkeypatch.setattr("mdnum.verbs.run.run", run)
    assert call("run", "x") == 2
    said = capsys.readouterr().err
    assert said.startswith("mdnum: jax cannot use JAX_PLATFORMS='nonsense'") and said.count("\n") == 1
