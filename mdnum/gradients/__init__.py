"""Gradients of long rollouts, and how far each can be trusted.

A rollout is differentiated at the states and decisions that it recorded; what the flips on the way add is a
term of its own. Each way of doing it is a `Method`, each number that can be differentiated a `Loss`.
"""

from mdnum.gradients.differentiate import differentiable, value_and_grad
from mdnum.gradients.problem import METHODS, Gradient, Method, Problem, method

__all__ = ["METHODS", "Gradient", "Method", "Problem", "differentiable", "method", "value_and_grad"]
