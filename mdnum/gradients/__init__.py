"""Gradients of long rollouts that can be trusted, and that say how far.

A rollout is differentiated at the states and decisions that it recorded; what the flips on the way add is a
term of its own. Each way of doing it is an object behind one contract (`mdnum.gradients.base`).
"""
