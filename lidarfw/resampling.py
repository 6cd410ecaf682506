"""What single frames add to the metrics of an evaluation, and how much the figures depend on the frames one has.

A metric's state after some frames is the sum, or the concatenation, of what each frame adds. So the figures of any
set of frames, of one sequence, or of a bootstrap sample follow exactly from what was recorded of each frame: average
precision is computed anew for every sample, not averaged over frames.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lidarfw.types import FrameMeta, FrameResult

if TYPE_CHECKING:
    from lidarfw.model import PerceptionModel

State = dict[str, Any]  # of a metric: its tensors and lists of tensors
Figures = dict[str, float]  # "metric/key"
LEVEL = 0.9  # of every interval


class FrameRecord:
    """What every frame adds to every metric of an evaluation; filled by `lidarfw.training.evaluate`."""

    def __init__(self) -> None:
        self.frames: list[FrameMeta] = []
        self._model: PerceptionModel | None = None
        self._metrics: dict[str, Any] = {}
        self._states: dict[str, list[State]] = {}

    def start(self, model: PerceptionModel) -> None:
        """Record the metrics of `model` from now on."""
        self._model, self.frames = model, []
        self._metrics = {name: copy.deepcopy(metric) for name, metric in model.metrics.items()}
        self._states = {name: [] for name in self._metrics}

    def add(self, results: Iterable[FrameResult]) -> None:
        """Take finished frames in."""
        if self._model is None:
            raise RuntimeError("FrameRecord.add comes after start")
        for result in results:
            self.frames.append(result.meta)
            for metric in self._metrics.values():
                metric.reset()
            self._model.update_metrics([result], self._metrics)
            for name, metric in self._metrics.items():
                self._states[name].append(_copy(metric.metric_state))

    def figures(self, rows: Sequence[int] | None = None) -> Figures:
        """Figures of some frames by their number, or of all; a frame may come more than once."""
        chosen = range(len(self.frames)) if rows is None else rows
        return self._figures({name: [states[row] for row in chosen] for name, states in self._states.items()})

    def _figures(self, states: Mapping[str, Sequence[State]]) -> Figures:
        found: Figures = {}
        for name, metric in self._metrics.items():
            found |= {f"{name}/{key}": float(value) for key, value in _compute(metric, states[name]).items()}
        return found

    def by_sequence(self) -> dict[str, Figures]:
        """Figures of every sequence by itself, compared with the reference if there is one."""
        rows: dict[str, list[int]] = {}
        reference = self._reference()
        for row in sorted(set(range(len(self.frames))) - set(reference)):
            rows.setdefault(self.frames[row].sequence, []).append(row)
        return {sequence: self.figures([*reference, *own]) for sequence, own in rows.items()}

    def by_frame(self) -> list[Figures]:
        """Figures of every frame by itself, compared with the reference if there is one."""
        base = self._base()
        return [
            self._figures({name: [*base[name], states[row]] for name, states in self._states.items()})
            for row in range(len(self.frames))
        ]

    def _reference(self) -> list[int]:
        """Numbers of the frames that others are compared with, such as those of a map."""
        metrics = self._metrics.values()
        return [row for row, frame in enumerate(self.frames) if any(metric.is_reference(frame) for metric in metrics)]

    def _base(self) -> dict[str, list[State]]:
        """What the reference adds to each metric, in one state; nothing where there is none."""
        rows = self._reference()
        return {
            name: [_joined(metric, [self._states[name][row] for row in rows])] if rows else []
            for name, metric in self._metrics.items()
        }

    def _blocks(self, length: int) -> list[list[int]]:
        """Numbers of the frames that are drawn, in blocks."""
        drawn = sorted(set(range(len(self.frames))) - set(self._reference()))
        return [[drawn[place] for place in run] for run in blocks([self.frames[row] for row in drawn], length)]

    def resampled(self, count: int, block: int) -> list[Figures]:
        """Figures of `count` bootstrap samples of the frames.

        A sample draws, with replacement, as many blocks as there are; a block is `block` consecutive frames of one
        sequence, since neighbouring frames err alike. The draws depend on the number of blocks alone, so that samples
        of two models on the same frames pair up. Frames that others are compared with are in every sample.
        """
        runs, base = self._blocks(block), self._base()
        joined = {
            name: [_joined(metric, [self._states[name][row] for row in run]) for run in runs]
            for name, metric in self._metrics.items()
        }
        return [
            self._figures({name: [*base[name], *(states[place] for place in drawn)] for name, states in joined.items()})
            for drawn in draws(len(runs), count)
        ]

    def to_plain(self, count: int, block: int) -> dict[str, Any]:
        """All of it for a JSON file: figures by key, None where a set of frames has no such figure."""
        return {
            "figures": {key: _finite(value) for key, value in self.figures().items()},
            "frames": [{"id": frame.id, "sequence": frame.sequence} for frame in self.frames],
            "by_frame": _columns(self.by_frame()),
            "by_sequence": {name: _columns([found]) for name, found in self.by_sequence().items()},
            "block": block,
            "blocks": len(self._blocks(block)),
            "resampled": _columns(self.resampled(count, block)),
        }


def blocks(frames: Sequence[FrameMeta], length: int) -> list[list[int]]:
    """Numbers of the frames in runs of at most `length` consecutive ones of one sequence."""
    found: list[list[int]] = []
    for row, frame in enumerate(frames):
        if not found or len(found[-1]) == length or frames[found[-1][-1]].sequence != frame.sequence:
            found.append([])
        found[-1].append(row)
    return found


def draws(size: int, count: int, stream: int = 0) -> npt.NDArray[np.int64]:
    """(count, size) numbers below `size`, drawn with replacement; the same in every call, others in each `stream`."""
    generator = np.random.default_rng((size, count, stream))
    return generator.integers(max(size, 1), size=(count, size))


def interval(values: Sequence[float] | npt.NDArray[np.float64], level: float = LEVEL) -> tuple[float, float]:
    """The middle `level` of the values, NaN left out; (NaN, NaN) without any."""
    known = np.asarray(values, dtype=np.float64)
    known = known[~np.isnan(known)]
    if not len(known):
        return math.nan, math.nan
    low, high = np.quantile(known, [(1 - level) / 2, (1 + level) / 2])
    return float(low), float(high)


def _copy(state: Mapping[str, Any]) -> State:
    """A copy that a later reset of the metric, which empties its lists, leaves alone."""
    return {name: list(value) if isinstance(value, list) else value.clone() for name, value in state.items()}


def _joined(metric: Any, states: Sequence[State]) -> State:
    metric.reset()
    for state in states:
        metric.merge_state(state)
    return _copy(metric.metric_state)


def _compute(metric: Any, states: Sequence[State]) -> dict[str, Any]:
    _joined(metric, states)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torchmetrics: compute before update
        return dict(metric.compute())


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _columns(rows: Sequence[Figures]) -> dict[str, list[float | None]]:
    keys = dict.fromkeys(key for row in rows for key in row)
    return {key: [_finite(row.get(key)) for row in rows] for key in keys}
