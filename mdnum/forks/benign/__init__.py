"""Is a fork benign? An ensemble-consistency test with a calibrated window."""

from __future__ import annotations

from mdnum.forks.benign.calibration import Calibration, Planted, Window, calibrate
from mdnum.forks.benign.verdict import Benign, benign

__all__ = ["Benign", "Calibration", "Planted", "Window", "benign", "calibrate"]
