"""System files of the ball: what they say, what is refused in one line, and that they are written as read."""

from __future__ import annotations

import typing
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import ml_dtypes
import numpy as np
import pytest

from mdnum import systems
from mdnum.ball.limits import smallest
from mdnum.errors import InputError
from mdnum.gradients.ball import BALL_METHODS
from mdnum.systems import BallSystem, System, ball, load
from mdnum.systems.ball import remarks
from mdnum.systems.load import BALL_SCHEMA

FILES = {
    "penalty": """\
about = "a ball"
world = "ball"

[start]
height = 1.0
balls = 3
spread = 0.1

[flight]
gravity = 9.81

[flight.control]
kind = "sine"
amplitude = 1.0
period = 2.0

[contact]
kind = "penalty"
k = 1e4

[integrator]
kind = "semi-implicit-euler"
timestep = 0.001
steps = 100

[gradient]
of = ["k", "y0"]

[variants.low]
precision.state = "float32"
"precision.arithmetic" = "float32"
""",
    "projection": """\
world = "ball"

[contact]
kind = "projection"
k = 0.5
alpha = 0.5

[stop]
rule = "sum"
tol = 1e-6
max_iter = 50

[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
steps = 100
""",
    "impact": """\
world = "ball"
[contact]
kind = "impact"
[integrator]
kind = "event-located"
timestep = 0.01
""",
}


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    for name, text in FILES.items():
        (tmp_path / f"{name}.toml").write_text(text)
    return {name: tmp_path / f"{name}.toml" for name in FILES}


def refusal(path: Path, overrides: dict[str, Any] | None = None) -> str:
    with pytest.raises(InputError) as caught:
        load(path, overrides)
    line = str(caught.value)
    assert "\n" not in line
    assert caught.value.exit_code == 2
    assert caught.value.remedy or "Known" in line
    return line


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_the_world_decides_what_is_loaded(files: dict[str, Path]):
    assert isinstance(load(files["penalty"]), BallSystem)
    assert isinstance(load(files["penalty"], world="ball"), BallSystem)
    assert isinstance(load("argon/crystal-108"), System)
    with pytest.raises(InputError, match=r"is a ball\. .*`mdnum ball "):
        load(files["penalty"], world="md")
    with pytest.raises(InputError, match=r"molecular dynamics\. Use `mdnum run argon/crystal-108`"):
        load("argon/crystal-108", world="ball")
    edit(files["penalty"], 'world = "ball"', 'world = "bal"')
    assert "world = 'bal'; expected \"ball\"" in refusal(files["penalty"])
    edit(files["penalty"], 'world = "bal"\n', "")
    assert "no key `world`" in refusal(files["penalty"])
    assert 'Add `world = "ball"`' in refusal(files["penalty"])


# --- mistakes; ranges and words of single keys are in the JSON schema, whose shipped copy is compared


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("k = 1e4", "k = -1e4", 19, "contact.k = -10000.0 … above 0 … 1/s²"),
        ("k = 1e4", "k = 1e4\nrestitution = 0.8", 20, "unknown key 'restitution' … keys … kind"),
        ('kind = "penalty"', 'kind = "penality"', 18, "unknown contact … mean penalty?"),
        ('kind = "sine"', 'kind = "cosine"', 13, "unknown flight.control kind 'cosine' … constant, sine"),
        ("period = 2.0", "perod = 2.0", 15, "unknown key 'perod' in [flight.control] … period?"),
        ("spread = 0.1", "spread = 0.1\nspread_ulps = 1", 8, "both given"),
        ('of = ["k", "y0"]', 'of = ["k", "stiffness"]', 27, 'gradient.of = "stiffness" … "k"'),
        ('of = ["k", "y0"]', 'of = "k"', 27, 'gradient.of = "k" … an array'),
        ("[variants.low]", "[loss]\ntarget = 1.0\nkind = 'mean-height'\n[variants.low]", 30, "loss.target"),
        ("[variants.low]", "[stop]\nrule = 'sum'\ntol = 1e-6\n[variants.low]", 29, "does not iterate"),
    ],
)
def test_a_mistake_in_the_file(files: dict[str, Path], old: str, new: str, line: int, words: str):
    edit(files["penalty"], old, new)
    said = refusal(files["penalty"])
    assert all(word in said for word in [*words.split(" … "), f"penalty.toml:{line}: "]), said


