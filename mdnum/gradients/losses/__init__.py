"""Losses of a trajectory, evaluated frame by frame: the trajectory is never stored whole."""

from mdnum.gradients.losses.base import Custom, Frame, Loss, Surroundings
from mdnum.gradients.losses.states import (
    FinalProjection,
    MeanPotential,
    MeanPressure,
    MeanSquaredDisplacement,
    MeanTemperature,
)
from mdnum.gradients.losses.structure import RadialDistribution
from mdnum.gradients.losses.transport import EinsteinDiffusion, GreenKuboDiffusion, VelocityAutocorrelation

__all__ = [
    "Custom",
    "EinsteinDiffusion",
    "FinalProjection",
    "Frame",
    "GreenKuboDiffusion",
    "Loss",
    "MeanPotential",
    "MeanPressure",
    "MeanSquaredDisplacement",
    "MeanTemperature",
    "RadialDistribution",
    "Surroundings",
    "VelocityAutocorrelation",
]
