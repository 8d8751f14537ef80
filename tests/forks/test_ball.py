"""On the ball the cause of a split is known: the one decision that was made to differ. And its choices."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pytest
from forks.harness import balls, made

from mdnum import ball
from mdnum.ball.program import BallProgram, ImposedDecision, cross_decisions, overridden
from mdnum.errors import InputError
from mdnum.forks import Twin, fork
from mdnum.forks.boundaries import boundaries
from mdnum.forks.choices import parse, shipped, unavailable
from mdnum.forks.worlds import program_of
from mdnum.numerics import RolePrecision, neighbor
from mdnum.systems import BallSystem, load

# --- verdicts -----------------------------------------------------------------------------------------


def fingerprint(run: ball.BallRun) -> tuple[bytes, ...]:
    """Every state and decision of a run, bit for bit."""
    return tuple(getattr(run, name).tobytes() for name in ("y", "v", "contact", "iterations", "reason"))


def adjacent(differs, low: float, high: float) -> tuple[float, float]:
    """Adjacent doubles between which an answer changes."""
    first = differs(low)
    assert differs(high) != first
    while True:
        middle = low + (high - low) / 2
        if middle in (low, high):
            return low, high
        low, high = (middle, high) if differs(middle) == first else (low, middle)


def test_a_contact_one_step_earlier_is_the_cause():
    world = ball.World.create(ball.Impact(0.8), ball.SemiImplicitEuler(0.01))

    def first_contact(y0):
        return int(ball.simulate(world, world.start(y0), 400).first_contact[0])

    low, high = adjacent(first_contact, 1.0, 1.05)
    found = fork(balls(world, world, low, high, 400))
    assert found.dates.fork == first_contact(low) == first_contact(high) - 1
    decision = found.decision
    assert decision is not None and decision.run == "A"
    assert (decision.channel, decision.subject, decision.a, decision.b) == ("contact", (0,), 1, 0)
    # heights on both sides of the floor, no further from it than the runs were from each other
    assert decision.margins["A"] > 0 >= decision.margins["B"]
    assert decision.margins["A"] - decision.margins["B"] <= 1.5 * decision.separation
    assert decision.separation == found.series["B"][decision.step - 1]
    # under the other's decisions the two never diverge by more than the ulp grows to
    assert found.series["B|A"].max() < 1e-14 and found.series["A|B"].max() < 1e-14
    assert found.verdict.word == "cause" and found.series["B"].max() > 0.05
    assert found.splits["B"] is not None and found.splits["B|A"] is None and found.splits["A|B"] is None
    assert len({(cell.arithmetic, cell.decisions, cell.reference) for cell in found.table}) == 8


def test_one_more_solver_iteration_is_the_cause():
    rules = ball.GlobalSum(1e-3), ball.PerInstance(1e-3)
    world, each = (
        ball.World.create(ball.Projection(1.5, 1.0, rule), ball.SemiImplicitEuler(0.01)) for rule in rules
    )

    def iterations(y0):
        return int(ball.simulate(world, world.start(y0), 400).iterations[:60].sum())

    # a ball that passes the floor by the tolerance or a little less: iterated past the floor, or put on it
    heights = np.linspace(1.0, 1.05, 400)
    counts = ball.simulate(each, world.start(heights), 60).iterations.sum(axis=0)
    place = int(np.flatnonzero(counts[1:] != counts[:-1])[0])
    low, high = adjacent(iterations, float(heights[place]), float(heights[place + 1]))
    found = fork(balls(world, world, low, high, 400), split=1e-4)
    assert found.decision is not None and found.decision.channel == "stop"
    assert abs(found.decision.a - found.decision.b) == 1
    assert found.dates.split is not None and found.series["B|A"].max() < 1e-13
    assert found.verdict.word == "cause"


SPRING = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3))


def test_a_ball_and_itself_and_bits_that_differ_without_a_decision_that_does():
    found = fork(balls(SPRING, SPRING, 1.0, steps=2000))
    assert found.verdict.word == "same" and found.decision is None and not found.flips
    # a run under its own decisions has its own bits
    assert fingerprint(found.runs["B|A"]) == fingerprint(found.runs["A"])
    assert not found.series["overridden"].any()
    bits = fork(balls(SPRING, SPRING, 1.0, 1.0 + 1e-12, steps=2000))
    assert bits.verdict.word == "no fork" and bits.splits["B"] is None and bits.repeats == ((), ())
    np.testing.assert_array_equal(bits.series["B"], bits.series["B|A"])


def test_another_gravity_needs_no_decision_to_split():
    """What parts the runs is their flight: the contacts that differ only come along."""
    heavy = ball.World.create(ball.Penalty(1e4), ball.SemiImplicitEuler(1e-3), 9.75)
    found = fork(balls(SPRING, heavy, 1.0, steps=2000))
    assert found.dates.fork is not None and found.dates.split is not None
    assert found.verdict.word == "bystander", found.verdict
    # six of six are not later without them, at either displacement
    assert [len(delays) for delays in found.repeats] == [5, 4]
    assert (found.verdict.count.not_later, found.verdict.other.not_later) == (6, 4)


def test_programs_that_decide_different_things_are_refused():
    impact = ball.World.create(ball.Impact(), ball.SemiImplicitEuler(1e-3))
    with pytest.raises(InputError, match="Penalty and Impact"):
        fork(balls(SPRING, impact, 1.0))
    with pytest.raises(InputError, match="split = 0"):
        fork(balls(SPRING, SPRING, 1.0, steps=10), split=0.0)
    with pytest.raises(InputError, match="1 and 2 balls"):
        fork(balls(SPRING, SPRING, 1.0, [1.0, 1.0]))


def test_a_run_that_blows_up_ends_the_comparison():
    policy = RolePrecision.all("float16")
    tame, wild = (
        ball.World.create(ball.Penalty(k), ball.ExplicitEuler(0.1), policy=policy) for k in (10.0, 6e4)
    )
    found = fork(balls(tame, wild, 0.5, steps=400), repeats=0)
    assert found.failed == {"B": "blow-up"}
    assert 0 < found.steps < 400 and found.asked == 400
    # whether or not a decision differs before
    assert found.dates.fork is not None and found.dates.fork <= found.steps
    assert all(len(values) == found.steps + 1 for values in found.series.values())
    assert np.isfinite(found.series["B"]).all()


# --- planted faults -----------------------------------------------------------------------------------


def projection(rule) -> ball.World:
    return ball.World.create(ball.Projection(0.5, 0.5, rule), ball.SemiImplicitEuler(0.01))


WORLDS = {
    "global": projection(ball.GlobalSum(1e-4)),
    "per-instance": projection(ball.PerInstance(1e-4)),
    "located": ball.World.create(ball.Impact(0.8), ball.EventLocated(0.01)),
    "newton": ball.World.create(ball.Penalty(900.0), ball.ImplicitMidpoint(0.01)),
}
STARTS = np.array([0.3, 0.41, 0.52])


@pytest.fixture(scope="module")
def runs() -> dict[str, ball.BallRun]:
    return {name: ball.simulate(world, world.start(STARTS), 60) for name, world in WORLDS.items()}


def planted(name: str, pin: ImposedDecision) -> Twin:
    return balls(WORLDS[name], WORLDS[name], STARTS, steps=60, pins=(pin,))


@eqx.filter_jit
def advanced(world: ball.World, start: ball.BallState) -> Any:
    """Sixty steps on which nothing is imposed, not even what leaves each decision to the step."""

    def step(state, _):
        after, record = world.advance(state)
        return after, (after.y, after.v, record.contact, record.solve.iterations, record.solve.reason)

    return jax.lax.scan(step, start, length=60)[1]


@pytest.mark.parametrize(
    "name",
    ["per-instance", "located", *(pytest.param(x, marks=pytest.mark.nightly) for x in ("global", "newton"))],
)
def test_a_run_on_which_nothing_in_particular_is_imposed_has_its_own_bits(name, runs):
    world, run = WORLDS[name], runs[name]
    y, v, *decided = (np.asarray(values) for values in advanced(world, world.start(STARTS)))
    assert (y.tobytes(), v.tobytes()) == (run.y[1:].tobytes(), run.v[1:].tobytes())
    assert tuple(values.tobytes() for values in decided) == fingerprint(run)[2:]


def early_contact(run: ball.BallRun, number: int) -> ImposedDecision:
    """A contact that begins a step early."""
    rows = np.flatnonzero(run.contacts.entered)
    step, one = int(run.contacts.step[rows[number]]), int(run.contacts.subject[rows[number], 0])
    return ImposedDecision("contact", step - 1, one, 1)


@pytest.mark.parametrize("name", ["global", "per-instance"])
def test_one_inverted_contact_is_found_exactly(name, runs):
    pin = early_contact(runs[name], 1)
    found = fork(planted(name, pin), repeats=0)
    decision = found.decision
    assert decision is not None and (decision.step, decision.channel) == (pin.step, "contact")
    assert (decision.subject, decision.a, decision.b) == ((pin.ball,), 0, 1)
    # nothing before, and at the fork the bits of that ball alone
    assert found.dates.first_bit == pin.step
    other = np.delete(np.arange(3), pin.ball)
    a, b = (found.runs[run].y[: pin.step + 1, other] for run in "AB")
    np.testing.assert_array_equal(a, b)
    # under A's decisions, the planted one among them, B is A
    assert fingerprint(found.runs["B|A"]) == fingerprint(found.runs["A"])


@pytest.mark.parametrize("name", ["global", "per-instance", "newton"])
def test_one_more_iteration_is_found_exactly(name, runs):
    run = runs[name]
    busy = run.iterations.reshape(60, -1)
    row = int(np.flatnonzero(busy.any(axis=1))[-1])
    one = int(busy[row].argmax()) if run.iterations.ndim == 2 else -1
    count = int(busy[row].max())
    twin = planted(name, ImposedDecision("stop", row + 1, one, count + 1))
    decision = fork(twin, repeats=0, counterfactual=False).decision
    assert decision is not None and (decision.step, decision.channel) == (row + 1, "stop")
    assert decision.subject == (() if one < 0 else (one,)) and (decision.a, decision.b) == (count, count + 1)
    # A stopped there, B went on at the same residual
    assert decision.run == "A" and decision.margins["A"] == decision.margins["B"] > 0


def test_what_a_run_under_imposed_decisions_would_have_decided(runs):
    count, far = overridden(runs["global"])
    assert not count.any() and not far.any()
    pin = early_contact(runs["global"], 0)
    other = planted("global", pin).b.run(60)
    count, far = overridden(other)
    assert count[pin.step] == 1 and count[: pin.step].sum() == 0
    assert far[pin.step] == other.height[pin.step - 1, pin.ball] > 0


def test_balls_in_another_order_are_compared_ball_by_ball(runs):
    order = (2, 0, 1)
    problem = ball.BallProblem(WORLDS["per-instance"], STARTS[list(order)], 0.0, 60)
    run, back = runs["per-instance"], BallProgram(problem, order=order).run(60)
    assert fingerprint(back) == fingerprint(run)
    for name in ("step", "subject", "entered", "margin"):
        np.testing.assert_array_equal(getattr(back.contacts, name), getattr(run.contacts, name))


def test_rules_for_all_and_for_each_are_compared_where_iterations_do_something(runs):
    """A ball that does not touch is none the wiser for the iterations of the others."""
    assert not cross_decisions(runs["global"], runs["per-instance"])
    # the first two touch in one step, one of them deeper
    found = fork(balls(WORLDS["global"], WORLDS["per-instance"], [0.3, 0.301, 0.52], steps=60), repeats=0)
    flips = found.flips
    assert flips and {flip.channel for flip in flips} == {"stop"} and {flip.ball for flip in flips} <= {0, 1}
    touches = found.runs["A"].contact | found.runs["B"].contact
    assert all(touches[flip.step - 1, flip.ball] for flip in flips)


# --- choices ------------------------------------------------------------------------------------------


def file(contact: str, start: str, integrator: str, more: str = "") -> str:
    """A system file of four lines of tables."""
    return (
        f'world = "ball"\nstart = {{ {start} }}\ncontact = {{ {contact} }}\n'
        f"integrator = {{ {integrator}, timestep = 0.01, steps = 50 }}\n{more}\n"
    )


EULER = 'kind = "semi-implicit-euler"'
FILES = {
    "batch": file(
        'kind = "projection", k = 0.5', "height = [0.3, 0.41, 0.52], velocity = [-0.1, 0.0, 0.2]", EULER,
        'stop = { rule = "sum", tol = 1e-3, enter = 2e-3 }',
    ),
    "spring": file(
        'kind = "penalty", k = 900.0, damping = 1.0, eps = 0.001, hysteresis = 0.01', "height = 0.3",
        'kind = "velocity-verlet"',
    ),
    "impact": file('kind = "impact"', "height = 0.3, balls = 2, spread = 0.1", 'kind = "event-located"'),
    "alone": file(
        'kind = "projection", k = 0.5', "height = [0.3, 0.41]", EULER,
        'stop = { rule = "per-instance", tol = 1e-3 }\nprecision = { arithmetic = "float32" }',
    ),
    "narrow": file(
        'kind = "projection", k = 0.5', "height = [0.3, 0.41]", EULER,
        'stop = { rule = "sum", tol = 1e-3 }\nprecision = { state = "float32", decision = "float32", '
        'accumulate = "float32", reduction = "exact" }',
    ),
}  # fmt: skip


@pytest.fixture(scope="module")
def systems(tmp_path_factory) -> dict[str, BallSystem]:
    folder = tmp_path_factory.mktemp("systems")
    for name, text in FILES.items():
        (folder / f"{name}.toml").write_text(text)
    return {name: load(folder / f"{name}.toml", world="ball") for name in FILES}


def keys_of(name: str) -> set[str]:
    """Keys of the system file that a choice may change, by its name."""
    family, _, argument = name.partition("=")
    if family == "precision":
        return {f"precision.{role}" for role in ("state", "arithmetic", "decision", "accumulate")}
    if family.startswith("precision."):
        return {family}
    return {
        "reduction": {"precision.reduction"}, "stop": {"stop.rule"}, "max_iter": {"stop.max_iter"},
        "ulps": {argument.partition(":")[0]},
    }.get(family, set())  # fmt: skip


PLANTED = ("contact=", "iterations=")


@pytest.mark.parametrize("name", [name for name in shipped("ball") if not name.startswith(PLANTED)])
def test_what_a_choice_changes_and_what_it_must_not(name, systems):
    choice = parse(name)
    # each applies to one of them
    system = next(one for one in systems.values() if unavailable(choice, one) is None)
    twin = made(name, system)
    changed = set(twin.changes)
    assert changed <= keys_of(name) and twin.difference and twin.b.pins == ()
    a, b = twin.a.problem, twin.b.problem
    assert a.steps == b.steps == system.spec.integrator.steps
    moved = {key for key in ("y0", "v0") if not np.array_equal(getattr(a, key), getattr(b, key))}
    if name.startswith("order"):
        order = twin.b.order
        assert order is not None and sorted(order) == list(range(system.balls))
        np.testing.assert_array_equal(np.asarray(b.y0), np.asarray(a.y0)[list(order)])
        assert choice.must_hold == ("@" in name)
    else:
        assert twin.b.order is None and not choice.must_hold
        assert moved == {"start": {"y0"}, "start=velocity:+1": {"v0"}}.get(name, set())
        assert changed or moved
    # every number of the program but those that the keys mean
    meant = {key.rpartition(".")[2].replace("timestep", "h").replace("hysteresis", "lift") for key in changed}
    for parameter in a.world.parameters:
        own, other = (np.asarray(one.world.value(parameter), np.float64) for one in (a, b))
        assert (own == other) == (parameter not in meant) or name.startswith("precision"), parameter
    roles = {role for role in ("state", "arithmetic", "decision", "accumulate")
             if getattr(a.world.policy, role) != getattr(b.world.policy, role)}  # fmt: skip
    assert {f"precision.{role}" for role in roles} == (changed if name.startswith("precision") else set())


@pytest.mark.parametrize("name", ["ulps=contact.k:-3", "ulps=stop.tol:+1"])
def test_an_ulp_is_one_of_the_format_that_the_number_is_used_in(name, systems):
    key = keys_of(name).pop()
    for system, dtype in ((systems["batch"], np.float64), (systems["alone"], np.float32)):
        before, after = made(name, system).changes[key]
        assert after == float(neighbor(before, parse(name).ulps, np.float64 if "tol" in key else dtype))


def test_one_decision_is_planted_and_nothing_else(systems):
    system = systems["batch"]
    run = program_of(system).run(50)
    begins = np.flatnonzero(run.contacts.entered)
    (step, one), (late, other) = (
        (int(run.contacts.step[row]), int(run.contacts.subject[row, 0])) for row in begins[:2]
    )
    row = int(np.flatnonzero(run.iterations)[0])
    count = int(run.iterations[row])
    for name, *pin in (
        ("contact=earlier", "contact", step - 1, one, 1),
        ("contact=later", "contact", step, one, 0),
        ("contact=later:2", "contact", late, other, 0),
        (f"contact={step}:{one}", "contact", step, one, 0),
        ("contact=1:0", "contact", 1, 0, 1),
        ("iterations=+1", "stop", row + 1, -1, count + 1),
        ("iterations=-1", "stop", row + 1, -1, count - 1),
        (f"iterations=+2:{row + 1}", "stop", row + 1, -1, count + 2),
    ):
        choice = parse(name)
        assert choice.name == name and not choice.must_hold and choice.describe("ball")
        twin = made(name, system)
        assert twin.b.pins == (ImposedDecision(*pin),), name
        assert twin.a.problem is twin.b.problem and twin.b.order is None and not twin.changes


@pytest.mark.slow
def test_the_order_of_a_batch_is_heard_by_its_sum_alone():
    """Nine penetrations that sum to the tolerance: whichever is summed last is heard."""
    low = {f"precision.{role}": "bfloat16" for role in ("state", "arithmetic", "decision", "accumulate")}
    system = load("ball/batch-on-the-boundary", low, world="ball")
    seed = next(seed for seed in range(200) if np.random.default_rng(seed).permutation(9)[-1] == 0)
    heard, exact, alone = (
        fork(made(f"order={seed}{both}", system), counterfactual=False, repeats=0)
        for both in ("", "@exact", "@alone")
    )
    assert heard.decision is not None and (heard.dates.fork, heard.decision.channel) == (1, "stop")
    assert heard.decision.ambiguous_in
    assert exact.dates == alone.dates and exact.dates.first_bit is None and exact.dates.fork is None


@pytest.mark.parametrize(
    ("name", "system", "words"),
    [
        ("skin", "batch", "of molecular dynamics"),
        ("precision=float64", "batch", "are float64 already"),
        ("precision.force", "batch", "no role force"),
        ("precision.accumulate", "alone", "sums nothing"),
        ("reduction=kahan", "spring", "no residual"),
        ("reduction=sequential", "batch", "sequential already"),
        ("stop=sum", "batch", "sum already"),
        ("stop=maximum", "spring", "use no solver"),
        ("order", "spring", "one ball"),
        ("order", "impact", "order@alone must hold"),
        ("order@exact", "alone", "sums nothing"),
        ("order@kahan", "batch", "order@exact and order@alone"),
        ("order", "narrow", "order@exact must hold"),
        ("ulps=contact.mass", "batch", "no number contact.mass; there are .*contact.k"),
        ("ulps=start.velocity", "spring", "start.velocity is 0"),
        ("ulps=contact.eps", "batch", "no number contact.eps. Use"),
        ("start=7", "batch", "no ball 7 among 3"),
        ("start=1:2:+1", "batch", "no coordinate 2"),
        ("max_iter=+1", "spring", "no iteration to add"),
        ("max_iter=-100", "batch", "max_iter"),
        ("iterations=+1", "impact", "use no solver"),
        ("iterations=+1:51", "batch", "no step 51 from 1 to 50"),
        ("iterations=+1:1:0", "batch", "for all balls"),
        ("contact=51", "batch", "no step 51"),
        ("contact=earlier:99", "batch", "contacts begin in 50 steps"),
    ],
)
def test_a_choice_that_does_not_apply_has_a_reason(name, system, words, systems):
    reason = unavailable(parse(name), systems[system])
    with pytest.raises(InputError, match=words) as error:
        made(name, systems[system])
    assert reason is not None and reason in str(error.value) and error.value.where == parse(name).name


def test_other_steps_are_those_of_the_program(systems):
    assert made("start", systems["batch"].for_steps(80)).a.steps == 80
    control = {"flight.control": {"kind": "values", "values": [0.5, 0.25]}, "integrator.steps": 2}
    system = load("ball/drop", control, world="ball")
    assert system.for_steps(4).spec.flight.control.values == (0.5, 0.25, 0.25, 0.25)  # type: ignore[union-attr]
    assert system.for_steps(1).spec.flight.control.values == (0.5,)  # type: ignore[union-attr]
    assert dataclasses.replace(system.for_steps(2), spec=system.spec) == system


# --- maps ---------------------------------------------------------------------------------------------


def relaxation(folder, tol: float, extra: str = "") -> BallSystem:
    """One ball 0.45 m under the floor, without gravity, whose loss is what one solve leaves, squared."""
    path = folder / "relaxation.toml"
    path.write_text(
        'world = "ball"\nstart = { height = [-0.45] }\nflight = { gravity = 0.0 }\n'
        'contact = { kind = "projection", k = 0.5, alpha = 0.5 }\n'
        f'stop = {{ rule = "sum", tol = {tol!r}, max_iter = 200 }}\n'
        'integrator = { kind = "semi-implicit-euler", timestep = 1.0, steps = 1 }\n'
        f'loss = {{ kind = "residual-penetration" }}\n{extra}\n'
    )
    return load(path, world="ball")


def solved(k, tol: float, kind: Any = np.float64) -> tuple[int, list[float], float]:
    """Iterations, the penetration after each, and the last one's derivative by k, in a plain loop."""
    gain, y, slope = kind(0.5) * kind(k), -kind(0.45), 0.0
    left = [float(-y)]
    while -y >= kind(tol):
        slope = slope * (1 - float(gain)) - 0.5 * float(-y)
        y = y + gain * -y
        left.append(float(-y))
    return len(left) - 1, left, slope


