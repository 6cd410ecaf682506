"""How probable it is that the box of a track is right: features of what was seen so far, and a small learned network.

Everything here is causal: a feature looks at this frame and earlier ones only. Scores of a detector enter as
log-odds that its box is right, so another detector needs two numbers per class (`calibration`), not other weights.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt
from lidarfw.components.per_class import check_names
from lidarfw.errors import ConfigError, DataError
from lidarfw.kitti import read_text

from lidarfw_time3d.kalman import Array, Table

Bool = npt.NDArray[np.bool_]

UNSEEN = -6.0  # log-odds that stand for a detection that is not there
_ALONE = -8.0  # and for a neighbour that is not there
_DECAY = 0.8  # of the evidence, per frame
_OFF_DECAY = 0.7  # of the mean distance between prediction and detection
_EDGE = (-0.2, 0.3)  # radians from the border of the view beyond which all is alike
GENERAL = (
    "score", "seen", "missed", "hits", "age", "mean", "best", "evidence", "last", "off", "mean_off", "rival_same",
    "rival_other", "begin", "gap", "hit_rate", "second",
)  # fmt: skip
PLACE = ("range", "edge", "covered", "covered_sum", "length", "width", "height")
FEATURES = (*GENERAL, *PLACE)


@dataclass
class Evidence(Table):
    """What speaks for each of T tracks; scores are log-odds."""

    hits: Array  # (T,) detections
    age: Array  # (T,) frames since the first one, that included
    missed: Array  # (T,) frames since the last one
    gap: Array  # (T,) frames that were missed before it
    total: Array  # (T,) summed scores
    best: Array  # (T,) highest score
    second: Array  # (T,) second highest
    last: Array  # (T,) score of the last detection
    recent: Array  # (T,) decayed mean of the scores, missed frames counted as UNSEEN + 2
    off: Array  # (T,) distance between prediction and detection now, as a share of the gate; 0 where unseen
    mean_off: Array  # (T,) decayed mean of it

    @classmethod
    def start(cls, score: Array) -> Evidence:
        """New tracks from detections of these scores (N,)."""
        zero, one = np.zeros(len(score)), np.ones(len(score))
        recent = (1 - _DECAY) * score + _DECAY * (UNSEEN + 2)
        return cls(one, one.copy(), zero, zero.copy(), score, score.copy(), zero + UNSEEN, score.copy(), recent,
                   zero.copy(), zero.copy())  # fmt: skip

    def wait(self) -> None:
        """A frame later, nothing seen yet."""
        self.age += 1
        self.missed += 1
        self.off[:] = 0
        self.recent = _DECAY * self.recent + (1 - _DECAY) * (UNSEEN + 2)

    def see(self, rows: npt.NDArray[np.int64], score: Array, off: Array) -> None:
        """The detections of tracks `rows` (N,) in this frame."""
        best = self.best[rows]
        self.second[rows] = np.maximum(self.second[rows], np.minimum(best, score))
        self.best[rows] = np.maximum(best, score)
        self.gap[rows], self.missed[rows], self.last[rows] = self.missed[rows], 0, score
        self.hits[rows] += 1
        self.total[rows] += score
        self.recent[rows] += (1 - _DECAY) * (score - UNSEEN - 2)
        self.off[rows] = off
        self.mean_off[rows] = _OFF_DECAY * self.mean_off[rows] + (1 - _OFF_DECAY) * off


def features(evidence: Evidence, box: Array, label: npt.NDArray[np.int64], frames: int, view: float) -> Array:
    """(T, 24) FEATURES of the tracks, in their order.

    Args:
        evidence: of the tracks, this frame included.
        box: (T, 7) x, y, z, yaw, l, w, h in the sensor frame.
        label: (T,).
        frames: seen so far in the sequence.
        view: field of view, radians about the forward axis.
    """
    seen, e = evidence.missed == 0, evidence
    columns = [
        np.where(seen, e.last, UNSEEN), seen, np.log1p(e.missed), np.log(e.hits), np.log(e.age), e.total / e.hits,
        e.best, e.recent, e.last, e.off, e.mean_off, *_rivals(e, box, label, seen),
        np.full(len(label), min(frames - 1, 10) / 5), np.where(seen, e.gap, 0), e.hits / e.age, e.second,
    ]  # fmt: skip
    distance, bearing = np.hypot(box[:, 0], box[:, 1]), np.arctan2(box[:, 1], box[:, 0])
    edge = np.clip(view / 2 - np.abs(bearing), *_EDGE)
    columns += [np.log1p(distance), 5 * edge, *_covered(e, box, distance, bearing), *np.log(box[:, 4:7]).T]
    return np.stack(columns, 1).astype(np.float64)


def _rivals(evidence: Evidence, box: Array, label: npt.NDArray[np.int64], seen: Bool) -> tuple[Array, Array]:
    """(T,) score of the best other track at about the same place, of the same class and of another."""
    apart = (box[:, None, 0] - box[:, 0]) ** 2 + (box[:, None, 1] - box[:, 1]) ** 2
    near = apart < np.maximum(box[:, 4] / 2, 0.6)[:, None] ** 2
    np.fill_diagonal(near, False)
    score = np.where(near, np.where(seen, evidence.last, evidence.last - 2), _ALONE)
    same = label[:, None] == label
    best, other = (np.where(kind, score, _ALONE).max(1, initial=_ALONE) for kind in (same, ~same))
    return best, other


def _covered(evidence: Evidence, box: Array, distance: Array, bearing: Array) -> tuple[Array, Array]:
    """(T,) largest and summed share of each box's angle that nearer, probable boxes cover."""
    turn = box[:, 3] - bearing
    width = np.maximum(np.abs(box[:, 4] * np.sin(turn)), np.abs(box[:, 5] * np.cos(turn)))
    half = np.arctan2(width / 2, distance) + 1e-9
    low, high = bearing - half, bearing + half
    common = np.minimum(high[:, None], high) - np.maximum(low[:, None], low)
    hides = (distance + 0.5 < distance[:, None]) & (evidence.missed == 0) & (evidence.last > 0)
    share = np.where(hides, np.clip(common / (2 * half[:, None]), 0, 1), 0)
    return share.max(1, initial=0), np.minimum(share.sum(1), 2)


