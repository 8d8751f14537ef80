"""Gradients of long rollouts that can be trusted, and that say how far.

A rollout is differentiated at the states and decisions that it recorded; what the flips on the way add is a
term of its own. Each way of doing it is an object behind one contract (`mdnum.gradients.base`).
"""

from mdnum.gradients.api import differentiable, value_and_grad
from mdnum.gradients.base import Gradient, Method, Problem
from mdnum.gradients.registry import METHODS, by_word

__all__ = ["METHODS", "Gradient", "Method", "Problem", "by_word", "differentiable", "value_and_grad"]
