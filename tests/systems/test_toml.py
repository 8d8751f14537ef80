"""TOML text: what is written is read back, and a key's line is found."""

from __future__ import annotations

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mdnum.errors import InputError
from mdnum.systems import toml

scalars = (
    st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]), max_size=12)
)
values = scalars | st.lists(st.floats(allow_nan=False), max_size=3)
keys = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
tables = st.dictionaries(keys, values | st.dictionaries(keys, values, min_size=1, max_size=3), max_size=5)


@given(tables)
def test_what_is_dumped_is_read_back(table: dict):
    assert tomllib.loads(toml.dump(table)) == table


def test_none_is_absent():
    assert toml.dump({"a": None, "b": {"c": 1, "d": None}}) == "[b]\nc = 1\n"


def test_words_of_the_command_line():
    read = {"0.5": 0.5, "20_000": 20000, "true": True, "switched": "switched", '"switched"': "switched",
            "[1, 2]": [1, 2], "r2 <=": "r2 <=", "": "", "1\nb = 2": "1\nb = 2"}  # fmt: skip
    assert {text: toml.scalar(text) for text in read} == read
    parts = {
        "cutoff.kind": ("cutoff", "kind"),
        'potential.pairs."Ni-P".sigma': ("potential", "pairs", "Ni-P", "sigma"),
        "about": ("about",),
    }
    assert {text: toml.dotted(text) for text in parts} == parts
    for text in ("", ".", "a.", ".a", "a b", "a..b"):
        with pytest.raises(InputError, match="is not a key"):
            toml.dotted(text)


TEXT = """\
units = "lj"   # [potential] is below

[potential]
kind = "lennard-jones"

[potential.pairs]
Ni-P = { sigma = 0.8, epsilon = 1.5 }
'P-P'.sigma = 0.88

[cutoff]
radius = 2.5
"""


def test_the_line_of_a_key():
    lines = {
        "units": 1, "potential.kind": 4, "potential.sigma": 3, "potential.pairs.Ni-P.sigma": 7,
        "potential.pairs.P-P.sigma": 8, "cutoff.radius": 11, "dynamics.kind": None,
    }  # fmt: skip
    assert {key: toml.line_of(TEXT, tuple(key.split("."))) for key in lines} == lines
    # an error without a line is at the end
    with pytest.raises(InputError, match=r"^file:2: this is not valid TOML"):
        toml.parse('a = 1\nb = """open', "file")
