"""Gradients of long rollouts, with estimates of how far each gradient can be trusted.

A rollout is differentiated at its recorded states and decisions; the contribution of the flips is a separate
term. Each way to differentiate is a `Method`; each number that can be differentiated is a `Loss`.
"""

from mdnum.gradients.differentiate import differentiable, value_and_grad
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, method

__all__ = ["METHODS", "Gradient", "Method", "Problem", "differentiable", "method", "value_and_grad"]
