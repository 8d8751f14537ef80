"""Complex order parameters of a drifting crystal: gradients, behavior near zero, and the branch cut."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from ase.build import fcc111
from ase.neighborlist import neighbor_list
from jaxtyping import Array

from mdnum.gradients import Problem, value_and_grad
from mdnum.gradients.losses import Loss
from mdnum.numerics import Ledger, Threshold, gamma
from mdnum.rollout.engine import Engine
from mdnum.systems import System, SystemSpec
from mdnum.systems.build import build
from mdnum.systems.simulation import Simulation
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

A, SPEED, DT, STEPS, EPSILON = 1.11, 10.0, 0.004, 100, "potential.epsilon"
NAMES = ("psi6", "S at a Bragg peak", "S at a long wave")


def layer() -> tuple[Simulation, tuple[Array, ...]]:
    """Return a drifting layer of 64 Lennard-Jones atoms, its neighbors, images and two wave vectors."""
    atoms = fcc111("Ar", (8, 8, 1), a=A * np.sqrt(2), vacuum=6.0, orthogonal=True, periodic=True)
    first, second, image = neighbor_list("ijS", atoms, 1.2 * A)
    atoms.set_array("masses", np.ones(64))
    heat = 0.4 * np.random.default_rng(3).standard_normal((64, 3))
    atoms.set_velocities(heat - heat.mean(0) + [SPEED, 0, 0])
    spec = SystemSpec.model_validate({
        "units": "lj", "structure": {"file": "none"}, "cutoff": {"kind": "switched", "radius": 2.5},
        "potential": {"kind": "lennard-jones", "sigma": 1.0, "epsilon": 1.0}, "neighbors": {"skin": 0.3},
        "dynamics": {"kind": "nve", "timestep": DT, "remove_drift": False},
    })  # fmt: skip
    waves = 2 * np.pi / A * np.array([[1, -1 / np.sqrt(3), 0], [1 / 8, 0, 0]])
    lattice = np.stack([first, second]), image @ atoms.cell.array, waves
    return build(System("layer", spec, None, atoms)), tuple(map(jnp.asarray, lattice))


class Order(Loss):
    """Complex loss: the sum of w z at the last step."""

    name = "order"
    w: Array = eqx.field(kw_only=True)  # shape (3,): which of the order parameters
    lattice: tuple[Array, ...] = eqx.field(kw_only=True)  # pairs, images, wave vectors

    def z(self, x: Array) -> Array:
        """Return three order parameters for x, shape (3, atoms): means of numbers of modulus 1."""
        (first, second), image, waves = self.lattice
        d = x[:, second] - x[:, first] + image.T
        angles = [6 * jnp.arctan2(d[1], d[0]), *(waves @ x)]
        return jnp.stack([jax.lax.complex(jnp.mean(jnp.cos(a)), jnp.mean(jnp.sin(a))) for a in angles])

    def observe(self, frame, origin, around):
        return jnp.sum(self.w * self.z(frame.x))


def cuts(z: np.ndarray, bound: float) -> Ledger:
    """Return the crossings of the branch cut of arg z: sign changes of Im z where Re z < 0."""
    turn = np.diff(np.angle(z))
    step = np.flatnonzero(np.abs(turn) > np.pi) + 1
    above, bounds = Threshold(0.0).decide(-np.imag(z)[step]), np.full(len(step), bound)
    return Ledger("branch", step, step[:, None] * 0, above, np.imag(z)[step], bounds,
                  -2 * np.pi * np.sign(turn[step - 1]))  # fmt: skip


def run() -> Demo:
    """Differentiate psi6 and S through the dynamics with respect to epsilon, then |z| and arg z alone."""
    simulation, lattice = layer()
    losses = [Order(w=w, lattice=lattice, first=STEPS) for w in jnp.eye(3, dtype=complex)]
    problems = [Problem(simulation, loss, STEPS) for loss in losses]
    found = [value_and_grad(problem, [EPSILON], "symmetric")({}) for problem in problems]
    z, dz = np.array([value for value, _ in found]), np.array([slope[EPSILON] for _, slope in found])
    high, low = (np.array([p.value({EPSILON: 1 + h}) for p in problems]) for h in (1e-5, -1e-5))
    g = np.array([jax.grad(jnp.abs)(one) for one in jnp.asarray(z)])
    real = (np.abs(high) - np.abs(low)) / 2e-5
    off, wrong = (float(np.max(np.abs(np.real(one * dz) / real - 1))) for one in (g, np.conj(g)))
    rows = [row for part in Engine(simulation, STEPS).segments() for row in np.array(part.rows_of("x"))]
    peak = np.array([losses[0].z(row)[1] for row in np.array(rows)])
    ledger = cuts(peak, float(gamma(1000, np.dtype(float))))
    phase, step = np.angle(peak) + ledger.jumps(STEPS).cumsum(), np.arange(STEPS + 1)
    turned, turns = float(phase[-1] - phase[0]) / (2 * np.pi), SPEED * DT * STEPS / A
    slopes = [jax.grad(f) for f in (jnp.abs, jnp.angle, lambda z: z.real / jnp.abs(z))]
    near = [(abs(r), *(f"{abs(complex(f(r))):.3g}" for f in slopes)) for r in (1j, 1e-8j, 1e-200j, 0j)]
    rows = list(zip(NAMES, *np.abs([z, g]).tolist(), np.real(g * dz).tolist(), real.tolist(), strict=True))
    return Demo(
        title="Order parameters are complex numbers",
        question="How do |psi6|, |S(k)| and the phase of S(k) of a crystal depend on epsilon through a run?",
        result=f"d|z|/depsilon = Re(g dz) with the g of jax.grad is correct within {off:.0e}; with its "
        f"conjugate, "
        f"the convention of PyTorch, the error is {100 * wrong:.0f} %. The phase of S crosses its "
        f"branch cut "
        f"{len(ledger)} times in {turned:.2f} turns.",
        answer="For a real f(z) jax.grad gives df/dx - i df/dy, so that df = Re(g dz). The gradient of "
        "|z| has modulus 1 for any z, the gradient of the phase has modulus 1/|z|. At z = 0 neither "
        "exists; JAX returns 0 for |z| and NaN for z/|z|. A crossing of the branch cut is a flip with a "
        "margin, Im z, and a jump of 2 pi. If the jumps in the ledger are added, the phase is continuous.",
        numbers={"error": off, "error_conjugate": wrong, "crossings": len(ledger), "turns": turned,
                 "steps": ledger.step.tolist(), "smallest_margin": float(np.abs(ledger.margin).min()),
                 "psi6": float(np.abs(z[0])), "gradient_at_zero": list(near[-1][1:])},
        checks=[
            Claim("d|z| agrees with finite differences of real numbers", off, "below 1e-6", off < 1e-6),
            Claim("with the conjugate gradient d|z| does not agree", wrong, "above 0.01", wrong > 0.01),
            Claim("the phase follows the drift", turned, f"{turns:.3f} ± 0.02", abs(turned - turns) < 0.02),
            Claim("no crossing is within rounding", sum(ledger.ambiguous), "0", not any(ledger.ambiguous)),
        ],
        tables=[
            table("at the last step", ("z", "|z|", "|g|", "d|z|/depsilon", "by differences"), rows),
            table("modulus of the result of jax.grad", ("|z|", "of |z|", "of arg z", "of Re z/|z|"), near),
            table("crossings of the branch cut", ("step", "margin Im z", "bound", "jump"),
                  np.stack([ledger.step, ledger.margin, ledger.bound, ledger.jump], 1).tolist()),
        ],
        plots=[Plot("phase", "Phase of the Bragg peak of a drifting crystal", "step", "phase (rad)", (
            Series("arg S", step, np.angle(peak), "points", "muted"),
            Series("with the jumps of the ledger", step, phase),
        ), caption="arg S jumps at its branch cut; each jump is a flip.")],
        in_md=(
"This demonstration uses atoms: a Lennard-Jones layer, differentiated through the steps "
"of the simulation."
),
    )  # fmt: skip
