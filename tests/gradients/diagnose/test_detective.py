"""Numbers that are not finite, planted, and found where they were planted."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ase import Atoms
from small_systems import LENNARD_JONES, make

from mdnum.errors import NumericalError
from mdnum.gradients import Problem, value_and_grad
from mdnum.gradients.diagnose.detective import detective
from mdnum.gradients.losses import Custom, VelocityAutocorrelation
from mdnum.gradients.parameters import with_values
from mdnum.numerics.jaxprs import first_not_finite
from mdnum.systems import build

APART = 3e-3


@pytest.fixture(scope="module")
def meeting():
    """Two atoms in float32 that are outside the cutoff at step 0 and almost in one place at step 1.

    Force and energy there are finite, r^-16 is not.
    """
    atoms = Atoms("Ar2", positions=[[1, 3, 3], [2.1, 3, 3]], cell=[6, 6, 6], pbc=True)
    atoms.set_array("masses", np.ones(2))
    narrow = dict.fromkeys(("state", "force", "decision", "accumulate"), "float32")
    simulation = build(
        make(
            atoms,
            LENNARD_JONES,
            {"kind": "hard", "radius": 1.0},
            precision=narrow,
            neighbors={"skin": 1.2},
        )
    )
    speed = (1.1 - APART) / (2 * float(simulation.integrator.timestep))
    velocities = np.array([[speed, 0, 0], [-speed, 0, 0]])
    return Problem(with_values(simulation, {"initial.velocities": velocities}), VelocityAutocorrelation(), 1)


def gone(frame, origin, around):
    """The distance that an atom has gone has no derivative at step 0."""
    return jnp.sum(jnp.sqrt(jnp.sum(jnp.square(frame.x - origin.x), axis=0)))


@pytest.mark.nightly
@pytest.mark.slow
def test_the_pair_whose_second_derivative_overflows_is_named(meeting):
    found = detective(meeting, ("sigma",))
    assert found.found and found.forward and found.step == 1
    assert (found.part, found.i, found.j) == ("forces", 0, 1)
    assert found.distance == pytest.approx(APART, rel=1e-3)
    assert found.operation == "mul" and found.source.endswith("LennardJones.evaluate")


@pytest.mark.parametrize(
    ("loss", "expected"),
    [
        pytest.param(VelocityAutocorrelation(), (False, True, "", ""), marks=pytest.mark.slow),
        # as in the refusal below
        pytest.param(Custom(see=gone), (True, True, "loss", "div"), marks=pytest.mark.nightly),
        # a loss that is not finite itself is no fault of the reverse pass
        (Custom(see=lambda frame, *_: jnp.log(jnp.sum(frame.v))), (True, False, "loss", "log")),
    ],
)
def test_a_root_of_the_loss_at_zero_is_found_in_the_loss(meeting, loss, expected):
    far = with_values(meeting.simulation, {"initial.velocities": np.zeros((2, 3))})
    found = detective(Problem(far, loss, 1), ("sigma",), saltation=False)
    assert (found.found, found.forward, found.part, found.operation) == expected
    assert "gone" in found.source or expected[3] != "div"
    assert np.isnan(found.distance) and found.j == -1 and (found.step == -1) == (not found.found)


def test_a_gradient_that_is_not_finite_is_refused_with_the_operation_at_fault(meeting):
    far = with_values(meeting.simulation, {"initial.velocities": np.zeros((2, 3))})
    function = value_and_grad(Problem(far, Custom(see=gone), 1), ["initial.velocities"], "symmetric")
    with pytest.raises(NumericalError, match=r"initial\.velocities .*not finite: .* div\(.*gone"):
        function()


def test_what_is_masked_away_is_not_blamed():
    """A division by zero whose result nobody uses stands before the one that counts."""

    def program(x):
        def body(total, y):
            harmless = jnp.where(y == 1, 0.0, 1 / (y - 1))
            return total + jnp.sqrt(jnp.sum((x - y) ** 2)) * harmless, None

        return jax.lax.scan(body, jnp.zeros(()), jnp.arange(3.0))[0]

    x = jnp.array([2.0])
    assert bool(jnp.isfinite(program(x))) and first_not_finite(program, x) is None
    found = first_not_finite(jax.jit(jax.grad(program)), x)
    assert found is not None
    # the root at x = y, in the last round, going back
    assert (found.name, found.rounds, found.inputs) == ("div", (2,), (0.5, 0.0))


def test_loops_of_unknown_length_and_branches_are_looked_into():
    def program(x):
        def body(state):
            k, value = state
            return k + 1, jax.lax.cond(k == 2, lambda v: v / (v - v), lambda v: v + 1, value)

        return jax.lax.while_loop(lambda state: state[0] < 4, body, (0, x))[1]

    found = first_not_finite(program, jnp.ones(3))
    assert found is not None and (found.name, found.rounds) == ("div", (2,))
    assert found.shape == (3,) and found.index == (0,) and "program" in found.functions
    assert first_not_finite(program, jnp.full(3, jnp.nan)) is None
