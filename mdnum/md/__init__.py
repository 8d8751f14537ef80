"""Molecular dynamics: boxes, neighbor lists, pair decisions, potentials and integrators."""
