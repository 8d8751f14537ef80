"""System files of the ball: what they say, what is refused in one line, and that they are written as read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
import pytest

from mdnum import systems
from mdnum.ball.limits import smallest
from mdnum.errors import InputError
from mdnum.systems import BallSystem, System, ball, load
from mdnum.systems.ball import remarks
from mdnum.systems.load import BALL_SCHEMA

PENALTY = """\
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
"""

PROJECTION = """\
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
"""

IMPACT = """\
world = "ball"
[contact]
kind = "impact"
[integrator]
kind = "event-located"
timestep = 0.01
"""


def _written(name: str, text: str) -> Any:
    @pytest.fixture(name=name)
    def fixture(tmp_path: Path) -> Path:
        path = tmp_path / f"{name}.toml"
        path.write_text(text)
        return path

    return fixture


penalty = _written("penalty", PENALTY)
projection = _written("projection", PROJECTION)
impact = _written("impact", IMPACT)


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


# --- worlds -------------------------------------------------------------------------------------------


def test_the_world_decides_what_is_loaded(penalty: Path):
    assert isinstance(load(penalty), BallSystem)
    assert isinstance(load(penalty, world="ball"), BallSystem)
    assert isinstance(load("argon/crystal-108"), System)
    with pytest.raises(InputError, match=r"this system is a ball\. Use `mdnum ball "):
        load(penalty, world="md")
    with pytest.raises(InputError, match=r"molecular dynamics\. Use `mdnum run argon/crystal-108`"):
        load("argon/crystal-108", world="ball")


def test_a_world_that_is_none(penalty: Path):
    edit(penalty, 'world = "ball"', 'world = "bal"')
    assert "world = 'bal'; expected \"ball\"" in refusal(penalty)
    edit(penalty, 'world = "bal"\n', "")
    assert "key 'world' missing" in refusal(penalty)
    assert 'Add `world = "ball"`' in refusal(penalty)


# --- mistakes -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("k = 1e4", "k = -1e4", 19, ["contact.k = -10000.0", "above 0", "1/s²"]),
        ("k = 1e4", "kk = 1e4", 19, ["unknown key 'kk' in [contact]", "Did you mean k?"]),
        ("k = 1e4", "", 17, ["key 'k' missing in [contact]", "stiffness"]),
        ("k = 1e4", 'k = "1e4"', 19, ['contact.k = "1e4"', "a number", "quotes"]),
        ("k = 1e4", "k = 1e4\neps = -1.0", 20, ["contact.eps = -1.0", "at least 0", "softplus"]),
        ("k = 1e4", "k = 1e4\nrestitution = 0.8", 20, ["unknown key 'restitution'", "Known keys are kind"]),
        ('kind = "penalty"', 'kind = "penality"', 18, ["unknown contact kind", "Did you mean penalty?"]),
        ('kind = "sine"', 'kind = "cosine"', 13, ["unknown flight.control kind 'cosine'", "constant, sine"]),
        ("period = 2.0", "perod = 2.0", 15, ["unknown key 'perod' in [flight.control]", "period?"]),
        ("period = 2.0", "period = 0.0", 15, ["flight.control.period = 0.0", "above 0", "(s)"]),
        ("timestep = 0.001", "timestep = 0.0", 23, ["integrator.timestep = 0.0", "above 0"]),
        ("timestep = 0.001", "timestep = nan", 23, ["integrator.timestep = nan", "finite"]),
        ("steps = 100", "steps = 0", 24, ["integrator.steps = 0", "at least 1"]),
        ("steps = 100", "steps = 1.5", 24, ["integrator.steps = 1.5", "a whole number"]),
        ('"semi-implicit-euler"', '"euler"', 22, ['integrator.kind = "euler"', '"velocity-verlet"']),
        ("gravity = 9.81", "gravity = -9.81", 10, ["flight.gravity = -9.81", "at least 0", "downward"]),
        ("height = 1.0", 'height = "high"', 5, ['start.height = "high"', "a number"]),
        ("height = 1.0", "height = [1.0, true]", 5, ["start.height = [1.0, True]", "a number"]),
        ("height = 1.0", "height = []", 5, ["start.height is an empty array"]),
        ("height = 1.0", "height = [1.0, 2.0, 3.0]", 7, ["start.spread has no meaning"]),
        ("spread = 0.1", "spread = 0.1\nspread_ulps = 1", 8, ["both given"]),
        ("balls = 3", "balls = 1", 7, ["start.spread of a single ball"]),
        ("balls = 3", "balls = 0", 6, ["start.balls = 0", "at least 1"]),
        ("[start]", "[begin]", 4, ["unknown key 'begin'"]),
        ('of = ["k", "y0"]', 'of = ["k", "stiffness"]', 27, ['gradient.of = "stiffness"', '"k"']),
        ('of = ["k", "y0"]', 'of = ["alpha"]', 27, ["names alpha, which penalty does not have", "damping"]),
        ('of = ["k", "y0"]', 'of = ["eps"]', 27, ["contact.eps = 0 is the sharp contact"]),
        ('of = ["k", "y0"]', 'methods = ["backprop"]', 27, ['gradient.methods = "backprop"', "event-aware"]),
        ('of = ["k", "y0"]', 'of = "k"', 27, ['gradient.of = "k"', "an array"]),
        ("[variants.low]", "[loss]\ntarget = 1.0\nkind = 'mean-height'\n[variants.low]", 30, ["loss.target"]),
        ("[variants.low]", "[stop]\nrule = 'sum'\ntol = 1e-6\n[variants.low]", 29, ["iterates nothing"]),
    ],
)
def test_a_mistake_in_the_file(penalty: Path, old: str, new: str, line: int, words: list[str]):
    edit(penalty, old, new)
    said = refusal(penalty)
    for word in words:
        assert word in said
    assert f"penalty.toml:{line}: " in said


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("contact.kk", "1", ["--set contact.kk: ", "Did you mean k?"]),
        ("contct.k", "1", ["--set contct.k: ", "Did you mean contact?"]),
        ("integrator.kind", "event-located", ["--set integrator.kind: ", "the contact is a penalty"]),
        ("integrator.kind", "implicit-midpoint", ["[stop] missing", "implicit-midpoint iterates"]),
        ("contact.kind", "projection", ["[stop] missing", "a projection iterates"]),
        ("loss.kind", "residual-penetration", ["--set loss.kind: ", "the contact is a penalty"]),
        ("contact.hysteresis", "0", ["contact.hysteresis = 0", "above 0"]),
        ("precision.state", "float8", ["--set precision.state: ", '"bfloat16"']),
        ("precision.reduction", "backwards", ["--set precision.reduction: ", "neumaier"]),
        ("precision.reduction", "sequential:3", ["--set precision.reduction: "]),
        ("precision.rounding", "up", ['"nearest" or "stochastic"']),
        ("precision.arithmetic", "float16", ["contact.k = 10000", ""]),
        ("start.boundary.terms", "4", ["[start] has boundary and balls, spread"]),
        ("variants.low", "3", ["variants.low = 3", "a table"]),
        ("variants.other.contact.k", "0", ["--set variants.other", "variant 'other': contact.k = 0"]),
        ("variants.other.contact.kk", "0", ["variant 'other': unknown key 'kk'", "Did you mean k?"]),
        ("variants.other.start.balls", "4", ["variant 'other' has 4 balls and the system 3"]),
        ("variants.other.integrator.steps", "4", ["variant 'other' changes integrator.steps"]),
        ("flight.control.values", "[1.0]", ["unknown key 'values' in [flight.control]"]),
    ],
)
def test_a_mistake_on_the_command_line(penalty: Path, key: str, value: str, words: list[str]):
    if key == "precision.arithmetic":
        # 1e4 is a float16, 1e5 is none
        load(penalty, {key: value})
        assert "above the largest float16, 6.55e+04" in refusal(penalty, {key: value, "contact.k": "1e5"})
        return
    said = refusal(penalty, {key: value})
    for word in words:
        assert word in said


def test_as_many_controls_as_steps(penalty: Path):
    changes = {"flight.control.kind": "values", "flight.control.values": "[1.0, 2.0]"}
    assert "2 numbers for 100 steps" in refusal(penalty, changes)
    assert load(penalty, {**changes, "integrator.steps": "2"}).spec.flight.control.values == (1.0, 2.0)


# --- solvers and tolerances ---------------------------------------------------------------------------


def test_a_projection_that_cannot_converge_is_told_its_product(projection: Path):
    said = refusal(projection, {"contact.k": "4"})
    assert "alpha k = 0.5 × 4 = 2" in said
    assert "1 - alpha k = -1" in said
    assert "cannot converge" in said
    assert "alpha below 0.5" in said
    # overshooting is allowed, and said
    ((code, values),) = remarks(load(projection, {"contact.k": "3"}).spec)
    assert (code, values["product"]) == ("PROJECTION_OVERSHOOTS", 1.5)
    assert not list(remarks(load(projection).spec))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"stop.tol": "0"}, ["stop.tol = 0", "above 0"]),
        ({"stop.tol": "-1e-6"}, ["above 0"]),
        ({"stop.tol": "inf"}, ["finite"]),
        ({"stop.max_iter": "4294967296"}, ["at most 2147483647"]),
        ({"stop.max_iter": "0"}, ["stop.max_iter = 0", "at least 1"]),
        ({"stop.max_iter": "2.5"}, ["a whole number"]),
        ({"stop.enter": "1e-7"}, ["stop.enter = 1e-07 is below stop.tol = 1e-06"]),
        ({"stop.rule": "some"}, ["unknown stop rule 'some'", "sum, per-instance, maximum, relative, fixed"]),
        ({"stop.rule": "fixed"}, ["key 'count' missing"]),
        ({"stop.rule": "relative", "stop.tol": "1"}, ["above that residual"]),
        ({"contact.restitution": "1.5"}, ["contact.restitution = 1.5", "at most 1"]),
        ({"contact.alpha": "0"}, ["contact.alpha = 0", "above 0"]),
        ({"contact.hysteresis": "0.1"}, ["has no meaning for projection", "stop.enter"]),
        ({"gradient.of": '["tol"]', "stop.rule": "fixed", "stop.count": "3"}, ["the rule is fixed"]),
    ],
)
def test_solvers_out_of_range(projection: Path, changes: dict[str, str], words: list[str]):
    said = refusal(projection, changes)
    for word in words:
        assert word in said


def test_another_rule_drops_what_it_does_not_have(projection: Path):
    fixed = load(projection, {"stop.rule": "fixed", "stop.count": "7"}).spec
    assert fixed.stop.model_dump() == {"rule": "fixed", "count": 7}
    impact = load(projection, {"contact.kind": "impact", "gradient.of": '["restitution"]'})
    assert impact.spec.stop is None
    assert "iterates nothing" in refusal(projection, {"contact.kind": "impact", "stop.tol": "1e-3"})


def test_another_contact_drops_the_parameters_it_does_not_have(penalty: Path):
    system = load(penalty, {"contact.kind": "impact", "integrator.kind": "velocity-verlet"})
    assert system.spec.gradient.of == ("y0",)
    assert "names k" in refusal(penalty, {"contact.kind": "impact", "gradient.of": '["k"]'})


@pytest.mark.parametrize("name", ["float16", "bfloat16", "float32"])
@pytest.mark.parametrize("role", ["state", "arithmetic", "decision", "accumulate"])
def test_a_tolerance_below_what_a_role_can_tell_from_zero(projection: Path, name: str, role: str):
    limits = ml_dtypes.finfo(name)
    # XLA flushes subnormals on a CPU, but computes float16 in float32
    least = float(limits.smallest_subnormal if name == "float16" else limits.smallest_normal)
    if role == "arithmetic":
        # of what is left an iteration takes alpha k = 1/4, which must not round to nothing: of two grains
        # it takes half a one, which does, of three it takes one
        least *= 3 if name == "float16" else 4
    key = f"precision.{role}"
    said = refusal(projection, {key: name, "stop.tol": repr(least / 2)})
    assert f"too small for {name}" in said
    assert key in said
    assert f"smallest usable tolerance is {least:.3g}" in said
    load(projection, {key: name, "stop.tol": repr(least)})
    if name in ("float16", "float32"):
        over = repr(float(limits.max) * 4)
        assert f"above the largest {name}" in refusal(projection, {key: name, "stop.tol": over})


def test_a_tolerance_below_the_smallest_float64(projection: Path):
    said = refusal(projection, {"stop.tol": "1e-320"})
    # of all roles, so that no second message corrects the first: 2.23e-308 / (alpha k)
    assert "The smallest usable tolerance is 8.9e-308" in said
    assert "smallest usable tolerance is 8.9e-308" in refusal(projection, {"stop.tol": "3e-308"})


def test_the_smallest_usable_numbers_are_what_the_arithmetic_keeps():
    import jax
    import jax.numpy as jnp

    for name in ("float16", "bfloat16", "float32", "float64"):
        least = jnp.asarray(smallest(name), name)
        assert bool(jax.jit(lambda x: x > 0)(least)), name
        limits = ml_dtypes.finfo(name)
        if name != "float16" and jax.default_backend() == "cpu":
            below = jnp.asarray(np.asarray(limits.smallest_subnormal, name))
            assert not bool(jax.jit(lambda x: x > 0)(below)), name


def test_a_relative_tolerance_is_compared_where_decisions_are_made(projection: Path):
    low = {"stop.rule": "relative", "stop.tol": "1e-9", "precision.state": "float16"}
    load(projection, low)
    assert "precision.decision" in refusal(projection, {**low, "precision.decision": "float16"})


def test_a_tolerance_below_the_rounding_of_the_heights_is_worth_a_word(projection: Path):
    assert not list(remarks(load(projection, {"stop.tol": "1e-15"}).spec))
    ((code, values),) = remarks(load(projection, {"stop.tol": "1e-10", "precision.state": "float32"}).spec)
    # a fall of sqrt(2 g) h = 0.0443 m in a step: spacing 2^-28 in float32
    assert (code, values["unit"]) == ("TOLERANCE_BELOW_ROUNDING", 2.0**-28)
    # a bound on the whole time step of an explicit scheme in contact
    ((code, values),) = remarks(load("ball/drop", {"contact.k": "1e7"}).spec)
    assert (code, values["stiff"]) == ("STEP_BEYOND_STABILITY", pytest.approx(3.16, rel=1e-3))


def test_numbers_that_vanish_in_a_role(impact: Path):
    said = refusal(impact, {"integrator.timestep": "1e-9", "precision.arithmetic": "float16"})
    assert "integrator.timestep = 1e-09 is 0 in float16" in said
    assert "the least is 5.96e-08" in said
    assert "start.height = 100000 is above" in refusal(
        impact, {"start.height": "1e5", "precision.state": "float16"}
    )


def test_an_event_located_step_needs_a_parabola(impact: Path):
    load(impact, {"flight.control.kind": "constant", "flight.control.value": "1"})
    said = refusal(
        impact,
        {"flight.control.kind": "sine", "flight.control.amplitude": "1", "flight.control.period": "1"},
    )
    assert "a parabola under constant acceleration, not under sine" in said


# --- what comes of a file -----------------------------------------------------------------------------


def test_variants_are_the_system_with_keys_changed(penalty: Path):
    system = load(penalty, {"contact.k": "2e4"})
    (low,) = system.variants.values()
    assert low.contact.k == 2e4
    assert (low.precision.state, low.precision.decision) == ("float32", "float64")
    more = system.against({"contact.kind": "impact"}).against({"contact.k": "3e4"}, "stiffer")
    assert list(more.variants) == list(more.spec.variants) == ["low", "contact.kind=impact", "stiffer"]
    assert more.variants["contact.kind=impact"].contact.kind == "impact"
    assert more.variants["stiffer"].contact.k == 3e4
    with pytest.raises(InputError, match="a variant 'stiffer' already"):
        more.against({"contact.k": "5e4"}, "stiffer")
    with pytest.raises(InputError, match=r"--against contact.k=-1: variant 'contact.k=-1': contact.k = -1"):
        system.against({"contact.k": "-1"})
    with pytest.raises(InputError, match="changes nothing"):
        system.against({}, "none")


@pytest.mark.parametrize("name", ["ball/drop", "ball/zeno", "ball/batch-on-the-boundary"])
def test_a_written_system_is_the_same_system(name: str, tmp_path: Path):
    system = load(name).against({"flight.gravity": "1.0"})
    again = load(system.write(tmp_path / "run"))
    assert again.name == name
    assert again.to_toml() == system.to_toml()
    assert again.spec.model_dump(exclude={"name"}) == system.spec.model_dump(exclude={"name"})
    assert again.variants == system.variants
    assert load(tmp_path / "run").spec == again.spec, "a run folder is a system, too"


def test_copy_gives_a_ball_to_change(tmp_path: Path):
    copied = systems.copy("ball/drop", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [BALL_SCHEMA, "drop.toml"]
    assert copied.read_text(encoding="utf-8").startswith(f"#:schema {BALL_SCHEMA}\n")
    assert load(copied).spec.model_dump(exclude={"name"}) == load("ball/drop").spec.model_dump(
        exclude={"name"}
    )
    systems.copy("ball/zeno", tmp_path)
    with pytest.raises(InputError, match="is there already"):
        systems.copy("ball/drop", tmp_path)


def test_a_batch_on_the_boundary_needs_a_tolerance_of_its_format():
    name = "ball/batch-on-the-boundary"
    with pytest.raises(InputError, match=r"is no bfloat16.*tol = 0\.00099945068359375"):
        load(name, {"stop.tol": "1e-3"})
    # the nearest one would be 0 or infinite: no tolerance
    for beyond in ("1e-50", "1e39"):
        with pytest.raises(
            InputError, match=r"smallest usable tolerance is 1\.18e-38, the largest 3\.39e\+38"
        ):
            load(name, {"stop.tol": beyond})
    with pytest.raises(InputError, match=r"in 4096 parts gives .* below the smallest float16"):
        load(
            name,
            {"start.boundary.format": "float16", "stop.tol": repr(float(np.float16(1e-3))),
             "start.boundary.terms": "4096"},
        )  # fmt: skip
    with pytest.raises(InputError, match="needs a tolerance to be on the boundary of"):
        load(name, {"stop.rule": "fixed", "stop.count": "2"})


def test_methods_are_those_of_the_library():
    import typing

    from mdnum.gradients.ball import BALL_METHODS as BY_NAME

    assert set(typing.get_args(ball.MethodName)) == set(BY_NAME)