def test_the_loss_margin_and_jump_on_both_sides_are_those_of_a_plain_loop(tmp_path):
    tol = 1e-4
    found = boundaries(relaxation(tmp_path, tol), "k", 0.5, 0.51, cells=2, confirm=False)
    (edge,) = found.boundaries
    assert (edge.below.at, edge.above.at) == (0.5035674359581246, 0.5035674359581247)
    assert (edge.channel, edge.step, edge.subject) == ("stop", 1, ()) and found.evaluations < 64
    (few, under, low), (count, over, high) = (solved(side.at, tol) for side in (edge.below, edge.above))
    assert (edge.below.decided, edge.above.decided) == (few, count) == (30, 29)
    assert (edge.below.loss, edge.above.loss) == (under[-1] ** 2, over[-1] ** 2)
    # after 29 iterations one goes on and the other stops
    assert edge.below.margin == tol - under[29] <= 0 < edge.above.margin == tol - over[29]
    slopes = 2 * under[-1] * low, 2 * over[-1] * high
    np.testing.assert_allclose([edge.below.gradient, edge.above.gradient], slopes, rtol=1e-12)
    assert edge.jump == over[-1] ** 2 - under[-1] ** 2
    # 2.5e-5 m between two floats 1.1e-16 apart
    assert np.sqrt(edge.above.loss) - np.sqrt(edge.below.loss) == pytest.approx(2.518e-5, rel=1e-3)


