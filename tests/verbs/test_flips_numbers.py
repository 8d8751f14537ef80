"""Numbers of one page do not contradict one another, and none is told of what was not seen."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import ase
import numpy as np
import pytest
from ase.io import write
from command_line import call

import mdnum
from mdnum.report.section import Table
from mdnum.store import files as manifest
from mdnum.verbs.flips_shared import FlipsView, average
from mdnum.verbs.frame import Outcome

_NUMBER = r"([\d,.]+(?: × 10[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+)?)"


def gas(
    seed: int, frames: int, atoms: int, speed: float, side: float = 9.0, digits: int = 12
) -> list[ase.Atoms]:
    """Atoms that turn about a place that drifts: they come and go at every pace."""
    rng = np.random.default_rng(seed)
    start, drift = rng.uniform(0, side, (atoms, 3)), rng.normal(0, 0.1 * speed, (atoms, 3))
    turn, phase = rng.uniform(0.2, 2.0, (atoms, 3)), rng.uniform(0, 6, (atoms, 3))
    return [
        ase.Atoms(
            "ArNe" * (atoms // 2),
            np.round(start + n * drift + 0.8 * np.sin(turn * speed * n + phase), digits),
            cell=[side] * 3, pbc=True, info={"time": 100.0 * n},
        )
        for n in range(frames)
    ]  # fmt: skip


def examined(tmp_path: Path, frames: list[ase.Atoms], **options: Any) -> Outcome:
    write(tmp_path / "a.traj", frames)
    return mdnum.flips(
        tmp_path / "a.traj", out=tmp_path / "out", **{"cutoffs": [3.1], "report": False, **options}
    )


def value(text: str) -> float:
    """The first number of a text as a page writes it."""
    found = re.search(r"([\d,.]+)(?: × 10([⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+))?", text)
    assert found is not None, text
    power = (found[2] or "⁰").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    return float(found[1].replace(",", "")) * 10.0 ** int(power)


def rows(found: Outcome) -> dict[str, str]:
    """Cells of all tables of a page by their row's name or their column's, those of the first rule."""
    told: dict[str, str] = {}
    for section in found.page.sections:
        for part in section.parts:
            if isinstance(part, Table):
                for row in part.rows:
                    if len(row) == 2:
                        told.setdefault(str(row[0]), str(row[1]))
                    else:
                        for name, cell in zip(part.columns, row, strict=True):
                            told.setdefault(str(name), str(cell))
    return told


PACES = [(0.02, 60, 40), (0.3, 40, 40), (3.0, 30, 24), (50.0, 25, 60)]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))])
@pytest.mark.parametrize(("speed", "frames", "atoms"), PACES)
@pytest.mark.parametrize("digits", [12, pytest.param(2, marks=pytest.mark.nightly), 1])
def test_numbers_agree(tmp_path: Path, seed: int, speed: float, frames: int, atoms: int, digits: int) -> None:
    found = examined(
        tmp_path, gas(seed, frames, atoms, speed, digits=digits), cutoffs=[3.1, 2.0], nearest=[4]
    )
    for one in found.summary["rules"]:
        least, most = one["pairs_least"], one["pairs_most"]
        assert least <= min(one["pairs_first"], one["pairs_last"], one["pairs_mean"])
        assert most >= max(one["pairs_first"], one["pairs_last"], one["pairs_mean"])
        assert one["flips"] == one["entered"] + one["left"]
        assert one["pairs_last"] == one["pairs_first"] + one["entered"] - one["left"]
        assert one["ambiguous"] <= one["flips"] and one["pairs_flipped"] <= one["flips"]
        assert one["flips_per_frame"] * (frames - 1) == pytest.approx(one["flips"])
        around = one["neighbors"]
        assert around["fewest"] <= around["mean"] <= around["most"]
        assert sum(row["inside"] for row in one["by_species"]) / frames == pytest.approx(one["pairs_mean"])
        assert sum(row["entered"] + row["left"] for row in one["by_species"]) == one["flips"]
        for of in ("lifetime", "intermittent"):
            life = one[of]
            order = [life[name] for name in ("quarter_gone", "median", "three_quarters_gone")]
            known = [one for one in order if one is not None]
            assert known == sorted(known) and order[: len(known)] == known
            assert life["followed"] <= sum(one["contacts"].values())
            assert one["lifetime"]["leaves"] == one["left"]
        if one["lifetime"]["leaves"]:
            # one pair of numbers, given twice
            assert one["stays_over"] == pytest.approx(1 - 1 / one["lifetime"]["mean_by_rate"])
        assert one["chatter"]["undone"] <= one["flips"]


@pytest.mark.parametrize("digits", [12, 1])
@pytest.mark.parametrize(("speed", "frames", "atoms"), PACES)
def test_what_the_page_writes_agrees(
    tmp_path: Path, speed: float, frames: int, atoms: int, digits: int
) -> None:
    found = examined(tmp_path, gas(5, frames, atoms, speed, digits=digits))
    one, told = found.summary["rules"][0], rows(found)
    keys = {key.label: f"{key.value} {key.note}" for key in found.page.keys}
    ranges = [text for text in told.values() if "on average" in text]
    assert len(ranges) >= 2
    for text in ranges:
        low, high, mean = re.match(f"{_NUMBER} to {_NUMBER} [a-z]+, {_NUMBER} on average", text).groups()  # type: ignore[union-attr]
        assert value(low) <= value(mean) <= value(high)
    low, high = told["pairs inside"].split(" to ")
    assert value(low) <= value(keys["Pairs inside"]) <= value(high)
    # a median that is a bound never stands beside a mean that is none
    lives = [
        keys["Median contact"],
        keys["Mean by rate"],
        told["Median lifetime"],
        told["Mean lifetime (from the breaking rate)"],
    ]
    assert len({"at most" in text for text in lives}) == 1
    assert ("at most" in lives[0]) == (one["lifetime"]["median"] == 1)
    for finding in found.verdict.findings:
        if finding.code == "UNDECIDABLE":
            assert finding.values["invented"] <= finding.values["share"]


def test_rounding_on_the_page_keeps_a_mean_in_its_range() -> None:
    rng = np.random.default_rng(0)
    for _ in range(500):
        low = int(10 ** rng.uniform(0, 7))
        high = low + int(rng.integers(0, 3))
        mean = rng.uniform(low, high)
        assert low <= value(average(mean)) <= high


def test_worst_and_expected_rounding_are_not_told_as_one_number(tmp_path: Path) -> None:
    # large steps between frames: many flips begin or end within the bound, and rounding moves hardly any
    found = examined(tmp_path, gas(1, 120, 60, 50.0, digits=2), cutoffs=[3.0])
    one = found.summary["rules"][0]
    share = one["ambiguous"] / one["flips"]
    assert max(one["grid"]["missed"], one["grid"]["invented"]) < share / 3
    (said,) = [one for one in found.verdict.findings if one.code == "UNDECIDABLE"]
    assert "decided up to" in said.text and "of typical size" in said.text


def test_a_cutoff_below_every_distance_is_no_contact(tmp_path: Path) -> None:
    found = examined(tmp_path, gas(0, 20, 24, 0.3), cutoffs=[1e-3])
    keys = {key.label: key.value for key in found.page.keys}
    assert keys["Median contact"] == keys["Mean by rate"] == "no contact"
    assert "larger than the cutoff" in found.verdict.headline
    assert "longer than seen" not in " ".join(rows(found).values())
    # with a rule that has some, the other still has none
    (tmp_path / "b").mkdir()
    both = examined(tmp_path / "b", gas(0, 20, 24, 0.3), cutoffs=[3.0, 1e-3])
    view = FlipsView(None, both.summary)  # type: ignore[arg-type]
    assert [view.life(one) == "no contact" for one in both.summary["rules"]] == [False, True]


def test_contacts_that_never_begin_or_end_have_no_lifetimes(tmp_path: Path) -> None:
    frames = [one for one in gas(0, 1, 24, 0.0) for _ in range(6)]
    for n, one in enumerate(frames := [one.copy() for one in frames]):
        one.info["time"], one.positions = 2.0 * n, one.positions + 1e-4 * n
    found = examined(tmp_path, frames)
    keys = {key.label: key.value for key in found.page.keys}
    # a reason in place of a number
    assert not re.search(r"\d", keys["Median contact"] + keys["Mean by rate"]) and "–" not in keys.values()


def test_one_frame_has_no_rates(tmp_path: Path) -> None:
    found = examined(tmp_path, gas(0, 1, 24, 0.3))
    words = " ".join([*(f"{key.value} {key.note}" for key in found.page.keys), *rows(found).values()])
    assert " per ps" not in words and "per frame" not in words and "longer than seen" not in words
    assert "nan" not in words and "inf" not in words


@pytest.mark.parametrize("other", [False, True])
def test_a_folder_of_another_version_ends_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], other: bool
) -> None:
    write(tmp_path / "a.traj", gas(1, 6, 20, 0.3))
    write(tmp_path / "b.traj", gas(2, 6, 20, 0.3))
    second = (tmp_path / "b.traj",) * other
    mdnum.flips(tmp_path / "a.traj", *second, cutoffs=[3.0], report=False, out=tmp_path / "out")
    folder = tmp_path / "out"
    whole = json.loads((folder / "summary.json").read_text())
    rule = whole["rules"][0]

    def reported(summary: dict[str, Any]) -> tuple[int, str]:
        (folder / "summary.json").write_text(json.dumps(summary))
        manifest.update(folder, manifest.listed_files(folder, ["summary.json"]))
        capsys.readouterr()
        return call("report", str(folder)), capsys.readouterr().err

    for key in ("resolution", "times" if other else "flight"):
        code, err = reported({name: value for name, value in whole.items() if name != key})
        assert code and err.count("\n") == 1 and f"'{key}'" in err and "another version" in err
    key = "growth" if other else "pairs_least"
    kept = {name: value for name, value in rule.items() if name != key}
    code, err = reported(whole | {"rules": [kept]})
    assert code and err.count("\n") == 1 and f"'{key}'" in err
    assert reported(whole) == (0, "")
