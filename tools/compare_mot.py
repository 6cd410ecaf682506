#!/usr/bin/env python3
"""Compare the metric `mot3d` with another evaluator of KITTI 3D tracking results, figure by figure.

python tools/compare_mot.py EVALUATOR DATA [--noisy 6]

EVALUATOR: a Python file with `evaluate_class(labels, results, sequences, class, iou, rules)`.
DATA: a folder with `label_02` and `det_pointrcnn/{Car,Pedestrian,Cyclist}`, one file for each sequence.

Result sets: the detections as tracks of the tracker `greedy`, and labels made noisy (moved, dropped, swapped ids,
gaps, false boxes). Each is written as KITTI tracking files that both sides read. The last line says the largest
difference; exit 1 where it is above 1e-9.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track as progress

from lidarfw.components.metrics.mot3d import Mot3D
from lidarfw.components.trackers.greedy import GreedyTracker
from lidarfw.kitti import NEUTRAL, Label, TrackLabel, read_tracks, write_tracks
from lidarfw.types import Boxes, FrameMeta, FrameResult, Spec, Targets, Tracks

CLASSES = ("Car", "Pedestrian", "Cyclist")
SEATED = {"Person": "Pedestrian"}
PLAIN = {
    "sAMOTA": "samota", "AMOTA": "amota", "AMOTP": "amotp", "MOTA": "mota", "MOTP": "motp", "recall": "recall",
    "precision": "precision", "F1": "f1", "MT": "mt", "ML": "ml", "IDS": "ids", "FRAG": "frag", "TP": "tp",
    "FP": "fp", "FN": "fn", "HOTA": "hota", "DetA": "deta", "AssA": "assa", "LocA": "loca", "IDF1": "idf1",
    "IDP": "idp", "IDR": "idr",
}  # fmt: skip


def boxes_of(labels: list[Label], index: list[int]) -> Boxes:
    """Boxes in the axes x ahead, y left, z up of the camera; float64, so that both sides see the same numbers."""
    rows = [
        (b.location[2], -b.location[0], -b.location[1] + b.size[0] / 2, *reversed(b.size), -b.rotation_y - np.pi / 2)
        for b in labels
    ]
    boxes = Boxes.from_tensor(torch.tensor(rows, dtype=torch.float64).view(-1, 7), torch.tensor(index).long())
    score = [1.0 if b.score is None else b.score for b in labels]
    return boxes.replace(
        score=torch.tensor(score, dtype=torch.float64),
        box2d=torch.tensor([b.box2d for b in labels], dtype=torch.float64).view(-1, 4),
        occlusion=torch.tensor([b.occlusion for b in labels]).long(),
        truncation=torch.tensor([b.truncation for b in labels], dtype=torch.float64),
    )


def by_frame(path: Path) -> dict[int, list[TrackLabel]]:
    frames = defaultdict(list)
    for row in read_tracks(path):
        frames[row.frame].append(row)
    return frames


def tracks_of(rows: list[TrackLabel]) -> Tracks:
    boxes = boxes_of([row.label for row in rows], [CLASSES.index(row.label.type) for row in rows])
    return Tracks(boxes, torch.tensor([row.id for row in rows]).long())


def targets_of(rows: list[TrackLabel]) -> Targets:
    neutral = {name: CLASSES.index(base) for name, base in {**NEUTRAL, **SEATED}.items()} | {"DontCare": -1}
    known, out = ([row for row in rows if row.label.type in group] for group in (CLASSES, neutral))
    ignored = boxes_of([row.label for row in out], [neutral[row.label.type] for row in out])
    return Targets(tracks=tracks_of(known), ignored=ignored)


def ours(labels: Path, results: Path, sequences: list[tuple[str, int]], iou: float, rules: str) -> dict[str, float]:
    """Figures of the metric."""
    metric = Mot3D(Spec(Tracks, classes=CLASSES), default_iou=iou, rules=rules)
    for name, count in sequences:
        known, found = by_frame(labels / f"{name}.txt"), by_frame(results / f"{name}.txt")
        for index in range(count):
            metric.update(tracks_of(found[index]), targets_of(known[index]), [FrameMeta("", name, index)])
    return metric.compute()


def theirs(
    evaluator: Any, labels: Path, results: Path, sequences: list[tuple[str, int]], iou: float, rules: str
) -> dict[str, float]:
    """The same figures of the evaluator."""
    figures = {}
    for name in CLASSES:
        found = evaluator.evaluate_class(str(labels), str(results), sequences, name.lower(), iou, rules)
        values = {**found, **found["best"], **found["identity_best"]}
        figures |= {f"{name.lower()}_{key}": float(values[other]) for other, key in PLAIN.items()}
        whole = found["identity_all"]
        figures |= {f"{name.lower()}_{key.lower()}_all": float(whole[key]) for key in ("HOTA", "IDF1")}
    return figures


def tracked(data: Path, name: str, count: int) -> Iterator[TrackLabel]:
    """The detections of a sequence with the ids of the tracker, class by class."""
    for number, kind in enumerate(CLASSES):
        path = data / "det_pointrcnn" / kind / f"{name}.txt"
        rows = np.loadtxt(path, delimiter=",", ndmin=2) if path.exists() else np.zeros((0, 15))
        tracker = GreedyTracker(Spec(Boxes, classes=CLASSES))
        state = tracker.start()
        for index in range(count):
            labels = [
                Label(kind, 0, 0, r[14], tuple(r[2:6]), tuple(r[7:10]), tuple(r[10:13]), r[13], r[6])
                for r in rows[rows[:, 0] == index].tolist()
            ]
            boxes = boxes_of(labels, [number] * len(labels))
            frame = FrameResult(FrameMeta("", name, index, index / 10))
            ids = tracker.step(state, frame, boxes)[0].tracks
            assert ids is not None
            for label, identity in zip(labels, ids.id.tolist(), strict=True):
                yield TrackLabel(index, 10000 * number + identity, label)


def noisy(rows: Iterable[TrackLabel], rng: np.random.Generator) -> Iterator[TrackLabel]:
    """Labels with noise of a strength drawn per call, gaps, swapped ids, and false boxes."""
    strength, drop, swap, false = rng.uniform((0, 0, 0, 0), (0.5, 0.4, 0.05, 0.3))
    shift: dict[int, int] = defaultdict(int)
    for row in rows:
        if row.label.type not in CLASSES or rng.random() < drop:
            continue
        shift[row.id] += 1000 * (rng.random() < swap)
        score = float(rng.normal(3 - row.label.occlusion, 1) + row.id % 3)
        yield moved(row, row.id + shift[row.id], score, rng, strength)
        if rng.random() < false:
            yield moved(row, row.id + 500000 + int(rng.integers(3)) * 1000, float(rng.normal(1, 1)), rng, 4 * strength)


def moved(row: TrackLabel, identity: int, score: float, rng: np.random.Generator, strength: float) -> TrackLabel:
    b = row.label
    place = tuple((np.array(b.location) + rng.normal(0, strength, 3) * (1, 0.2, 1)).tolist())
    turn = b.rotation_y + float(rng.normal(0, 0.2 * strength))
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return TrackLabel(row.frame, identity, Label(b.type, 0, 0, b.alpha, b.box2d, b.size, place, turn, score))


def result_sets(data: Path, sequences: list[tuple[str, int]], folder: Path, number: int) -> Iterator[tuple[str, Path]]:
    for name, count in sequences:
        write_tracks(folder / "tracked" / f"{name}.txt", sorted(tracked(data, name, count), key=lambda row: row.frame))
    yield "tracked PointRCNN", folder / "tracked"
    for seed in range(number):
        rng = np.random.default_rng(seed)
        for name, _ in sequences:
            rows = {
                (r.frame, r.id, r.label.type): r for r in noisy(read_tracks(data / "label_02" / f"{name}.txt"), rng)
            }
            write_tracks(folder / f"noisy_{seed}" / f"{name}.txt", list(rows.values()))
        yield f"noisy {seed}", folder / f"noisy_{seed}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("evaluator", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--noisy", type=int, default=6)
    arguments = parser.parse_args()
    spec = importlib.util.spec_from_file_location("evaluator", arguments.evaluator)
    evaluator = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    sys.modules["evaluator"] = evaluator
    spec.loader.exec_module(evaluator)  # type: ignore[union-attr]
    labels, figures, worst = arguments.data / "label_02", 0, 0.0
    names = sorted(path.stem for path in labels.glob("*.txt"))
    sequences = [(name, 1 + max(by_frame(labels / f"{name}.txt"))) for name in names]
    with tempfile.TemporaryDirectory() as folder:
        sets = list(result_sets(arguments.data, sequences, Path(folder), arguments.noisy))
        cases = [(*entry, iou, rules) for entry in sets for rules in ("devkit", "clean") for iou in (0.25, 0.5)]
        for title, results, iou, rules in progress(cases):
            one, two = (
                ours(labels, results, sequences, iou, rules),
                theirs(evaluator, labels, results, sequences, iou, rules),
            )
            off = {key: abs(one[key] - value) for key, value in two.items()}
            figures, worst = figures + len(off), max(worst, *off.values())
            text = ", ".join(f"{key} {one[key]:.6f} / {two[key]:.6f}" for key, value in off.items() if value > 1e-9)
            scores = " ".join(f"{name} {one[f'{name.lower()}_samota']:.4f}" for name in CLASSES)
            print(f"{title}, IoU {iou}, {rules}: sAMOTA {scores}; {text or 'all figures equal'}")
    print(f"{figures} figures, largest difference {worst:.1e}")
    return int(worst > 1e-9)


if __name__ == "__main__":
    raise SystemExit(main())
