"""The schema: defaults, what the JSON schema says of it, and that the shipped copy is current."""

from __future__ import annotations

import json

import pytest
from pydantic import ValidationError

from mdnum.systems import shipped_folder
from mdnum.systems.load import BALL_SCHEMA, json_schema
from mdnum.systems.schema import DEFAULT_SKIN, SystemSpec, pair_key

MINIMAL = {
    "units": "metal",
    "structure": {"file": "a.extxyz"},
    "potential": {"kind": "lennard-jones", "sigma": 3.4, "epsilon": 0.01},
    "cutoff": {"kind": "hard", "radius": 8},
    "dynamics": {"kind": "nve", "timestep": 0.002},
}


@pytest.mark.parametrize(("file", "root"), [("schema.json", "SystemSpec"), (BALL_SCHEMA, "BallSpec")])
def test_the_shipped_json_schema_is_current_and_describes_every_key(file, root):
    shipped = json.loads((shipped_folder() / file).read_text(encoding="utf-8"))
    made = json_schema(file)
    assert shipped == made, "run scripts/make_systems.py --schema"
    tables = {"structure", "potential", "cutoff", "neighbors", "dynamics", "precision", "record", "rebuild"}
    tables |= {"start", "flight", "contact", "integrator", "loss", "gradient", "control"}
    silent = [
        f"{name}.{key}"
        for name, table in {**made["$defs"], root: made}.items()
        for key, value in table.get("properties", {}).items()
        if "description" not in value and key not in {"kind", "rule", "units", *tables}
    ]
    assert silent == []


def test_defaults():
    spec = SystemSpec.model_validate(MINIMAL)
    assert spec.cutoff is not None
    assert spec.cutoff.compare == "r2 <"
    assert spec.skin == DEFAULT_SKIN["metal"] == 1.0
    assert SystemSpec.model_validate({**MINIMAL, "units": "lj"}).skin == 0.3
    assert (spec.neighbors.rebuild.every, spec.neighbors.rebuild.delay, spec.neighbors.rebuild.check) == (
        1,
        0,
        True,
    )
    assert spec.neighbors.builder == "auto"
    assert spec.dynamics.remove_drift
    assert set(spec.precision.model_dump().values()) == {"float64", "sequential"}
    assert spec.record.save_every == 0


def test_a_spec_is_frozen():
    spec = SystemSpec.model_validate(MINIMAL)
    with pytest.raises(ValidationError, match="frozen"):
        spec.units = "lj"  # type: ignore[misc]


@pytest.mark.parametrize("value", [True, "8", None, float("inf")])
def test_lengths_are_not_coerced(value: object):
    with pytest.raises(ValidationError):
        SystemSpec.model_validate({**MINIMAL, "cutoff": {"kind": "hard", "radius": value}})


@pytest.mark.parametrize("onset", [8, 9.5])
def test_an_onset_lies_inside_the_radius(onset: float):
    with pytest.raises(ValidationError, match="not below the radius"):
        SystemSpec.model_validate({**MINIMAL, "cutoff": {"kind": "switched", "radius": 8, "onset": onset}})


def test_in_sigma_needs_a_sigma():
    morse = {"kind": "morse", "depth": 0.3, "alpha": 1.3, "r0": 2.9}
    with pytest.raises(ValidationError, match="morse has none"):
        SystemSpec.model_validate(
            {**MINIMAL, "potential": morse, "cutoff": {"kind": "hard", "in_sigma": 2.5}}
        )


def test_the_order_of_a_pair_does_not_matter():
    assert pair_key("P", "Ni") == pair_key("Ni", "P") == "Ni-P"
