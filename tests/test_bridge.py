"""The two worlds side by side: each row of the README's table, on the code that both share."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from small_systems import make

from mdnum import ball
from mdnum.events import Hysteresis, Ledger, Threshold, broken_alternations
from mdnum.events.saltation import carry
from mdnum.md.stepper import MdState, PairDynamics
from mdnum.precision.reductions import BY_NAME
from mdnum.rollout.engine import first_state
from mdnum.rollout.health import rebuild_ledger
from mdnum.rollout.run import run
from mdnum.store import RunFolder
from mdnum.systems.build import Simulation, build


def dimer(distance: float, speed: float = 0.0) -> Atoms:
    """Two free atoms of mass 2 (reduced mass 1) on the x axis, that part with a relative speed."""
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [distance, 0, 0]], masses=[2.0, 2.0])
    atoms.set_velocities([[-speed / 2, 0, 0], [speed / 2, 0, 0]])
    return atoms


def pair_dynamics(simulation: Simulation) -> tuple[PairDynamics, MdState]:
    start = first_state(simulation)
    table = simulation.verlet_list().build(start.reference, simulation.cell)
    masses = jnp.asarray(simulation.masses[table.order])
    dynamics = PairDynamics(simulation.force, simulation.integrator, masses, simulation.tables(table))
    state = MdState(jnp.zeros((), jnp.int64), start.state.x[:, table.order], start.state.v[:, table.order])
    return dynamics, state


def test_contact_is_a_pair_inside_the_cutoff():
    """A ball on a spring floor is a pair of soft spheres: one trajectory, and one ledger."""
    k, h, steps = 1000.0, 2e-3, 400
    simulation = build(
        make(
            dimer(1.2, -1.03),
            {"kind": "soft-sphere", "sigma": 1.0, "epsilon": k, "alpha": 2.0},
            {"kind": "hard", "radius": 1.0, "compare": "r <"},
            neighbors={"skin": 1.0},
            dynamics={"kind": "nve", "timestep": h, "remove_drift": False},
        )
    )
    dynamics, state = pair_dynamics(simulation)

    @jax.jit
    def advance(dynamics, state):
        own = dynamics.decide(state)
        return dynamics.step(state, own), jnp.max(dynamics.margins(state)), jnp.any(own > 0)

    distance, margin, inside = [], [], []
    for _ in range(steps + 1):
        distance.append(float(abs(state.x[0, 0] - state.x[0, 1])))
        state, nearest, touches = advance(dynamics, state)
        margin.append(float(nearest))
        inside.append(bool(touches))

    world = ball.World.create(ball.Penalty(k), ball.BallVerlet(h), gravity=0.0)
    rollout = ball.simulate(world, world.start(0.2, -1.03), steps)
    np.testing.assert_allclose(rollout.y[:, 0] + 1, distance, rtol=0, atol=2e-13)
    np.testing.assert_array_equal(rollout.contact[:, 0], inside[1:])
    contacts = rollout.contacts
    assert list(contacts.entered) == [True, False]
    np.testing.assert_allclose(contacts.margin, np.array(margin)[contacts.step], atol=2e-13)
    assert isinstance(contacts, Ledger) and broken_alternations(contacts) == 0


def test_softplus_width_is_switching_width():
    """Both take the jump at the threshold away, and both cost a bias in proportion to the width."""
    widths = (0.4, 0.2, 0.1)
    edge, shift = [], []
    for width in widths:
        cutoff = {"kind": "switched", "radius": 2.5, "onset": 2.5 - width}
        model = build(make(dimer(2.0), {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0}, cutoff)).model
        r = np.linspace(2.5 - width, 2.5, 2001)
        energy, slope = model.evaluate(jnp.asarray(r**2), None, model.at_cutoff())
        full = 4 * (r**-12 - r**-6)
        edge.append(abs(float(slope[-1])))
        shift.append(np.trapezoid(np.asarray(energy) - full, r))
    assert max(edge) < 1e-14
    np.testing.assert_allclose(np.array(shift[:-1]) / shift[1:], 2, rtol=0.2)

    r, bias = 1e-6, []
    for eps in widths:
        contact = ball.Penalty(1e3, eps=eps, smooth=True)
        heights = jnp.asarray([-r, 0.0, r])
        depth = np.asarray(contact.depth(heights, heights < 0))
        # the slope of the force on either side of the floor: 1 and 0 for the hard spring
        assert abs((depth[0] - depth[1]) - (depth[1] - depth[2])) < 1e-5 * r
        bias.append(float(depth[1]))
    np.testing.assert_allclose(bias, np.log(2) * np.array(widths), rtol=1e-12)
    hard = np.asarray(ball.Penalty(1e3).depth(heights, heights < 0))
    assert (hard[0] - hard[1]) - (hard[1] - hard[2]) == pytest.approx(r)


@pytest.fixture(scope="module")
def skins(tmp_path_factory):
    """One crystal under two skins."""
    made = {}
    for skin in (0.1, 0.7):
        folder = tmp_path_factory.mktemp("bridge") / "run"
        run("argon/crystal-108", out=folder, steps=400, overrides={"neighbors.skin": skin})
        made[skin] = RunFolder.open(folder)
    return made


def test_hysteresis_is_the_verlet_skin(skins):
    """A wider gap, fewer decisions to act anew; and what is inside is the same."""
    builds = {skin: folder.rows("epochs") for skin, folder in skins.items()}
    assert builds[0.1] > builds[0.7] >= 1
    narrow, wide = (folder.read("flips", ["step", "i", "j", "entered"]) for folder in skins.values())
    early = [table["step"] < 100 for table in (narrow, wide)]
    for name in ("step", "i", "j", "entered"):
        np.testing.assert_array_equal(narrow[name][early[0]], wide[name][early[1]])

    noise = np.random.default_rng(5).normal(0, 1e-3, 400)
    flips = []
    for gap in (0.0, 2e-3, 2e-2):
        trigger = Hysteresis(Threshold(0.0, "<", "height"), Threshold(gap, "<=", "height"))
        decided = [False]
        for height in np.linspace(0.02, -0.02, 400) + noise:
            decided.append(bool(trigger.decide(height, decided[-1])))
        flips.append(int(np.sum(np.diff(np.array(decided, int)) != 0)))
    assert flips[0] > flips[1] > flips[2] == 1


def test_stopping_tolerance_is_the_list_rebuild(skins):
    """Both are a threshold on something used up; the recorded margin has the sign of the decision."""
    rebuilds = rebuild_ledger(skins[0.1])
    assert len(rebuilds) > 0
    assert (np.sign(rebuilds.margin) == np.where(rebuilds.entered, 1, -1)).all()

    contact = ball.Projection(0.5, 0.5, ball.GlobalSum(1e-4))
    world = ball.World.create(contact, ball.SemiImplicitEuler(0.01))
    rollout = ball.simulate(world, world.start(np.linspace(0.2, 1, 7)), 400)
    iterated = rollout.iterations > 0
    assert iterated.any()
    # the last decision stops, the one before went on
    assert (rollout.margin > 0).all()
    assert (rollout.before[iterated] <= 0).all() and np.isneginf(rollout.before[~iterated]).all()


@pytest.mark.parametrize("name", ["sequential", "pairwise", "neumaier", "exact"])
def test_global_sum_is_force_accumulation(name):
    """One reduction object adds up penetrations and pair forces; only an exact one ignores the order."""
    reduction = BY_NAME[name]
    rng = np.random.default_rng(3)
    depths = 10.0 ** rng.uniform(-8, 0, 64)
    totals = set()
    for _ in range(8):
        order = rng.permutation(64)
        contact = ball.Projection(0.5, 0.5, ball.GlobalSum(1e-4, 100, reduction))
        world = ball.World.create(contact, ball.SemiImplicitEuler(0.01), gravity=0.0)
        rollout = ball.simulate(world, world.start(-depths[order]), 1, history=True)
        totals.add(float(rollout.history[0, 0]))
    assert len(totals) == 1 if name == "exact" else name == "neumaier" or len(totals) > 1

    system = build("argon/crystal-108", {"precision.reduction": name})
    force = np.asarray(system.evaluate().forces)
    reference = np.asarray(build("argon/crystal-108", {"precision.reduction": "exact"}).evaluate().forces)
    assert system.reduction == reduction
    assert np.abs(force - reference).max() < 1e-13
    if name == "exact":
        np.testing.assert_array_equal(force, reference)


def test_saltation_at_impact_is_saltation_at_a_force_jump():
    """One function carries a tangent through an impact and through a hard cutoff; both meet closed forms."""
    # the ball: from y0 down, through the impact and up again
    g, e, y0, end = 9.81, 0.8, 1.0, 0.9
    time = np.sqrt(2 * y0 / g)
    v = -g * time
    reset = np.array([[1.0, 0.0], [0.0, -e]])
    # dy0 has become (1, 0) at the floor
    kick = carry(np.array([1.0, 0.0]), reset, np.array([v, -g]), np.array([-e * v, -g]), np.array([1.0, 0.0]))
    rest = end - time
    after = kick[0] + rest * kick[1]

    def height(start):
        t = np.sqrt(2 * start / g)
        return e * g * t * (end - t) - g * (end - t) ** 2 / 2

    exact = (height(y0 + 1e-6) - height(y0 - 1e-6)) / 2e-6
    assert after == pytest.approx(exact, rel=1e-8)

    # the pair that leaves its well through a hard cutoff
    simulation = build("pair/leaving-well")
    dynamics, state = pair_dynamics(simulation)

    @jax.jit
    def step(dynamics, state, tangent):
        own = dynamics.decide(state)

        def told(x, v):
            after = dynamics.step(state._replace(x=x, v=v), own)
            return after.x, after.v

        (x, v), moved = jax.jvp(told, (state.x, state.v), tangent)
        force = dynamics.force(state.x, dynamics.tables, decisions=False, given=own).force
        return MdState(state.step + 1, x, v), moved, own, force

    # the separation grows by one unit
    along = jnp.asarray(np.sign(np.asarray(state.x - state.x.mean(axis=1, keepdims=True)))) / 2
    plain = aware = (along, jnp.zeros_like(state.v))
    inside, inner = True, np.zeros((3, 2))
    masses = np.asarray(dynamics.masses)
    for _ in range(2000):
        was = state
        state, aware, own, force = step(dynamics, was, aware)
        _, plain, _, _ = step(dynamics, was, plain)
        if inside and not np.asarray(own).any():
            # the first step without the pair: the tangent is carried through the crossing before it
            inside = False
            n = np.asarray(was.x[:, 1] - was.x[:, 0])
            n = n / np.linalg.norm(n)
            normal = np.concatenate([np.stack([-n, n], axis=1).ravel(), np.zeros(6)])
            speeds = np.asarray(was.v).ravel()
            flow = [np.concatenate([speeds, (f / masses).ravel()]) for f in (inner, np.zeros((3, 2)))]
            tangent = np.concatenate([np.asarray(part).ravel() for part in aware])
            carried = carry(tangent, None, *flow, normal)
            aware = tuple(jnp.asarray(part.reshape(3, 2)) for part in np.split(carried, 2))
        inner = np.asarray(force) if inside else inner
    assert not inside
    speed = [float(abs(v[0, 1] - v[0, 0])) for _, v in (plain, aware)]
    # dv/dr0 = u'(1.8) / v(end), by conservation of energy
    u = lambda r: 4 * (r**-12 - r**-6)  # noqa: E731
    slope = 4 * (-12 * 1.8**-13 + 6 * 1.8**-7)
    exact = slope / np.sqrt(1 + 2 * u(1.8) - 2 * u(2.5))
    assert exact == pytest.approx(0.411400, abs=1e-6)
    assert speed[0] == pytest.approx(0.3599, abs=2e-4)
    assert speed[1] == pytest.approx(exact, abs=5e-4)
