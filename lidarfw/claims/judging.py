"""Verdicts: does the difference between two runs hold over seeds and over the frames that they were measured on?"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from lidarfw.claims.reading import Claim
from lidarfw.errors import ConfigError
from lidarfw.registry import did_you_mean
from lidarfw.resampling import draws, interval

Array = npt.NDArray[np.float64]

SUPPORTED, NEUTRAL, CONTRADICTED, UNDECIDED = "supported", "neutral", "contradicted", "undecided"
MEANING = {
    SUPPORTED: "the interval lies on the claimed side of 0, and so do at least two thirds of the seeds",
    CONTRADICTED: "the interval lies on the other side of 0",
    NEUTRAL: "the interval lies within the margin around 0: whatever effect there is, it is small",
    UNDECIDED: "the interval holds 0 and reaches beyond the margin, or all figures are 0: these runs cannot tell",
}


@dataclass(frozen=True)
class Outcome:
    """What came out for a claim. Differences are variant less baseline, in the metric's unit."""

    verdict: str
    baseline: float  # mean over seeds
    variant: float
    difference: float
    low: float
    high: float
    per_seed: dict[int, float]  # difference of each seed; unpaired: from the baseline's mean
    margin: float

    @property
    def seeds(self) -> int:
        """How many seeds it rests on."""
        return len(self.per_seed)


def judge(claim: Claim, baseline: Mapping[int, Mapping[str, Any]] | float, variant: Mapping[int, Any]) -> Outcome:
    """The verdict on a claim.

    `baseline` and `variant` are what `lidarfw eval --frames` wrote, by seed; the same seeds where paired. One bootstrap
    sample draws the seeds, and within each the frames (in blocks) or sequences, with replacement: paired, the same for
    both runs, else independently. The interval is the middle 90 % of the differences of the means over seeds.
    """
    ours, resampled = _figures(claim, claim.variant.name, variant), _resampled(claim, variant)
    if isinstance(baseline, float):
        theirs, other = np.full(len(ours), baseline), np.full(resampled.shape, baseline)
    else:
        _check_pairs(claim, baseline, variant)
        theirs = _figures(claim, claim.runs[0].name, baseline)
        other = _resampled(claim, baseline)
    low, high = interval(_differences(claim, other, resampled))
    mean = float(theirs.mean())
    per_seed = ours - (theirs if claim.paired else mean)
    sign, margin = (1 if claim.better == "higher" else -1), claim.margin_of(mean)
    worst, best = sorted((sign * low, sign * high))
    measured = bool(
        np.any(ours) or np.any(theirs)
    )  # a figure that is 0 in all runs, as of a detector that finds nothing
    verdict = _verdict(worst, best, sign * per_seed, margin) if measured else UNDECIDED
    by_seed = dict(zip(variant, per_seed.tolist(), strict=True))
    return Outcome(verdict, mean, float(ours.mean()), float(ours.mean() - mean), low, high, by_seed, margin)


def _verdict(low: float, high: float, per_seed: Array, margin: float) -> str:
    """`low`, `high` and the differences of single seeds count towards the claim where they are positive."""
    if low > 0 and 3 * int((per_seed > 0).sum()) >= 2 * len(per_seed):
        return SUPPORTED
    if high < 0:
        return CONTRADICTED
    return NEUTRAL if low >= -margin and high <= margin else UNDECIDED


def _differences(claim: Claim, baseline: Array, variant: Array) -> Array:
    """(R,) of the bootstrap samples, from values (S, R) of each seed on each sample of frames."""
    count = variant.shape[1]
    seeds = draws(len(variant), count, stream=1)  # (R, S)
    sample = np.arange(count)[:, None]
    ours = variant[seeds, sample]
    if claim.paired:
        return _mean(ours - baseline[seeds, sample])
    # the next sample of frames for the other run: both lists of samples are the same where the frames are
    others = draws(len(baseline), count, stream=2)
    return _mean(ours) - _mean(baseline[others, (sample + 1) % count])


def _mean(values: Array) -> Array:
    """(R,) over the last axis; NaN where one value is (a sample without a single object, say)."""
    return np.asarray(values.mean(1), dtype=np.float64)


def _figures(claim: Claim, run: str, evaluated: Mapping[int, Mapping[str, Any]]) -> Array:
    found = []
    for content in evaluated.values():
        value = content["figures"].get(claim.metric)
        if value is None:
            raise ConfigError(_no_figure(claim, run, content["figures"]))
        found.append(value)
    return np.array(found, dtype=np.float64)


def _no_figure(claim: Claim, run: str, figures: Mapping[str, float | None]) -> str:
    there = [key for key, value in figures.items() if value is not None]
    known = "".join(f"\n    {key}" for key in there) or " none"
    state = "is not a finite number" if claim.metric in figures else "does not exist"
    near = did_you_mean(claim.metric, there)
    return f"claims.{claim.name}.metric: the figure {claim.metric!r} of run {run!r} {state}.\n  it has:{known}{near}"


def _resampled(claim: Claim, evaluated: Mapping[int, Mapping[str, Any]]) -> Array:
    return np.array([_values(claim, content) for content in evaluated.values()], dtype=np.float64)


def _values(claim: Claim, content: Mapping[str, Any]) -> Array:
    """(R,) values of the figure on bootstrap samples of one evaluation."""
    count = len(next(iter(content["resampled"].values()), ()))
    if claim.resample == "frames":
        return _floats(content["resampled"].get(claim.metric, [None] * count))
    if claim.resample == "seeds":
        return np.full(count, content["figures"][claim.metric], dtype=np.float64)
    each = _floats([found.get(claim.metric, [None])[0] for found in content["by_sequence"].values()])
    known = each[~np.isnan(each)]
    return np.asarray(known[draws(len(known), count)].mean(1)) if len(known) else np.full(count, math.nan)


def _floats(values: Sequence[float | None]) -> Array:
    return np.array([math.nan if value is None else value for value in values], dtype=np.float64)


def _check_pairs(claim: Claim, baseline: Mapping[int, Mapping[str, Any]], variant: Mapping[int, Any]) -> None:
    if not claim.paired:
        return
    for seed in variant:
        one, other = ([frame["id"] for frame in run[seed]["frames"]] for run in (baseline, variant))
        if one != other:
            first = next((i for i, (a, b) in enumerate(zip(one, other)) if a != b), min(len(one), len(other)))
            raise ConfigError(
                f"claims.{claim.name}: the runs were not evaluated on the same frames: {len(one)} and {len(other)}, "
                f"different from number {first} on.\n  fix: paired: false, or the same test split for both"
            )
