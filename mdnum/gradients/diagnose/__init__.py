"""Whether a gradient through a rollout can be trusted, how far, and what it is made of."""

from mdnum.gradients.diagnose.agreement import agreement
from mdnum.gradients.diagnose.detective import detective
from mdnum.gradients.diagnose.diagnose import PARTS, diagnose
from mdnum.gradients.diagnose.edges import edges
from mdnum.gradients.diagnose.flips import flips
from mdnum.gradients.diagnose.growth import growth
from mdnum.gradients.diagnose.horizons import Horizons, horizons
from mdnum.gradients.diagnose.places import Edge, Edges, Flips, NotFinite, Scaling
from mdnum.gradients.diagnose.results import (
    Agreement,
    Comparison,
    Diagnosis,
    Growth,
    Limit,
    Opinion,
    Spectrum,
    Trust,
)
from mdnum.gradients.diagnose.scaling import scaling
from mdnum.gradients.diagnose.spectrum import spectrum
from mdnum.gradients.diagnose.trust import trust

__all__ = [
    "PARTS",
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
    "detective",
    "diagnose",
    "edges",
    "flips",
    "growth",
    "horizons",
    "scaling",
    "spectrum",
    "trust",
]
