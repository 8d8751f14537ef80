"""Whether a gradient through a rollout can be trusted, how far, and what it is made of."""

from mdnum.gradients.diagnose.agreement import agreement
from mdnum.gradients.diagnose.detective import detective
from mdnum.gradients.diagnose.diagnose import PARTS, GradientDiagnosis, diagnose
from mdnum.gradients.diagnose.edges import edges
from mdnum.gradients.diagnose.flips import flips
from mdnum.gradients.diagnose.growth import GradientGrowth, growth
from mdnum.gradients.diagnose.horizons import horizons
from mdnum.gradients.diagnose.spectrum import Spectrum, spectrum
from mdnum.gradients.diagnose.trust import Trust, trust

__all__ = [
    "PARTS", "GradientDiagnosis", "GradientGrowth", "Spectrum", "Trust", "agreement", "detective",
    "diagnose", "edges", "flips", "growth", "horizons", "spectrum", "trust",
]  # fmt: skip
