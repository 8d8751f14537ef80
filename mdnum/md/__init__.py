"""Molecular dynamics: boxes, lists, decisions, potentials and integrators."""

# float64 must be on before the first array exists, whichever of these files is imported first
import mdnum.precision  # noqa: F401