@dataclass
class Network:
    """A few small multi-layer perceptrons over the same features; their answers are averaged."""

    columns: npt.NDArray[np.int64]  # (F,) places in FEATURES
    layers: list[tuple[Array, Array]]  # weight (S, in, out) and bias (S, 1, out) of each layer, S networks

    def probability(self, values: Array) -> Array:
        """(T,) of features (T, 24)."""
        hidden: Array = values[:, self.columns][None]
        for weight, bias in self.layers[:-1]:
            hidden = np.maximum(hidden @ weight + bias, 0)
        weight, bias = self.layers[-1]
        mean: Array = (1 / (1 + np.exp(-np.clip(hidden @ weight + bias, -30, 30)))).mean(0)[:, 0]
        return mean


@dataclass
class Confidence:
    """The learned confidence: a network for every class, and special ones for those with much to learn from."""

    general: Network
    special: dict[str, Network]  # by class name in lower case

    @classmethod
    def load(cls, path: str = "", special: bool = True) -> Confidence:
        """Read the weights that this distribution ships, or those at `path`; DataError where they are broken.

        Without `special` all classes have the general network.
        """
        text = read_text(path) if path else (files("lidarfw_time3d") / "weights.json").read_text(encoding="utf-8")
        try:
            plain = json.loads(text)
            networks = {name: _network(node) for name, node in plain["special"].items()}
            return cls(_network(plain["general"]), networks if special else {})
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise DataError(
                f"{path or 'weights.json'}: is no file of `python -m lidarfw_time3d.fit`: {error!r}"
            ) from error

    def probability(self, values: Array, label: npt.NDArray[np.int64], classes: Sequence[str]) -> Array:
        """(T,) that the box of each track is right, from its features (T, 24) and class."""
        result = self.general.probability(values)
        for name, network in self.special.items():
            own = [number for number, known in enumerate(classes) if known.lower() == name]
            rows = np.flatnonzero(np.isin(label, own))
            if len(rows):
                result[rows] = network.probability(values[rows])
        return result


def _network(plain: Any) -> Network:
    columns = np.array([FEATURES.index(name) for name in plain["features"]], dtype=np.int64)
    layers = [(np.array(layer["weight"]), np.array(layer["bias"])[:, None]) for layer in plain["layers"]]
    if layers[0][0].shape[1] != len(columns):
        raise ValueError(f"{len(columns)} features, but weights for {layers[0][0].shape[1]}")
    return Network(columns, layers)


def check_calibration(classes: Sequence[str], given: Mapping[str, Sequence[float]], option: str) -> None:
    """ConfigError where the option named `option` is not scale and offset, two numbers, of classes of the data."""
    check_names(classes, given, option)
    wrong = next((name for name, row in given.items() if len(row) != 2), None)
    if wrong is not None:
        raise ConfigError(
            f"{option} of {wrong} is {list(given[wrong])}, expected scale and offset of the scores\n"
            f"  fix: calibration={{{wrong}: [1.0, 0.0]}}, or the two numbers of `python -m lidarfw_time3d.fit`"
        )


def log_odds(score: Array, label: npt.NDArray[np.int64], calibration: Array | None) -> Array:
    """(N,) log-odds that boxes are right, from their scores.

    With `calibration` (K, 2), scale and offset per class: scale * score + offset, for raw scores. Without, scores
    are probabilities, cut at 0.001 and 0.999; DataError where they cannot be.
    """
    if calibration is not None:
        scaled: Array = calibration[label, 0] * score + calibration[label, 1]
        return scaled
    if len(score) and not (score.min() >= 0 and score.max() <= 1):
        raise DataError(
            f"scores from {score.min():.3g} to {score.max():.3g} are no probabilities.\n"
            "  fix: tracker.kalman_confidence.calibration={CLASS: [scale, offset], ...}, as fitted by\n"
            "       `python -m lidarfw_time3d.fit`; for PointRCNN's: tracker=kalman_confidence_pointrcnn"
        )
    chance = np.clip(score, 1e-3, 1 - 1e-3)
    odds: Array = np.log(chance / (1 - chance))
    return odds
