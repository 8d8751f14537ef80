"""A choice can stand in the system file, as a table [fork]; it is a question and no part of the system."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from mdnum.errors import InputError
from mdnum.forks.choices.inputs import float_keys
from mdnum.provenance import hashes
from mdnum.systems import load
from mdnum.systems.load import copy
from mdnum.workflow import fork as workflow

CRYSTAL = "argon/crystal-108"


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any, Any]]:
    """What would be followed: the choice, the last step and the split."""
    seen = []

    def instead(system, vary, options, *_):
        seen.append((vary, options["steps"], options["split"]))

    monkeypatch.setattr(sys.modules[workflow.__module__], "_one", instead)
    return seen


def file(folder: Path, table: str) -> Path:
    path = copy(CRYSTAL, folder)
    path.write_text(f"{path.read_text(encoding='utf-8')}\n{table}\n", encoding="utf-8")
    return path


def test_what_is_not_said_is_read_from_the_file(tmp_path, told):
    path = file(tmp_path, '[fork]\nvary = "reduction=exact"\nsteps = 70\nsplit = 0.01')
    workflow(path)
    workflow(path, "order", steps=30)
    workflow(path, overrides={"fork.vary": "start"})
    workflow(CRYSTAL, "order")
    assert told == [
        ("reduction=exact", 70, 0.01),
        ("order", 30, 0.01),
        ("start", 70, 0.01),
        ("order", None, None),
    ]


def test_a_question_is_no_part_of_the_system(tmp_path):
    plain, asking = load(CRYSTAL, world="md"), load(file(tmp_path, '[fork]\nvary = "order"'), world="md")
    assert hashes(plain)["program"] == hashes(asking)["program"]
    split = load(CRYSTAL, {"fork.split": 0.1}, world="md")
    assert dict(float_keys(split)) == dict(float_keys(plain))
    assert "[fork]" in asking.to_toml() and "[fork]" not in plain.to_toml()


def test_what_cannot_be_asked_is_refused(tmp_path, told):
    with pytest.raises(InputError, match="nothing to vary") as caught:
        workflow(CRYSTAL)
    assert "[fork]" in str(caught.value)
    with pytest.raises(InputError, match=r"unknown key .vari. in .fork.. Did you mean vary"):
        load(file(tmp_path, '[fork]\nvari = "order"'))
    with pytest.raises(InputError, match="steps"):
        load(CRYSTAL, {"fork.steps": 0}, world="md")
    assert told == []
