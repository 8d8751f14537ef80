"""What every choice of a ball changes, and what it must not."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from mdnum.forks.bounce import Pin, choices, fork
from mdnum.forks.bounce.choices import BY_NAME, parse, screen

from mdnum.errors import InputError
from mdnum.forks.choices.base import Choice
from mdnum.precision import neighbor
from mdnum.systems import BallSystem, load

FILES = {
    "batch": """
world = "ball"
[start]
height = [0.3, 0.41, 0.52]
velocity = [-0.1, 0.0, 0.2]
[contact]
kind = "projection"
k = 0.5
[stop]
rule = "sum"
tol = 1e-3
enter = 2e-3
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
steps = 50
""",
    "spring": """
world = "ball"
[start]
height = 0.3
[contact]
kind = "penalty"
k = 900.0
damping = 1.0
eps = 0.001
hysteresis = 0.01
[integrator]
kind = "velocity-verlet"
timestep = 0.01
steps = 50
""",
    "impact": """
world = "ball"
[start]
height = 0.3
balls = 2
spread = 0.1
[contact]
kind = "impact"
[integrator]
kind = "event-located"
timestep = 0.01
steps = 50
""",
    "alone": """
world = "ball"
[contact]
kind = "projection"
k = 0.5
[start]
height = [0.3, 0.41]
[stop]
rule = "per-instance"
tol = 1e-3
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
[precision]
arithmetic = "float32"
""",
    "narrow": """
