"""Two rollouts side by side: only what both count is compared."""

from __future__ import annotations

import numpy as np

from mdnum import ball


def run(contact, scheme, steps=60):
    world = ball.World.create(contact, scheme)
    return ball.simulate(world, world.start(np.array([1.0, 1.03])), steps)


def test_located_impacts_are_no_iterations_of_a_solver():
    located = run(ball.Impact(0.8), ball.EventLocated(0.01))
    stepped = run(ball.Impact(0.8), ball.SemiImplicitEuler(0.01))
    assert located.iterations.sum() > 0
    assert ball.first_difference(located, stepped).iterations_differ == 0
    assert ball.first_difference(located, stepped).channel == "contact"


def test_a_projection_and_an_impact_part_by_what_they_decide_about_contact_alone():
    solved = run(ball.Projection(0.5, 0.5, ball.Maximum(1e-9)), ball.SemiImplicitEuler(0.01))
    reset = run(ball.Impact(0.8), ball.SemiImplicitEuler(0.01))
    assert solved.iterations.sum() > 0
    found = ball.first_difference(solved, reset)
    # both reset at the end of the step: the same contacts, and no stop decision on one side
    assert (found.fork, found.channel, found.iterations_differ) == (None, "", 0)


def test_two_counts_of_one_solver_are_compared():
    loose = run(ball.Projection(0.5, 0.5, ball.Maximum(1e-3)), ball.SemiImplicitEuler(0.01))
    tight = run(ball.Projection(0.5, 0.5, ball.PerInstance(1e-9)), ball.SemiImplicitEuler(0.01))
    found = ball.first_difference(loose, tight)
    assert (found.fork, found.channel) == (int(loose.first_contact.min()), "stop")
    assert found.iterations_differ > 0


def test_impacts_of_two_located_runs_are_compared():
    long = run(ball.Impact(0.8), ball.EventLocated(0.01), 450)
    short = run(ball.Impact(0.8, 0.1), ball.EventLocated(0.01), 450)
    assert ball.first_difference(long, short).iterations_differ > 0