CONTROL = {"flight.control.kind": "values", "flight.control.values": "[1.0, 2.0]"}
WAVE = {"flight.control.kind": "sine", "flight.control.amplitude": "1", "flight.control.period": "1"}
RELATIVE = {"stop.rule": "relative", "stop.tol": "1e-9"}
SMALL = {"integrator.timestep": "1e-9", "precision.arithmetic": "float16"}
LEAST = "smallest usable tolerance is 8.9e-308"


@pytest.mark.parametrize(
    ("file", "changes", "words"),
    [
        ("penalty", {"contct.k": "1"}, "--set contct.k:  … Did you mean contact?"),
        ("penalty", {"start.height": "[1.0, true]"}, "start.height = [1.0, True] … a number"),
        ("penalty", {"start.height": "[]"}, "start.height is an empty array"),
        ("penalty", {"start.height": "[1.0, 2.0, 3.0]"}, "start.spread has no meaning"),
        ("penalty", {"start.balls": "1"}, "start.spread of a single ball"),
        ("penalty", {"start.boundary.terms": "4"}, "boundary and balls, spread"),
        ("penalty", {"gradient.of": '["alpha"]'}, "names alpha … penalty … damping"),
        ("penalty", {"gradient.of": '["eps"]'}, "contact.eps = 0 is the sharp contact"),
        ("penalty", {"contact.kind": "impact", "gradient.of": '["k"]'}, "names k"),
        ("penalty", {"integrator.kind": "event-located"}, "integrator.kind:  … the contact is a penalty"),
        ("penalty", {"integrator.kind": "implicit-midpoint"}, "[stop] missing … midpoint iterates"),
        ("penalty", {"contact.kind": "projection"}, "[stop] missing … a projection iterates"),
        ("penalty", {"loss.kind": "residual-penetration"}, "--set loss.kind:  … the contact is a penalty"),
        ("penalty", {"precision.reduction": "backwards"}, "--set precision.reduction:  … neumaier"),
        ("penalty", {"precision.reduction": "sequential:3"}, "--set precision.reduction: "),
        # 1e4 is a float16, 1e5 is none
        ("penalty", {"precision.arithmetic": "float16", "contact.k": "1e5"}, "largest float16, 6.55e+04"),
        ("penalty", {"variants.low": "3"}, "variants.low = 3 … a table"),
        ("penalty", {"variants.x.contact.k": "0"}, "--set variants.x … variant 'x': contact.k = 0"),
        ("penalty", {"variants.x.contact.kk": "0"}, "variant 'x': unknown key 'kk' … mean k?"),
        ("penalty", {"variants.x.start.balls": "4"}, "variant 'x' … 4 balls … system has 3"),
        ("penalty", {"variants.x.integrator.steps": "4"}, "variant 'x' changes integrator.steps"),
        ("penalty", CONTROL, "2 numbers for 100 steps"),
        ("projection", {"contact.k": "4"}, "alpha k = 0.5 × 4 = 2 … 1 - alpha k = -1 … alpha below 0.5"),
        ("projection", {"stop.max_iter": "4294967296"}, "at most 2147483647"),
        ("projection", {"stop.tol": "inf"}, "finite"),
        ("projection", {"stop.enter": "1e-7"}, "stop.enter = 1e-07 is below stop.tol = 1e-06"),
        ("projection", {"stop.rule": "some"}, "rule 'some' … sum, per-instance, maximum"),
        ("projection", {"stop.rule": "fixed"}, "key 'count' missing"),
        ("projection", {"stop.rule": "relative", "stop.tol": "1"}, "relative to the first"),
        ("projection", {"contact.hysteresis": "0.1"}, "no meaning for projection … stop.enter"),
        ("projection", {"gradient.of": '["tol"]', "stop.rule": "fixed", "stop.count": "3"}, "rule is fixed"),
        ("projection", {"contact.kind": "impact", "stop.tol": "1e-3"}, "does not iterate"),
        # of all roles, so that no second message corrects the first: 2.23e-308 / (alpha k)
        ("projection", {"stop.tol": "1e-320"}, LEAST),
        ("projection", {"stop.tol": "3e-308"}, LEAST),
        ("projection", RELATIVE | {"precision.decision": "float16"}, "precision.decision"),
        ("impact", SMALL, "integrator.timestep = 1e-09 is 0 in float16 … least is 5.96e-08"),
        ("impact", {"start.height": "1e5", "precision.state": "float16"}, "start.height = 100000 is above"),
        ("impact", WAVE, "parabola … not under sine"),
    ],
)
def test_a_mistake_on_the_command_line(
    files: dict[str, Path], file: str, changes: dict[str, str], words: str
):
    said = refusal(files[file], changes)
    assert all(word in said for word in words.split(" … ")), said


