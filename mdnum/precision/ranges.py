"""How near a number comes to the ends of its format, step by step.

A range error is silent until the first infinity: a sum that overflows, a residual that falls among the
subnormals, a denominator that comes near zero. This says at which step, and how many doublings were left.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from mdnum.precision.formats import Format, get


@dataclass(frozen=True)
class Range:
    """The range of one quantity over the steps of a run.

    Attributes:
        name: of the quantity.
        format: whose limits it is held against.
        denominator: whether something is divided by it.
        low, high: smallest and largest value, shape (steps,); NaN where none is finite.
        smallest, largest: magnitudes, shape (steps,); zeros are left out of the smallest (inf where
            all are zero).
        zeros, subnormal, not_finite: how many values are, shape (steps,). Subnormal: below the smallest
            normal number of the format and not zero.
    """

    name: str
    format: Format
    denominator: bool
    low: Float[np.ndarray, "steps"]
    high: Float[np.ndarray, "steps"]
    smallest: Float[np.ndarray, "steps"]
    largest: Float[np.ndarray, "steps"]
    zeros: Int[np.ndarray, "steps"]
    subnormal: Int[np.ndarray, "steps"]
    not_finite: Int[np.ndarray, "steps"]

    @property
    def headroom(self) -> Float[np.ndarray, "steps"]:
        """Doublings left before overflow, log2(limit / largest magnitude); negative: out of range."""
        with np.errstate(divide="ignore"):
            return np.log2(self.format.largest) - np.log2(self.largest)

    @property
    def footroom(self) -> Float[np.ndarray, "steps"]:
        """Halvings left before the smallest magnitude is subnormal; negative: some are."""
        return np.log2(self.smallest) - np.log2(self.format.smallest_normal)

    @property
    def reciprocal_overflows(self) -> Bool[np.ndarray, "steps"]:
        """Whether 1 divided by the smallest magnitude is out of range (or a value is zero)."""
        return (self.zeros > 0) | (self.smallest < 1.0 / self.format.largest)

    def first(self, what: str) -> int:
        """First step with a value that is "not finite", "subnormal" or "out of range"; -1: none."""
        flags = {
            "not finite": self.not_finite > 0,
            "subnormal": self.subnormal > 0,
            "out of range": self.headroom < 0,
        }[what]
        return int(np.argmax(flags)) if flags.any() else -1

    def findings(self) -> tuple[str, ...]:
        """What is wrong, a sentence each; empty where nothing is."""
        said = []
        here = f"{self.name} in {self.format.name}"
        if (step := self.first("not finite")) >= 0:
            said.append(f"{here} is not finite at step {step}")
        if (step := self.first("out of range")) >= 0:
            size = self.largest[step]
            said.append(f"{here} reaches {size:.3g} at step {step}, above {self.format.largest:.3g}")
        if (step := self.first("subnormal")) >= 0:
            size = self.smallest[step]
            limit = self.format.smallest_normal
            said.append(f"{here} is {size:.3g} at step {step}, below {limit:.3g}: digits are lost")
        if self.denominator and self.reciprocal_overflows.any():
            step = int(np.argmax(self.reciprocal_overflows))
            said.append(f"{here} is divided by and is too near zero at step {step}")
        return tuple(said)


COLUMNS = ("quantity", "lowest", "highest", "smallest magnitude", "headroom", "subnormal", "not finite")


@dataclass(frozen=True)
class RangeReport:
    """The ranges of all quantities of a run.

    Attributes:
        ranges: by name.
    """

    ranges: Mapping[str, Range]

    def findings(self) -> tuple[str, ...]:
        """What is wrong anywhere."""
        return tuple(said for one in self.ranges.values() for said in one.findings())

    def table(self) -> tuple[tuple, ...]:
        """One row per quantity, over all steps, under COLUMNS."""
        return tuple(
            (
                name,
                float(np.nanmin(r.low)),
                float(np.nanmax(r.high)),
                float(np.min(r.smallest)),
                float(np.min(r.headroom)),
                int(r.subnormal.sum()),
                int(r.not_finite.sum()),
            )
            for name, r in self.ranges.items()
        )


def measure(
    name: str, values: Float[np.ndarray, "steps *rest"], format: str, denominator: bool = False
) -> Range:
    """The range of one quantity.

    Args:
        name: for the findings.
        values: recorded by step, in any dtype wide enough to hold them (a float64 run can be held against
            float16: would it have fitted?).
        format: one of `formats.FORMATS`.
        denominator: whether something is divided by it.
    """
    form = get(format)
    flat = np.asarray(values, np.float64).reshape(len(values), -1)
    finite = np.isfinite(flat)
    size = np.abs(flat)
    nonzero = finite & (flat != 0)
    low = np.min(np.where(finite, flat, np.inf), axis=1)
    high = np.max(np.where(finite, flat, -np.inf), axis=1)
    none = ~finite.any(axis=1)
    return Range(
        name,
        form,
        denominator,
        np.where(none, np.nan, low),
        np.where(none, np.nan, high),
        np.min(np.where(nonzero, size, np.inf), axis=1),
        np.max(np.where(finite, size, 0.0), axis=1),
        (flat == 0).sum(axis=1),
        (nonzero & (size < form.smallest_normal)).sum(axis=1),
        (~finite).sum(axis=1),
    )


def check_ranges(
    quantities: Mapping[str, Float[np.ndarray, "steps ..."]], format: str, denominators: tuple[str, ...] = ()
) -> RangeReport:
    """The ranges of several quantities that were recorded by step, against the limits of one format.

    Raises:
        InputError: no format of that name.
    """
    return RangeReport(
        {
            name: measure(name, np.asarray(values), format, name in denominators)
            for name, values in quantities.items()
        }
    )
