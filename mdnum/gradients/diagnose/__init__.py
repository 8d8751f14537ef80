"""Whether a gradient through a rollout can be trusted, how far, and what it is made of."""

from mdnum.gradients.diagnose.agreement import agreement
from mdnum.gradients.diagnose.flips import flips
from mdnum.gradients.diagnose.growth import growth
from mdnum.gradients.diagnose.horizons import Horizons, horizons
from mdnum.gradients.diagnose.results import (
    Agreement,
    Comparison,
    Diagnosis,
    Edge,
    Edges,
    Flips,
    Growth,
    Limit,
    NotFinite,
    Opinion,
    Scaling,
    Spectrum,
    Trust,
)
from mdnum.gradients.diagnose.trust import trust

__all__ = [
    "Agreement",
    "Comparison",
    "Diagnosis",
    "Edge",
    "Edges",
    "Flips",
    "Growth",
    "Horizons",
    "Limit",
    "NotFinite",
    "Opinion",
    "Scaling",
    "Spectrum",
    "Trust",
    "agreement",
    "flips",
    "growth",
    "horizons",
    "trust",
]