def test_every_boundary_among_all_float16_values_of_an_interval(tmp_path):
    tol = float(np.float16(1e-2))
    roles = ("state", "arithmetic", "decision", "accumulate", "loss")
    precision = "precision = { " + ", ".join(f'{role} = "float16"' for role in roles) + " }"
    found = boundaries(relaxation(tmp_path, tol, precision), "k", 0.3, 0.9, cells=4, confirm=False)
    first, last = (int(np.float16(end).view(np.int16)) for end in (0.3, 0.9))
    every = np.arange(first, last + 1, dtype=np.int16).view(np.float16)
    counts = [solved(k, tol, np.float16)[0] for k in every]
    edges = [
        (float(every[n]), float(every[n + 1]), counts[n], counts[n + 1])
        for n in range(len(every) - 1)
        if counts[n] != counts[n + 1]
    ]
    assert len(edges) > 10 and found.evaluations < len(every)
    assert [
        (edge.below.at, edge.above.at, edge.below.decided, edge.above.decided) for edge in found.boundaries
    ] == edges


def test_every_float_of_a_narrow_number_is_run(systems):
    """In float32 an interval of a few floats is complete, and its ends are floats of that format."""
    at = np.float32(0.5)
    high = float(at + 6 * np.spacing(at))
    found = boundaries(systems["alone"], "contact.k", float(at), high, cells=16, confirm=False)
    assert found.complete and found.evaluations == 7 and found.resolution == np.spacing(at)
    with pytest.raises(InputError, match=r"'mass' is not a parameter.* k, "):
        boundaries(systems["alone"], "mass", 0.0, 1.0)
    with pytest.raises(InputError, match="at least 0"):
        boundaries(systems["alone"], "k", -1.0, 1.0)