@pytest.mark.parametrize(
    ("file", "changes"),
    [
        ("penalty", {"precision.arithmetic": "float16"}),
        ("penalty", {**CONTROL, "integrator.steps": "2"}),
        ("projection", RELATIVE | {"precision.state": "float16"}),
        ("impact", {"flight.control.kind": "constant", "flight.control.value": "1"}),
    ],
)
def test_next_to_a_mistake_is_none(files: dict[str, Path], file: str, changes: dict[str, str]):
    load(files[file], changes)


def test_another_kind_drops_what_it_does_not_have(files: dict[str, Path]):
    fixed = load(files["projection"], {"stop.rule": "fixed", "stop.count": "7"}).spec
    assert fixed.stop.model_dump() == {"rule": "fixed", "count": 7}
    impact = load(files["projection"], {"contact.kind": "impact", "gradient.of": '["restitution"]'})
    assert impact.spec.stop is None
    system = load(files["penalty"], {"contact.kind": "impact", "integrator.kind": "velocity-verlet"})
    assert system.spec.gradient.of == ("y0",)


@pytest.mark.parametrize("name", ["float16", "bfloat16", "float32"])
@pytest.mark.parametrize("role", ["state", "arithmetic", "decision", "accumulate"])
def test_a_tolerance_below_what_a_role_can_tell_from_zero(files: dict[str, Path], name: str, role: str):
    limits = ml_dtypes.finfo(name)
    # XLA flushes subnormals on a CPU, but computes float16 in float32
    least = float(limits.smallest_subnormal if name == "float16" else limits.smallest_normal)
    if role == "arithmetic":
        # of what is left an iteration takes alpha k = 1/4, which must not round to nothing: of two grains
        # it takes half a one, which does, of three it takes one
        least *= 3 if name == "float16" else 4
    key = f"precision.{role}"
    said = refusal(files["projection"], {key: name, "stop.tol": repr(least / 2)})
    assert f"too small for {name}" in said
    assert key in said
    assert f"{least:.3g}" in said
    load(files["projection"], {key: name, "stop.tol": repr(least)})
    if name in ("float16", "float32"):
        over = repr(float(limits.max) * 4)
        assert f"above the largest {name}" in refusal(files["projection"], {key: name, "stop.tol": over})


@pytest.mark.parametrize("name", ["float16", "bfloat16", "float32", "float64"])
def test_the_smallest_usable_numbers_are_what_the_arithmetic_keeps(name: str):
    positive = jax.jit(lambda x: x > 0)
    assert bool(positive(jnp.asarray(smallest(name), name)))
    if name != "float16" and jax.default_backend() == "cpu":
        below = np.asarray(ml_dtypes.finfo(name).smallest_subnormal, name)
        assert not bool(positive(jnp.asarray(below)))