world = "ball"
[contact]
kind = "projection"
k = 0.5
[start]
height = [0.3, 0.41]
[stop]
rule = "sum"
tol = 1e-3
[integrator]
kind = "semi-implicit-euler"
timestep = 0.01
[precision]
state = "float32"
decision = "float32"
accumulate = "float32"
reduction = "exact"
""",
}


@pytest.fixture(scope="module")
def systems(tmp_path_factory) -> dict[str, BallSystem]:
    folder = tmp_path_factory.mktemp("systems")
    found = {}
    for name, text in FILES.items():
        (folder / f"{name}.toml").write_text(text)
        found[name] = load(folder / f"{name}.toml", world="ball")
    return found


def first(systems, choice) -> BallSystem:
    """A system that a choice applies to; each has one."""
    return next(one for one in systems.values() if choice.why_not(one) is None)


def keys_of(name: str) -> set[str]:
    """Keys of the system file that a choice may change, by its name."""
    family, _, argument = name.partition("=")
    roles = ("state", "arithmetic", "decision", "accumulate")
    if family == "precision":
        return {f"precision.{role}" for role in roles}
    if family.startswith("precision."):
        return {family}
    return {
        "reduction": {"precision.reduction"}, "stop": {"stop.rule"}, "max_iter": {"stop.max_iter"},
        "ulps": {argument.partition(":")[0]},
    }.get(family, set())  # fmt: skip


PLANTED = [name for name in BY_NAME if name.startswith(("contact=", "iterations="))]


@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in PLANTED])
def test_what_a_choice_changes_and_what_it_must_not(name, systems):
    choice = BY_NAME[name]
    assert isinstance(choice, Choice) and choice.name == name and parse(name) == choice and choice.about
    system = first(systems, choice)
    twin = choice.make(system)
    changed = set(twin.changes)
    assert changed <= keys_of(name)
    assert twin.difference and twin.pins == ()
    a, b = twin.a, twin.b
    assert a.steps == b.steps == system.spec.integrator.steps
    parts = {"y0": np.array_equal(a.y0, b.y0), "v0": np.array_equal(a.v0, b.v0)}
    moved = {key for key, same in parts.items() if not same}
    if name.startswith("order"):
        assert twin.order is not None and sorted(twin.order) == list(range(system.balls))
        np.testing.assert_array_equal(np.asarray(b.y0), np.asarray(a.y0)[list(twin.order)])
        assert choice.must_hold == ("@" in name)
    else:
        assert twin.order is None and not choice.must_hold
        assert moved == {"start": {"y0"}, "start=velocity:+1": {"v0"}}.get(name, set())
        assert changed or moved
    # every number of the program but those that the keys mean
    meant = {key.rpartition(".")[2].replace("timestep", "h").replace("hysteresis", "lift") for key in changed}
    for parameter in a.world.parameters:
        own, other = (np.asarray(one.world.value(parameter), np.float64) for one in (a, b))
        assert (own == other) == (parameter not in meant) or name.startswith("precision"), parameter
    if not name.startswith("precision"):
        assert a.world.policy == b.world.policy
    else:
        roles = {role for role in ("state", "arithmetic", "decision", "accumulate")
                 if getattr(a.world.policy, role) != getattr(b.world.policy, role)}  # fmt: skip
        assert {f"precision.{role}" for role in roles} == changed


@pytest.mark.parametrize("name", ["ulps=contact.k:-3", "ulps=stop.tol:+1"])
def test_an_ulp_is_one_of_the_format_that_the_number_is_used_in(name, systems):
    choice = parse(name)
    key = keys_of(name).pop()
    for system, dtype in ((systems["batch"], np.float64), (systems["alone"], np.float32)):
        if key == "stop.tol":
            dtype = np.float64
        before, after = choice.make(system).changes[key]
        assert after == float(neighbor(before, choice.ulps, dtype))


def test_one_decision_is_planted_and_nothing_else(systems):
    system = systems["batch"]
    run = parse("start").make(system).a.run()
    begins = np.flatnonzero(run.contacts.entered)
    step, one = int(run.contacts.step[begins[0]]), int(run.contacts.subject[begins[0], 0])
    late, other = int(run.contacts.step[begins[1]]), int(run.contacts.subject[begins[1], 0])
    row = int(np.flatnonzero(run.iterations)[0])
    count = int(run.iterations[row])
    for name, pin in (
        ("contact=earlier", Pin("contact", step - 1, one, 1)),
        ("contact=later", Pin("contact", step, one, 0)),
        ("contact=later:2", Pin("contact", late, other, 0)),
        (f"contact={step}:{one}", Pin("contact", step, one, 0)),
        ("contact=1", Pin("contact", 1, 0, 1)),
        ("iterations=+1", Pin("stop", row + 1, -1, count + 1)),
        ("iterations=-1", Pin("stop", row + 1, -1, count - 1)),
        (f"iterations=+2:{row + 1}", Pin("stop", row + 1, -1, count + 2)),
    ):
        choice = parse(name)
        assert choice.name == (name if name != "contact=1" else "contact=1:0")
        assert choice.why_not(system) is None and not choice.must_hold and choice.about
        twin = choice.make(system)
        assert twin.pins == (pin,), name
        assert twin.a is twin.b and twin.order is None and not twin.changes


@pytest.mark.slow
def test_the_order_of_a_batch_is_heard_by_its_sum_alone():
    """Nine penetrations that sum to the tolerance: whichever is summed last is heard."""
    low = {f"precision.{role}": "bfloat16" for role in ("state", "arithmetic", "decision", "accumulate")}
    system = load("ball/batch-on-the-boundary", low, world="ball")
    seed = next(seed for seed in range(200) if np.random.default_rng(seed).permutation(9)[-1] == 0)
    found = {
        name: fork(parse(name).make(system), counterfactual=False, repeats=0)
        for name in (f"order={seed}", f"order={seed}@exact", f"order={seed}@alone")
    }
    heard = found[f"order={seed}"]
    assert heard.decision is not None and (heard.dates.fork, heard.decision.channel) == (1, "stop")
    assert heard.decision.ambiguous_in
    for name in (f"order={seed}@exact", f"order={seed}@alone"):
        assert found[name].dates.seed is None and found[name].dates.fork is None


def test_a_word_that_is_no_choice_is_refused_with_those_that_are():
    with pytest.raises(InputError, match="no choice 'skin' of a ball") as refused:
        parse("skin")
    assert "stop, order, ulps" in str(refused.value) and "lists all" in str(refused.value)
    with pytest.raises(InputError, match="Did you mean precision"):
        parse("precison")
    for text, words in (
        ("precision=float8", "unknown dtype"), ("precision.force", "no role 'force'"),
        ("ulps=contact.k:0", "0 ulps"), ("ulps=contact.k:x", "not a whole number"), ("stop=never", "no rule"),
        ("order@kahan", "says nothing"), ("reduction=up", "no reduction"), ("start=0:mass", "neither height"),
        ("max_iter=0", "change nothing"), ("iterations=1:2:3:4", "more:step:ball"), ("contact=x", "whole"),
        ("contact=earlier:0", "count from 1"), ("order=", "no choice"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            parse(text)


@pytest.mark.parametrize(
    ("name", "system", "words"),
    [
        ("precision=float64", "batch", "are float64 already"),
        ("precision.accumulate", "alone", "sums nothing"),
        ("reduction=kahan", "spring", "nothing, so there is no residual"),
        ("reduction=sequential", "batch", "sequential already"),
        ("stop=sum", "batch", "sum already"),
        ("stop=maximum", "spring", "solve nothing"),
        ("order", "spring", "one ball"),
        ("order", "impact", "order@alone must hold"),
        ("order@exact", "alone", "sums nothing"),
        ("order", "narrow", "order@exact must hold"),
        ("ulps=contact.mass", "batch", "no number contact.mass; there are .*contact.k"),
        ("ulps=start.velocity", "spring", "start.velocity is 0"),
        ("ulps=contact.eps", "batch", "no number contact.eps. Choose"),
        ("start=7", "batch", "no ball 7 among 3"),
        ("max_iter=+1", "spring", "no iteration to add"),
        ("max_iter=-100", "batch", "max_iter"),
        ("iterations=+1", "impact", "solve nothing"),
        ("iterations=+1:51", "batch", "no step 51 from 1 to 50"),
        ("iterations=+1:1:0", "batch", "for all balls"),
        ("contact=51", "batch", "no step 51"),
        ("contact=earlier:99", "batch", "contacts begin in 50 steps"),
    ],
)
def test_a_choice_that_does_not_apply_says_why(name, system, words, systems):
    choice = parse(name)
    reason = choice.why_not(systems[system])
    assert reason is not None
    with pytest.raises(InputError, match=words) as refused:
        choice.make(systems[system])
    assert name.partition("=")[0].partition("@")[0] in str(refused.value) and reason in str(refused.value)


def test_a_narrow_format_that_cannot_hold_a_number_is_refused(systems):
    stiff = load("ball/stiff", world="ball")
    reason = parse("precision=float16").why_not(stiff)
    assert reason is not None and "above the largest float16" in reason and "variant" not in reason


def test_choices_are_ranked_by_their_forks(systems):
    seen: list[Any] = []
    asked = [parse(name) for name in ("order@alone", "contact=later", "contact=earlier", "stop=sum")]
    rows = screen(systems["batch"], choices=asked, progress=lambda *now: seen.append(now))
    assert [row.choice for row in rows] == ["contact=earlier", "contact=later", "order@alone", "stop=sum"]
    assert rows[0].fork is not None and rows[1].fork == rows[0].fork + 1
    assert rows[2].held and not rows[2].finding and rows[3].why_not == "the rule is sum already"
    assert seen[0] == (0, 4, "order@alone")
    with pytest.raises(InputError, match="no choice to screen"):
        screen(systems["batch"], choices=[])


def test_other_steps_are_those_of_the_program(systems):
    longer = systems["batch"].for_steps(80)
    assert parse("start").make(longer).a.steps == 80
    control = {"flight.control": {"kind": "values", "values": [0.5, 0.25]}, "integrator.steps": 2}
    told = load("ball/drop", control, world="ball")
    assert told.for_steps(4).spec.flight.control.values == (0.5, 0.25, 0.25, 0.25)  # type: ignore[union-attr]
    assert told.for_steps(1).spec.flight.control.values == (0.5,)  # type: ignore[union-attr]
    assert dataclasses.replace(told.for_steps(2), spec=told.spec) == told


def test_every_choice_of_a_ball_is_listed():
    assert choices.names() == list(BY_NAME) and len(BY_NAME) == len({one.name for one in BY_NAME.values()})
