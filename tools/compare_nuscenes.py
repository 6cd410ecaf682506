#!/usr/bin/env python3
"""Compare the metrics `nuscenes_detection` and `nuscenes_tracking` with nuscenes-devkit, figure by figure.

python tools/compare_nuscenes.py DEVKIT_PYTHON

DEVKIT_PYTHON: the interpreter of an environment with nuscenes-devkit, which cannot share one with lidarfw (numpy < 2):
    python -m venv devkit
    devkit/bin/pip install "numpy<2" "pandas<2" "scipy<1.12" pyquaternion cachetools
    devkit/bin/pip install --no-deps nuscenes-devkit==1.2.0 motmetrics==1.4.0 xmltodict
What the devkit imports for drawing and does not use here may be missing. The frames are the noisy ones of the tests.
The last line says the largest difference; exit 1 where it is above 1e-9.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[1] / "tests" / "components"
UNUSED = ("cv2", "matplotlib", "PIL", "sklearn", "shapely", "tqdm", "descartes", "fire", "pycocotools")
ATTRIBUTES = ("vehicle.moving", "vehicle.parked", "vehicle.stopped", "pedestrian.moving")
ERRORS = {"trans_err": "ate", "scale_err": "ase", "orient_err": "aoe", "vel_err": "ave", "attr_err": "aae"}
UNDEFINED = {"traffic_cone": ("attr_err", "vel_err", "orient_err"), "barrier": ("attr_err", "vel_err")}
RANGE = {"car": 50, "pedestrian": 40, "barrier": 30, "traffic_cone": 30}
TRACKED = ("mota", "motp", "recall", "ids", "frag", "tp", "fp", "fn")
WORST = {"amota": 0.0, "amotp": 2.0}


def ours() -> dict[str, Any]:
    """Noisy frames as lists of numbers, and what the metrics say of them."""
    sys.path.insert(0, str(TESTS))
    import test_nuscenes_detection as detection
    import test_nuscenes_tracking as tracking

    names = ("center", "size", "yaw", "label", "score", "velocity", "attribute")
    sets: dict[str, Any] = {"detection": [], "tracking": []}
    for seed in range(3):
        frames = detection.noisy_frames(seed, 40)
        pairs = [[{n: getattr(b, n).tolist() for n in names} for b in (f, t.boxes)] for f, t in frames]
        sets["detection"].append({"frames": pairs, "figures": detection.figures(*frames)})
    for seed in range(6):
        steps = tracking.noisy_sequences(seed)
        rows = [[m.sequence, m.time, _track_rows(f), _track_rows(t.tracks)] for f, t, m in steps]
        sets["tracking"].append({"steps": rows, "figures": tracking.figures(*steps)})
    return sets


def _track_rows(tracks: Any) -> list[list[float]]:
    boxes = tracks.boxes
    columns = tracks.id.tolist(), boxes.center[:, :2].tolist(), boxes.score.tolist(), boxes.label.tolist()
    return [[number, *place, score, label] for number, place, score, label in zip(*columns, strict=True)]


def stand_in_for_unused() -> None:
    """Let the devkit import what it draws with where that is not installed."""
    from unittest.mock import MagicMock

    class Finder:
        def find_spec(self, name: str, path: Any = None, target: Any = None) -> Any:
            from importlib.machinery import ModuleSpec

            return ModuleSpec(name, self, is_package=True) if name.split(".")[0] in UNUSED else None  # type: ignore[arg-type]

        def create_module(self, spec: Any) -> Any:
            module = MagicMock()
            module.__path__, module.__spec__ = [], spec
            return module

        def exec_module(self, module: Any) -> None: ...

    sys.meta_path.append(Finder())  # type: ignore[arg-type]


def detection_figures(frames: list[Any]) -> dict[str, float]:
    """The devkit's figures of detections."""
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.common.utils import center_distance
    from nuscenes.eval.detection.algo import accumulate, calc_ap, calc_tp

    known, found = EvalBoxes(), EvalBoxes()
    for number, (boxes, truth) in enumerate(frames):
        found.add_boxes(str(number), _detections(boxes, str(number), False))
        known.add_boxes(str(number), _detections(truth, str(number), True))
    figures: dict[str, float] = {}
    for name in RANGE:
        data = {limit: accumulate(known, found, name, center_distance, limit) for limit in (0.5, 1.0, 2.0, 4.0)}
        figures |= {f"{name}_ap_{limit:g}m": calc_ap(curve, 0.1, 0.1) for limit, curve in data.items()}
        errors = [error for error in ERRORS if error not in UNDEFINED.get(name, ())]
        figures |= {f"{name}_{ERRORS[error]}": calc_tp(data[2.0], 0.1, error) for error in errors}
    return figures


