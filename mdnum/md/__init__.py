"""Molecular dynamics: boxes, lists, decisions, potentials and integrators."""
