"""Learn the confidence of the tracker `kalman_confidence` from detections and labels of KITTI tracking.

    python -m lidarfw_time3d.fit DETECTIONS --labels label_02 --calib calib --poses poses -o weights.json
    python -m lidarfw_time3d.fit ... --folds 5           # cross-validated by sequence instead: what it brings
    python -m lidarfw_time3d.fit ... --folds 5 --parts   # and what every part of the tracker brings

The tracker runs over every sequence; each box of each track, detected or coasted, becomes a sample: its features,
and whether it is right (3D IoU of at least 0.25 with an object that no better box has). Boxes on ignored objects, and
those that the benchmark excuses, are left out. Calibrations (scale and offset of the detector's scores, per class)
are fitted first. Everything is determined by the seeds.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from lidarfw import detections, kitti
from lidarfw.cli import answered
from lidarfw.components.metrics.kitti_ap import share_covered
from lidarfw.components.metrics.mot3d import Mot3D
from lidarfw.detections import DetectedSequence, Detections
from lidarfw.errors import DataError
from lidarfw.files import write_text
from lidarfw.mot import best_pairs
from lidarfw.ops import iou_3d
from lidarfw.types import Boxes, Spec, Targets, Tracks
from rich.progress import track as progress
from scipy.optimize import minimize
from torch import Tensor, nn

from lidarfw_time3d.confidence import FEATURES, GENERAL, log_odds
from lidarfw_time3d.frames import array, rows_of, to_map, to_sensor
from lidarfw_time3d.kalman import Array
from lidarfw_time3d.kalman_confidence import KalmanConfidence

Bool = npt.NDArray[np.bool_]

SPECIAL = ("car",)  # classes with enough objects for a network of their own, with features of place and size
IOU = 0.25
_COASTED = 10.0  # a detected box goes before a coasted one where both could be the object's
_PRIOR = (0.9, -2.0)  # scale and offset of a calibration before any data
_STEPS, _BATCH, _HIDDEN, _SEEDS = 700, 4096, 24, 3


@dataclass
class Samples:
    """N boxes of tracks of one sequence."""

    features: Array  # (N, 24)
    label: npt.NDArray[np.int64]  # (N,)
    right: Bool  # (N,)
    counts: Bool  # (N,) neither ignored nor excused


@dataclass
class Labelled:
    """A sequence with what it should give."""

    sequence: DetectedSequence
    targets: list[Targets]  # per frame


def read(folder: Path, labels: Path, calib: Path, poses: Path | None, classes: Sequence[str]) -> list[Labelled]:
    """Every sequence that has labels; DataError where none has."""
    there = detections.kitti_sequences(folder)
    names = [name for name in there if (labels / f"{name}.txt").exists()]
    if not names:
        raise DataError(
            f"{labels}: has no labels of the sequences that have detections, {', '.join(there)}\n"
            "  fix: --labels FOLDER with SEQUENCE.txt of KITTI tracking, such as 0000.txt"
        )
    return [_labelled(detections.read_kitti(folder, n, classes, poses, calib), labels, calib, classes) for n in names]


def _labelled(sequence: DetectedSequence, labels: Path, calib: Path, classes: Sequence[str]) -> Labelled:
    upright = detections.upright(kitti.read_calibration(calib / f"{sequence.name}.txt"))
    frames: dict[int, list[kitti.TrackLabel]] = {}
    for line in kitti.read_tracks(labels / f"{sequence.name}.txt"):
        frames.setdefault(line.frame, []).append(kitti.as_object(line))
    return Labelled(sequence, [_targets(frames.get(f.meta.index, []), upright, classes) for f in sequence.frames])


def _targets(lines: list[kitti.TrackLabel], upright: kitti.Calibration, classes: Sequence[str]) -> Targets:
    known = [line.label for line in lines]
    boxes, ignored = kitti.boxes_from_labels(known, upright, classes)
    ids = torch.tensor([line.id for line in lines], dtype=torch.long)
    assert boxes.row is not None
    return Targets(boxes=boxes, ignored=ignored, tracks=Tracks(boxes, ids[boxes.row]))


def judge(found: Boxes, coasted: Bool, targets: Targets, frame: Detections) -> tuple[Bool, Bool]:
    """(M,) whether each box is right, and whether it counts, by the rules of KITTI tracking."""
    boxes, ignored = targets.boxes, targets.ignored
    assert boxes is not None
    assert ignored is not None
    objects = Boxes.cat([boxes, ignored[ignored.label >= 0]])
    beyond = np.ones(len(objects), dtype=bool)
    assert boxes.occlusion is not None
    assert boxes.truncation is not None
    beyond[: len(boxes)] = ((boxes.occlusion > 2) | (boxes.truncation > 0)).numpy()
    iou = array(iou_3d(found.tensor, objects.tensor)) * (found.label[:, None] == objects.label).numpy()
    box, thing = (iou >= IOU).nonzero()
    chosen = best_pairs(thing, box, 1000 + iou[box, thing] + _COASTED * ~coasted[box])
    right, counts = np.zeros(len(found), dtype=bool), ~_excused(found, ignored, frame)
    right[box[chosen]] = True
    counts[box[chosen]] = ~beyond[thing[chosen]]
    return right, counts


def _excused(found: Boxes, ignored: Boxes, frame: Detections) -> Bool:
    level = kitti.level_boxes(found, frame.meta.cameras)
    rectangle = kitti.project_level_boxes(level, frame.meta.cameras)
    regions = ignored[ignored.label < 0].box2d
    covered = share_covered(rectangle, np.zeros((0, 4)) if regions is None else array(regions))
    low: Bool = (rectangle[:, 3] - rectangle[:, 1] <= 25) | (covered > 0.5)
    return low


def calibrate(data: Sequence[Labelled], classes: Sequence[str]) -> dict[str, list[float]]:
    """Scale and offset by class that make the detector's scores log-odds of being right (Platt, 1999).

    Boxes of an object in successive frames are much alike, so ten count as one against the prior.
    """
    frames = [pair for entry in data for pair in zip(entry.sequence.frames, entry.targets, strict=True)]
    verdicts = [judge(f.boxes, np.zeros(len(f.boxes), dtype=bool), t, f) for f, t in frames]
    found = Boxes.cat([frame.boxes for frame, _ in frames])
    right, counts = (np.concatenate(column) for column in zip(*verdicts, strict=True))
    return {name: _platt(array(found.score), right, counts & (found.label.numpy() == number))
            for number, name in enumerate(classes)}  # fmt: skip


def _platt(score: Array, right: Bool, used: Bool) -> list[float]:
    x, sign = score[used], np.where(right[used], 1.0, -1.0)
    prior = np.array(_PRIOR)

    def cost(line: Array) -> float:
        off = (line - prior) ** 2
        return float(0.1 * np.logaddexp(0, -sign * (line[0] * x + line[1])).sum() + 3 * off[0] + 0.3 * off[1])

    return [round(float(value), 3) for value in minimize(cost, prior).x]


def record(entry: Labelled, tracker: KalmanConfidence) -> Samples:
    """Every box of every track, for as long as the tracker may keep it."""
    state, frames = tracker.start(), []
    for frame, targets in zip(entry.sequence.frames, entry.targets, strict=True):
        if frame.pose is not None:
            state.pose = array(frame.pose.matrix[0])
        label = frame.boxes.label.numpy()
        score = log_odds(array(frame.boxes.score), label, tracker.calibration)
        tracker.advance(state, to_map(rows_of(frame.boxes), state.pose), label, score, tracker.frame_time)
        alive = state.evidence.missed < tracker.max_age
        state.motion, state.evidence = state.motion.take(alive), state.evidence.take(alive)
        state.label, state.id = state.label[alive], state.id[alive]
        box = to_sensor(state.motion.box, state.pose)
        found = detections.boxes_of(box[:, [0, 1, 2, 4, 5, 6, 3]], state.label.tolist(), np.ones(len(box)).tolist())
        right, counts = judge(found, state.evidence.missed > 0, targets, frame)
        frames.append((tracker.features(state, box), state.label, right, counts))
    return Samples(*(np.concatenate(column) for column in zip(*frames, strict=True)))


class Ensemble(nn.Module):
    """Small networks side by side, each (F, 24, 24, 1) with its own start and its own batches."""

    def __init__(self, values: Tensor, count: int) -> None:
        super().__init__()
        sizes = (values.shape[1], _HIDDEN, _HIDDEN, 1)
        self.mean, self.scale = values.mean(0), values.std(0) + 1e-3
        self.weights = nn.ParameterList(torch.empty(count, a, b) for a, b in itertools.pairwise(sizes))
        self.biases = nn.ParameterList(torch.zeros(count, 1, b) for b in sizes[1:])
        for weight in self.weights:
            nn.init.uniform_(weight, -(weight.shape[1] ** -0.5), weight.shape[1] ** -0.5)

    def forward(self, values: Tensor) -> Tensor:
        """(S, N) log-odds of features (S, N, F)."""
        hidden = (values - self.mean) / self.scale
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            hidden = (hidden @ weight + bias).relu()
        odds: Tensor = (hidden @ self.weights[-1] + self.biases[-1])[..., 0]
        return odds

    def plain(self, names: Sequence[str]) -> dict[str, Any]:
        """Weights as lists, the normalisation of the features folded into the first layer."""
        weights = [weight.detach().double() for weight in self.weights]
        biases = [bias.detach().double()[:, 0] for bias in self.biases]
        weights[0] = weights[0] / self.scale.double()[:, None]
        biases[0] = biases[0] - (self.mean.double() @ weights[0])
        layers = [{"weight": _rounded(w), "bias": _rounded(b)} for w, b in zip(weights, biases, strict=True)]
        return {"features": list(names), "layers": layers}


def _rounded(tensor: Tensor) -> Any:
    return tensor.mul(1e4).round().div(1e4).tolist()


def train(samples: Sequence[Samples], names: Sequence[str], weight: Sequence[float], seed: int = 0) -> dict[str, Any]:
    """Networks over the named features; `weight` says how much a sample of each class counts."""
    generator = torch.Generator().manual_seed(seed)
    columns = [FEATURES.index(name) for name in names]
    values = torch.from_numpy(np.concatenate([s.features[:, columns] for s in samples])).float()
    right = torch.from_numpy(np.concatenate([s.right for s in samples])).float()
    share = torch.from_numpy(np.concatenate([s.counts * np.array(weight)[s.label] for s in samples])).float()
    used = share > 0
    values, right, share = values[used], right[used], share[used]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = Ensemble(values, _SEEDS)
    optimizer = torch.optim.AdamW(model.parameters(), 4e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, _STEPS)
    for _ in range(_STEPS):
        rows = torch.randint(len(values), (_SEEDS, _BATCH), generator=generator)
        error = nn.functional.binary_cross_entropy_with_logits(model(values[rows]), right[rows], reduction="none")
        loss = ((error * share[rows]).sum(1) / share[rows].sum(1)).sum()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return model.plain(names)


def fit(data: Sequence[Labelled], classes: Sequence[str], view: float, **options: Any) -> dict[str, Any]:
    """Calibration and networks from labelled sequences, as they are written to a file of weights."""
    calibration = calibrate(data, classes)
    tracker = make_tracker(classes, view, calibration, **options)
    samples = [record(entry, tracker) for entry in data]
    # few objects of the rarer classes: each of their boxes counts more
    general = train(samples, GENERAL, [1.0 if name.lower() in SPECIAL else 5.0 for name in classes])
    special = {
        name.lower(): train(samples, FEATURES, [1.0 if other == name else 0.05 for other in classes])
        for name in classes
        if name.lower() in SPECIAL
    }
    return {"calibration": calibration, "general": general, "special": special}


def make_tracker(
    classes: Sequence[str], view: float, calibration: dict[str, list[float]], **options: Any
) -> KalmanConfidence:
    """The tracker with the gates of the preset for KITTI."""
    from lidarfw.config import compose, to_plain

    preset = to_plain(compose(["tracker=kalman_confidence_pointrcnn"]))["tracker"]["kalman_confidence"]
    gate = {name: value for name, value in preset["gate"].items() if name in classes}
    given = {name: value for name, value in preset.items() if name not in ("type", "inputs")}
    chosen = {**given, "gate": gate, "calibration": calibration, "field_of_view": view, **options}
    return KalmanConfidence(Spec(Boxes, classes=tuple(classes)), **chosen)


@dataclass(frozen=True)
class Variant:
    """A tracker to compare: with other options, without poses (but weights that were learned with them), or with a
    rule in place of the learned confidence."""

    options: Mapping[str, Any] = field(default_factory=dict)
    posed: bool = True
    rule: bool = False


VARIANTS = {
    "all parts": Variant(),
    "without coasted boxes": Variant({"min_unseen": 2.0}),
    "without poses": Variant(posed=False),
    "without features of place": Variant({"place_features": False}),
    "a rule instead of the confidence": Variant(rule=True),
    "a rule, without coasted boxes": Variant({"min_unseen": 2.0}, rule=True),
    "a rule, without poses": Variant(posed=False, rule=True),
}


class HitRule:
    """What trackers usually do: a track is shown from three hits on and for two frames unseen, with its mean score."""

    _MEAN, _HITS, _MISSED, _BEGIN = (FEATURES.index(name) for name in ("mean", "hits", "missed", "begin"))

    def probability(self, values: Array, label: Array, classes: Sequence[str]) -> Array:
        """(T,) as of `confidence.Confidence`."""
        hits, missed = np.exp(values[:, self._HITS]), np.expm1(values[:, self._MISSED])
        enough = hits > np.minimum(5 * values[:, self._BEGIN], 2) + 0.5  # fewer in the first frames of a sequence
        shown: Array = (enough & (missed < 2.5)) / (1 + np.exp(-values[:, self._MEAN]))
        return shown


def cross_validate(
    data: Sequence[Labelled], classes: Sequence[str], view: float, folds: int, variants: Mapping[str, Variant]
) -> dict[str, dict[str, dict[str, float]]]:
    """Figures by variant and rules ("devkit", "clean") on all sequences.

    Every sequence is tracked with calibration and weights that have not seen it.
    """
    made = {name: {rules: Mot3D(Spec(Tracks, classes=tuple(classes)), default_iou=IOU, rules=rules)
                   for rules in ("devkit", "clean")} for name in variants}  # fmt: skip
    for number in progress(range(folds), "folds"):
        learnt = fit([entry for place, entry in enumerate(data) if place % folds != number], classes, view)
        for name, variant in variants.items():
            tracker = _tracker_of(variant, learnt, classes, view)
            for entry in data[number::folds]:
                _count(entry if variant.posed else _without_poses(entry), tracker, made[name])
    return {name: {rules: {key: float(value) for key, value in metric.compute().items()}
                   for rules, metric in metrics.items()} for name, metrics in made.items()}  # fmt: skip


def _without_poses(entry: Labelled) -> Labelled:
    frames = [replace(frame, pose=None) for frame in entry.sequence.frames]
    return Labelled(replace(entry.sequence, frames=frames), entry.targets)


def _tracker_of(variant: Variant, learnt: dict[str, Any], classes: Sequence[str], view: float) -> KalmanConfidence:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "weights.json"
        write_text(path, json.dumps(learnt))
        tracker = make_tracker(classes, view, learnt["calibration"], weights=str(path), **variant.options)
    if variant.rule:
        tracker.confidence = HitRule()  # type: ignore[assignment]
    return tracker


def _count(entry: Labelled, tracker: KalmanConfidence, metrics: dict[str, Mot3D]) -> None:
    frames = list(detections.run(tracker, entry.sequence))
    mean = detections.mean_scores([tracks for _, tracks in frames])
    for (frame, tracks), targets in zip(frames, entry.targets, strict=True):
        score = torch.tensor([mean[number] for number in tracks.id.tolist()], dtype=torch.float64)
        for metric in metrics.values():
            metric.update(tracks.replace(boxes=tracks.boxes.replace(score=score)), targets, [frame.meta])


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Fit, or cross-validate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("detections", type=Path, help="CLASS/SEQUENCE.txt")
    parser.add_argument("--labels", type=Path, required=True, help="SEQUENCE.txt of KITTI tracking")
    parser.add_argument("--calib", type=Path, required=True)
    parser.add_argument("--poses", type=Path, help="3 x 4 poses of camera 0")
    parser.add_argument("--view", type=float, default=1.4, help="field of view, radians (%(default)s)")
    parser.add_argument("--folds", type=int, default=0, help="cross-validate by sequence, and write nothing")
    parser.add_argument("--parts", action="store_true", help="with --folds: also without each part of the tracker")
    parser.add_argument(
        "--option", nargs="+", default=[], metavar="NAME=NUMBER", help="of the tracker: min_unseen=2 (nothing coasted)"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("weights.json"))
    given = parser.parse_args(arguments)
    options = {name: float(value) for name, _, value in (text.partition("=") for text in given.option)}
    torch.set_num_threads(1)
    classes = detections.kitti_classes(given.detections)
    data = read(given.detections, given.labels, given.calib, given.poses, classes)
    if given.folds:
        variants = VARIANTS if given.parts else {"cross-validated": Variant(options)}
        found = cross_validate(data, classes, given.view, given.folds, variants)
        for variant, (rules, kind) in itertools.product(found, itertools.product(("devkit", "clean"), classes)):
            figures = found[variant][rules]
            shown = {key: figures.get(f"{kind.lower()}_{key}", float("nan")) for key in ("samota", "mota", "ids")}
            print(f"{variant}: {rules} {kind}", " ".join(f"{key} {value:.4f}" for key, value in shown.items()))
        return
    learnt = fit(data, classes, given.view, **options)
    write_text(given.output, json.dumps(learnt))
    print(f"{given.output}: calibration {learnt['calibration']}")


if __name__ == "__main__":
    sys.exit(main())
