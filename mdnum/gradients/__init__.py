"""Gradients of long simulations, and how far they can be trusted.

A simulation is differentiated at its recorded decisions. Flips contribute a separate term. Gradient methods
are subclasses of `Method`, and losses are subclasses of `Loss`.
"""

from mdnum.gradients.differentiate import differentiable, value_and_grad
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, method

__all__ = ["METHODS", "Gradient", "Method", "Problem", "differentiable", "method", "value_and_grad"]
