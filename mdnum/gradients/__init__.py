"""Gradients of long simulations, with estimates of the number of steps for which they can be trusted.

A simulation is differentiated at its recorded states and decisions; the contribution of the flips is a
separate term. Each gradient method is a `Method`; each quantity that can be differentiated is a `Loss`.
"""

from mdnum.gradients.differentiate import differentiable, value_and_grad
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, method

__all__ = ["METHODS", "Gradient", "Method", "Problem", "differentiable", "method", "value_and_grad"]