def _detections(rows: dict[str, Any], token: str, truth: bool) -> list[Any]:
    from nuscenes.eval.detection.data_classes import DetectionBox

    boxes, names = [], list(RANGE)
    for center, size, yaw, label, score, velocity, does in zip(*rows.values(), strict=True):
        if math.hypot(*center[:2]) < RANGE[names[label]]:
            box = DetectionBox(
                sample_token=token,
                translation=tuple(center),
                size=(size[1], size[0], size[2]),
                rotation=(math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)),
                velocity=tuple(velocity),
                num_pts=1 if truth else -1,
                detection_name=names[label],
                detection_score=-1.0 if truth else score,
                attribute_name=ATTRIBUTES[does] if does >= 0 else "",
            )
            boxes.append(box)
    return boxes


def tracking_figures(steps: list[Any]) -> dict[str, float]:
    """The devkit's figures of tracks."""
    import numpy as np
    import nuscenes.eval.tracking.algo as algo
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.utils import center_distance
    from nuscenes.eval.tracking.data_classes import TrackingMetricData
    from nuscenes.eval.tracking.loaders import interpolate_tracks

    algo.sklearn.metrics.pairwise.euclidean_distances = lambda a, b: np.linalg.norm(a[:, None] - b[None], axis=2)
    algo.tqdm.tqdm = lambda values, **_: values
    config_factory("tracking_nips_2019")  # sets the classes that a TrackingBox may have
    TrackingMetricData.set_nelem(40)
    found, known = ({name: {} for name, *_ in steps} for _ in range(2))
    for name, time, boxes, truth in steps:
        found[name][time], known[name][time] = _tracked(boxes, False), _tracked(truth, True)
    for frames in found.values():
        _set_mean_scores(frames)
    found, known = ({name: interpolate_tracks(frames) for name, frames in part.items()} for part in (found, known))
    figures: dict[str, float] = {}
    for name in ("car", "pedestrian"):
        worst: dict[str, float] = defaultdict(float)
        judge = algo.TrackingEvaluation(known, found, name, center_distance, 2.0, 0.1, 40, worst, verbose=False)
        data = judge.accumulate()
        best = int(np.nanargmax(data.mota))
        figures |= {f"{name}_{key}": float(data.get_metric(key)[best]) for key in TRACKED}
        figures[f"{name}_tp"] += figures[f"{name}_ids"]  # the devkit does not count switches as true positives
        for key, source in (("amota", "motar"), ("amotp", "motp")):
            figures[f"{name}_{key}"] = float(np.nan_to_num(data.get_metric(source), nan=WORST[key]).mean())
    return figures


def _tracked(rows: list[list[float]], truth: bool) -> list[Any]:
    from nuscenes.eval.tracking.data_classes import TrackingBox

    boxes, names = [], list(RANGE)
    for number, x, y, score, label in rows:
        name = names[int(label)]
        if math.hypot(x, y) < RANGE[name]:
            box = TrackingBox(
                sample_token="",
                translation=(x, y, 0),
                size=(2, 4, 1.5),
                rotation=(1, 0, 0, 0),
                velocity=(0, 0),
                num_pts=1,
                tracking_id=f"{name}{number}",
                tracking_name=name,
                tracking_score=-1.0 if truth else score,
            )
            boxes.append(box)
    return boxes


def _set_mean_scores(frames: dict[float, list[Any]]) -> None:
    import numpy as np

    scores = defaultdict(list)
    for boxes in frames.values():
        for box in boxes:
            scores[box.tracking_id].append(box.tracking_score)
    for boxes in frames.values():
        for box in boxes:
            box.tracking_score = np.mean(scores[box.tracking_id])


def compare(sets: dict[str, Any]) -> int:
    """Print the differences; this part runs in the devkit's environment."""
    stand_in_for_unused()
    count, worst = 0, 0.0
    for kind, key, judge in (("detection", "frames", detection_figures), ("tracking", "steps", tracking_figures)):
        for number, entry in enumerate(sets[kind]):
            theirs = judge(entry[key])
            off = {name: abs(value - entry["figures"][name]) for name, value in theirs.items()}
            count, worst = count + len(off), max(worst, *off.values())
            print(f"{kind} {number}: {len(off)} figures, largest difference {max(off.values()):.1e}")
    print(f"{count} figures, largest difference {worst:.1e}")
    return int(worst > 1e-9)


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__)
        return 2
    if sys.argv[1].endswith(".json"):
        return compare(json.loads(Path(sys.argv[1]).read_text()))
    with tempfile.NamedTemporaryFile("w", suffix=".json") as file:
        json.dump(ours(), file)
        file.flush()
        return subprocess.run([sys.argv[1], "-W", "ignore", __file__, file.name], check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