def test_what_is_allowed_and_worth_a_word(files: dict[str, Path]):
    for changes in ({}, {"stop.tol": "1e-15"}):
        assert not list(remarks(load(files["projection"], changes).spec))
    ((code, values),) = remarks(load(files["projection"], {"contact.k": "3"}).spec)
    assert (code, values["product"]) == ("PROJECTION_OVERSHOOTS", 1.5)
    ((code, values),) = remarks(
        load(files["projection"], {"stop.tol": "1e-10", "precision.state": "float32"}).spec
    )
    # a fall of sqrt(2 g) h = 0.0443 m in a step: spacing 2^-28 in float32
    assert (code, values["unit"]) == ("TOLERANCE_BELOW_ROUNDING", 2.0**-28)
    # a bound on the whole time step of an explicit scheme in contact
    ((code, values),) = remarks(load("ball/drop", {"contact.k": "1e7"}).spec)
    assert (code, values["stiff"]) == ("STEP_BEYOND_STABILITY", pytest.approx(3.16, rel=1e-3))


# --- what comes of a file -----------------------------------------------------------------------------


def test_variants_are_the_system_with_keys_changed(files: dict[str, Path]):
    system = load(files["penalty"], {"contact.k": "2e4"})
    (low,) = system.variants.values()
    assert low.contact.k == 2e4
    assert (low.precision.state, low.precision.decision) == ("float32", "float64")
    more = system.against({"contact.kind": "impact"}).against({"contact.k": "3e4"}, "stiffer")
    assert list(more.variants) == list(more.spec.variants) == ["low", "contact.kind=impact", "stiffer"]
    assert more.variants["contact.kind=impact"].contact.kind == "impact"
    assert more.variants["stiffer"].contact.k == 3e4
    with pytest.raises(InputError, match="variant 'stiffer' is defined twice"):
        more.against({"contact.k": "5e4"}, "stiffer")
    with pytest.raises(InputError, match=r"--against contact.k=-1: variant 'contact.k=-1': contact.k = -1"):
        system.against({"contact.k": "-1"})
    with pytest.raises(InputError, match="changes no key"):
        system.against({}, "none")


@pytest.mark.parametrize("name", ["ball/drop", "ball/zeno", "ball/batch-on-the-boundary"])
def test_a_written_or_copied_system_is_the_same_system(name: str, tmp_path: Path):
    system = load(name).against({"flight.gravity": "1.0"})
    again = load(system.write(tmp_path / "run"))
    assert (again.name, again.to_toml(), again.variants) == (name, system.to_toml(), system.variants)
    assert again.spec.model_dump(exclude={"name"}) == system.spec.model_dump(exclude={"name"})
    assert load(tmp_path / "run").spec == again.spec, "a run folder is a system, too"
    copied, short = systems.copy(name, tmp_path / "mine"), f"{name.split('/')[1]}.toml"
    assert {path.name for path in copied.parent.iterdir()} == {BALL_SCHEMA, short}
    assert copied.read_text(encoding="utf-8").startswith(f"#:schema {BALL_SCHEMA}\n")
    assert load(copied).spec.model_dump(exclude={"name"}) == load(name).spec.model_dump(exclude={"name"})
    with pytest.raises(InputError, match="already exists"):
        systems.copy(name, tmp_path / "mine")


NARROW = {"start.boundary.format": "float16", "stop.tol": repr(float(np.float16(1e-3)))}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stop.tol": "1e-3"}, r"is not a bfloat16 number.*tol = 0\.00099945068359375"),
        # the nearest one would be 0 or infinite: no tolerance
        ({"stop.tol": "1e-50"}, r"tolerance is 1\.18e-38, .* 3\.39e\+38"),
        ({"stop.tol": "1e39"}, r"tolerance is 1\.18e-38, .* 3\.39e\+38"),
        (NARROW | {"start.boundary.terms": "4096"}, r"4096 parts .* smallest float16"),
        ({"stop.rule": "fixed", "stop.count": "2"}, "needs a tolerance"),
    ],
)
def test_a_batch_on_the_boundary_needs_a_tolerance_of_its_format(changes: dict[str, str], message: str):
    with pytest.raises(InputError, match=message):
        load("ball/batch-on-the-boundary", changes)


def test_methods_are_those_of_the_library():
    assert set(typing.get_args(ball.MethodName)) == set(BALL_METHODS)
