"""Sampling and rounding can flip the same decision: how many samples distinguish them?"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from mdnum.numerics import Threshold
from mdnum.verbs.demos import Claim, Demo, Plot, Series, table

#: Mean residual of a rough floor, uniform from 0 to twice that, and the tolerance that it is compared with.
MEAN, TOL, PAIRS, SAMPLES = 1.01e-3, 1e-3, 1000, (16, 64, 256, 1024, 4096)
RULE = Threshold(TOL, "<", "residual")


def residuals(seed: int, count: int) -> Float[np.ndarray, "repeats samples"]:
    """Return float16 penetrations of a rough floor at random places, with one key per repeat."""
    random = np.random.default_rng((seed, count))
    return random.uniform(0, 2 * MEAN, (PAIRS, count)).astype(np.float16)


def mean(samples: np.ndarray) -> Float[np.ndarray, "repeats"]:
    """Return means by a running sum in float16, in the order of the samples, with exact division."""
    # numpy rounds every partial sum of accumulate to float16
    return np.add.accumulate(samples, axis=1)[:, -1].astype(float) / samples.shape[1]


def exact(samples: np.ndarray) -> Float[np.ndarray, "repeats"]:
    """Return the means of the same samples without rounding, because float64 sums float16 numbers exactly."""
    return samples.astype(float).sum(axis=1) / samples.shape[1]


def run() -> Demo:
    """Compare runs with another random key, another order or both, and determine the cause of each flip."""
    rows = []
    for count in SAMPLES:
        a, b, other = residuals(1, count), residuals(2, count), np.random.default_rng(count)
        turned = a[:, other.permutation(count)], b[:, other.permutation(count)]
        first, order, key, both = (RULE.decide(mean(one)) for one in (a, turned[0], b, turned[1]))
        flips = first != both
        due = [
            int(np.sum(flips & one))
            for one in (
                (first != key) & (first == order),
                (first == key) & (first != order),
                (first != key) == (first != order),
            )
        ]
        sampling, error = float(np.std(exact(a))), mean(a) - exact(a)
        rows.append(
            (
                count,
                int(np.sum(first != order)),
                int(np.sum(first != key)),
                int(np.sum(flips)),
                *due,
                sampling,
                float(np.sqrt(np.mean(error**2))),
                float(np.mean(first)),
            )
        )
    by_order, by_key = ([row[k] for row in rows] for k in (1, 2))
    sampling, rounding, stopped = (np.array([row[k] for row in rows]) for k in (7, 8, 9))
    # uniform numbers from 0 to 2 m scatter by m / sqrt(3): so many put the margin at three errors
    needed = round((3 * MEAN / np.sqrt(3) / (MEAN - TOL)) ** 2)
    crossing = SAMPLES[int(np.argmax(rounding > sampling))]
    return Demo(
        title="Sampling or rounding: which changed the decision?",
        question=(
"A residual is the mean of random samples, summed in float16. What changes the stopping "
"decision?"
),
        result=(
f"With 1024 samples, another random key changes {by_key[3]} of {PAIRS} decisions, and "
f"another order of the sum changes {by_order[3]}. With {crossing} samples rounding is the "
"larger error: every run stops, with a wrong result."
),
        answer=f"Make two more runs, in each of which only the key or only the order is changed; the "
        f"run with the flip identifies the cause. The sampling error decreases as one over the square "
        f"root of the number of samples: {needed:,} samples put the margin of "
        f"{MEAN - TOL:.0e} three standard errors away. The rounding error grows with the number of "
        f"samples, because small terms are lost when they are added to a large running sum. No number "
        f"of float16 samples gives the correct decision.",
        numbers={
            "flips_by_order": by_order, "flips_by_key": by_key, "rounding_exceeds_sampling_at": crossing,
            "samples_needed": needed, "sampling": sampling.tolist(), "rounding": rounding.tolist(),
            "stopped": stopped.tolist(),
        },
        checks=[
            Claim("the sampling error decreases as the square root of the number",
                  float(sampling[0] / sampling[-1]), "16 ± 1",
                  bool(abs(sampling[0] / sampling[-1] - 16) < 1)),
            Claim("with few samples nearly every flip is caused by the key", by_order[0], "below 1 %",
                  by_order[0] < 0.01 * PAIRS),
            Claim("with many samples all runs agree and are wrong", float(stopped[-1]), "1",
                  bool(stopped[-1] == 1)),
        ],
        tables=[table(f"of {PAIRS} pairs of runs", (
            "samples", "order flips", "key flips", "both flip", "by the key", "by the order", "by either "
            "or both",
            "sampling error", "rounding error", "share that stops"), rows)],
        plots=[Plot("errors", "Error of the residual over the number of samples", "samples", "error (m)", (
            Series("sampling", np.array(SAMPLES, float), sampling, "line+points"),
            Series("rounding", np.array(SAMPLES, float), rounding, "line+points", "bad"),
        ), x_scale="log", y_scale="log", horizontals=((MEAN - TOL, "margin"),),
            caption="Beyond the crossing of the curves, more samples do not help.")],
        in_md=(
"The noise of a thermostat and the order of a force sum both change the step at which a "
"list is rebuilt; a run with the same noise and another order distinguishes them."
),
    )  # fmt: skip
