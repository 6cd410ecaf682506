"""Files of detections from anywhere, as sequences of frames for a tracker; and their tracks in the official formats.

Three formats. `kitti`: FOLDER/{Car,Pedestrian,Cyclist}/0000.txt, one line per box (frame, type number, left, top,
right, bottom, score, h, w, l, x, y, z, rotation_y, alpha; rectified camera frame), the form in which detections for
KITTI tracking are published; results are its tracking result files. `nuscenes`: a detection submission (JSON), its
order and poses from the tables; results are a tracking submission. `json`: a folder of what `lidarfw predict` wrote.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lidarfw import kitti, nuscenes
from lidarfw._lazy import LazyModule
from lidarfw.components.datasets.drives import read_poses
from lidarfw.errors import DataError
from lidarfw.files import natural, write_text
from lidarfw.types import Boxes, Camera, FrameMeta, Poses, Tracks

if TYPE_CHECKING:
    import torch

    from lidarfw.interfaces import Tracker
else:
    torch = LazyModule("torch")

Array = npt.NDArray[np.float64]

PERIOD = 0.1  # seconds between frames of KITTI, and of JSON files that say no time
STEP = 1024  # scores are whole multiples of 1 / STEP: their mean over a track is exact in every order of adding
# The axes of the rectified camera (x right, y down, z ahead) named x ahead, y left, z up: boxes stand upright there
_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
_COLUMNS = 15


@dataclass
class Detections:
    """One frame: its boxes in the sensor frame, and the pose of the sensor where it is known."""

    meta: FrameMeta
    boxes: Boxes
    pose: Poses | None = None


@dataclass
class DetectedSequence:
    """The frames of one sequence in order of time."""

    name: str
    frames: list[Detections]


def pose_of(matrix: Array) -> Poses:
    """One known pose (4, 4)."""
    return Poses(torch.from_numpy(matrix)[None], torch.tensor([True]), torch.ones(1))


def boxes_of(rows: Array, label: Sequence[int], score: Sequence[float], box2d: Array | None = None) -> Boxes:
    """Boxes in float64 from (M, 7) x, y, z, l, w, h, yaw."""
    made = Boxes.from_tensor(
        torch.from_numpy(np.asarray(rows, dtype=np.float64).reshape(-1, 7)),
        torch.tensor(list(label), dtype=torch.long),
        torch.tensor(list(score), dtype=torch.float64),
    )
    return made if box2d is None else made.replace(box2d=torch.from_numpy(box2d))


# KITTI


def kitti_sequences(folder: Path) -> list[str]:
    """Names of the sequences that any class folder has a file of; DataError where there are none."""
    names = sorted({path.stem for path in folder.glob("*/*.txt")})
    if not names:
        raise DataError(f"{folder}: expected CLASS/SEQUENCE.txt (Car/0000.txt), found no such file.")
    return names


def kitti_classes(folder: Path) -> tuple[str, ...]:
    """The class folders; those of KITTI's benchmark in its order. DataError where there are none."""
    if not folder.is_dir():
        raise DataError(f"{folder}: there is no such folder of detections, CLASS/SEQUENCE.txt")
    found = {path.name for path in folder.iterdir() if path.is_dir() and any(path.glob("*.txt"))}
    if not found:
        raise DataError(f"{folder}: has no detections, expected CLASS/SEQUENCE.txt, such as Car/0000.txt")
    usual = [name for name in ("Car", "Pedestrian", "Cyclist") if name in found]
    return (*usual, *sorted(found - set(usual)))


def read_kitti(folder: Path, name: str, classes: Sequence[str], poses: Path | None, cameras: Path) -> DetectedSequence:
    """One sequence. `poses` holds SEQUENCE.txt (3 x 4, camera 0 to world), `cameras` the calibrations.

    The sensor frame is the rectified camera with its axes renamed (x ahead, y left, z up), where KITTI's boxes stand
    upright. There is a frame for every pose, else up to the last that has a box. DataError names file and line.
    """
    tables = [_kitti_table(folder / kind / f"{name}.txt") for kind in classes]
    label = np.repeat(np.arange(len(classes)), [len(table) for table in tables])
    table = np.concatenate([np.zeros((0, _COLUMNS)), *tables])
    rows = np.concatenate([table[:, 10:13], table[:, [9, 8, 7]], -table[:, 13:14] - np.pi / 2], 1)
    rows[:, 1] -= table[:, 7] / 2
    rows[:, :3], rows[:, 6] = rows[:, :3] @ _FROM_CAMERA[:3, :3].T, kitti.wrap_angle(rows[:, 6])
    matrices = None if poses is None else _kitti_poses(poses / f"{name}.txt")
    count = int(table[:, 0].max(initial=-1)) + 1
    if matrices is not None and len(matrices) < count:
        raise DataError(
            f"{poses}/{name}.txt: has {len(matrices)} poses, but there are boxes in frame {count - 1}.\n"
            "  fix: one line for every frame, or no --poses"
        )
    camera = _kitti_cameras(cameras / f"{name}.txt", table[:, 2:6])
    frames = []
    for index in range(count if matrices is None else len(matrices)):
        at = np.flatnonzero(table[:, 0] == index)
        meta = FrameMeta(f"{name}/{index:06d}", name, index, index * PERIOD, camera)
        boxes = boxes_of(rows[at], label[at].tolist(), table[at, 6].tolist(), table[at, 2:6])
        frames.append(Detections(meta, boxes, None if matrices is None else pose_of(matrices[index])))
    return DetectedSequence(name, frames)


def _kitti_table(path: Path) -> Array:
    """The lines of a file, (N, 15); none where a class has no file for the sequence."""
    if not path.exists():
        return np.zeros((0, _COLUMNS))
    lines = [line.replace(",", " ").split() for line in kitti.read_text(path).splitlines() if line.strip()]
    for number, words in enumerate(lines, 1):
        if len(words) != _COLUMNS:
            raise DataError(f"{path}, line {number}: expected {_COLUMNS} columns, found {len(words)}")
    try:
        table = np.array(lines, dtype=np.float64).reshape(-1, _COLUMNS)
    except ValueError as error:
        raise DataError(f"{path}: expected numbers: {error}") from error
    wrong = ~np.isfinite(table).all(1) | (table[:, 7:10] <= 0).any(1) | (table[:, 0] < 0) | (table[:, 0] % 1 != 0)
    if wrong.any():
        line = int(wrong.argmax())
        raise DataError(
            f"{path}, line {line + 1}: expected finite numbers, a whole frame and positive sizes, found {lines[line]}"
        )
    return table


def _kitti_poses(path: Path) -> Array:
    """(N, 4, 4) poses of the renamed camera frame."""
    moved: Array = _FROM_CAMERA @ read_poses(path) @ _FROM_CAMERA.T
    return moved


def _kitti_cameras(path: Path, rectangles: Array) -> dict[str, Camera]:
    """The cameras of a sequence. The size of its pictures is that of KITTI's largest, or what the 2D boxes reach."""
    size = np.maximum(rectangles[:, 2:].max(0, initial=0), (1241, 374)).astype(int) + 1
    return upright(kitti.read_calibration(path)).cameras(int(size[0]), int(size[1]))


def upright(calibration: kitti.Calibration) -> kitti.Calibration:
    """The calibration of a sensor that is the rectified camera with its axes renamed."""
    return replace(calibration, r0_rect=np.eye(3), velo_to_cam=_FROM_CAMERA.T[:3])


def write_kitti(path: Path, frames: Sequence[tuple[FrameMeta, Tracks]], classes: Sequence[str]) -> None:
    """A KITTI tracking result file of one sequence. Each track has one score: the mean of those of its boxes."""
    score = mean_scores([tracks for _, tracks in frames])
    lines = []
    for meta, tracks in frames:
        scores = torch.tensor([score[number] for number in tracks.id.tolist()], dtype=torch.float64)
        labels = kitti.labels_from_boxes(tracks.boxes.replace(score=scores), classes, meta.cameras)
        pairs = zip(tracks.id.tolist(), labels, strict=True)
        lines += [kitti.TrackLabel(meta.index, number, label) for number, label in pairs]
    kitti.write_tracks(path, lines)


def mean_scores(frames: Sequence[Tracks]) -> dict[int, float]:
    """The mean score of each track as the next whole multiple of 1/1024.

    Evaluators average the scores of a track themselves, and some compare the rounded mean with itself; a multiple of
    1/1024 (ten digits after the point, written in full) stays what it is.
    """
    found: dict[int, list[float]] = defaultdict(list)
    for tracks in frames:
        for number, score in zip(tracks.id.tolist(), tracks.boxes.score.tolist(), strict=True):
            found[number].append(score)
    return {number: round(float(np.mean(scores)) * STEP) / STEP for number, scores in found.items()}


# JSON of `lidarfw predict`


def read_json(folder: Path) -> tuple[DetectedSequence, tuple[str, ...]]:
    """The files of a folder in the order of their names (2 before 10), as one sequence, and the classes.

    As `lidarfw predict` writes them; a file may also have `time` (seconds) and `pose` (4 x 4, sensor to map).
    """
    paths = sorted(folder.glob("*.json"), key=lambda path: natural(path.name))
    if not paths:
        raise DataError(f"{folder}: expected .json files of `lidarfw predict`, found none.")
    plain = [(path, _load(path)) for path in paths]
    classes = tuple(_key(plain[0][1], "classes", plain[0][0]))
    frames = [_json_frame(path, value, index, folder.name, classes) for index, (path, value) in enumerate(plain)]
    return DetectedSequence(folder.name, frames), classes


def _load(path: Path) -> Any:
    try:
        return json.loads(kitti.read_text(path))
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: is no JSON: {error}") from error


def _key(value: Any, key: str, path: Path) -> Any:
    if not isinstance(value, dict) or key not in value:
        there = ", ".join(value) if isinstance(value, dict) else type(value).__name__
        raise DataError(f"{path}: expected the key {key!r}, found {there[:80] or 'none'}.")
    return value[key]


def _json_frame(path: Path, value: Any, index: int, sequence: str, classes: Sequence[str]) -> Detections:
    predictions = _key(value, "predictions", path)
    try:
        rows = [row for found in predictions.values() if found.get("kind") == "Boxes" for row in found["boxes"]]
        boxes = _json_boxes(rows, classes)
        pose = None if value.get("pose") is None else pose_of(_numbers(value["pose"], (4, 4)))
        time = float(_numbers(value.get("time", index * PERIOD), ()))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path}: expected boxes with class, score, center, size, yaw: {type(error).__name__}: {error}"
        ) from error
    return Detections(FrameMeta(str(value.get("id", path.stem)), sequence, index, time), boxes, pose)


def _json_boxes(rows: Sequence[Any], classes: Sequence[str]) -> Boxes:
    if not rows:
        return boxes_of(np.zeros((0, 7)), [], [])
    table = _numbers([[*row["center"], *row["size"], row["yaw"], row["score"]] for row in rows], (len(rows), 8))
    if (table[:, 3:6] <= 0).any():
        raise ValueError(f"size must be above 0, found {table[(table[:, 3:6] <= 0).any(1).argmax(), 3:6].tolist()}")
    unknown = sorted({str(row["class"]) for row in rows} - set(classes))
    if unknown:
        raise ValueError(f"class {unknown[0]!r} is none of {', '.join(classes)}")
    boxes = boxes_of(table[:, :7], [classes.index(row["class"]) for row in rows], table[:, 7].tolist())
    if all("velocity" in row for row in rows):
        return boxes.replace(velocity=torch.from_numpy(_numbers([row["velocity"] for row in rows], (len(rows), 2))))
    return boxes


def _numbers(value: Any, shape: tuple[int, ...]) -> Array:
    """ValueError unless they are finite and as many as the shape says."""
    numbers: Array = np.array(value, dtype=np.float64)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise ValueError(f"expected finite numbers of shape {shape}, found {value}")
    return numbers


def write_json(folder: Path, frames: Sequence[tuple[FrameMeta, Tracks]], classes: Sequence[str]) -> None:
    """One file per frame, named by it: the tracks with id, class, score, center, size, yaw."""
    from lidarfw.predict import save
    from lidarfw.types import FrameResult

    for meta, tracks in frames:
        save(FrameResult(meta, {}, tracks), folder, "json", classes)


# nuScenes


def read_nuscenes(path: Path, tables: Path) -> tuple[list[DetectedSequence], tuple[str, ...], dict[str, Any]]:
    """The scenes of a detection submission, its classes, and its `meta`. `tables` is ROOT/v1.0-trainval or alike."""
    submission = _load(path)
    results: Mapping[str, Any] = _key(submission, "results", path)
    names = sorted({row["detection_name"] for rows in results.values() for row in rows} - set(nuscenes.CLASSES))
    if names:
        raise DataError(f"{path}: detection_name: expected one of {', '.join(nuscenes.CLASSES)}, found {names[0]!r}")
    poses = nuscenes.lidar_poses(tables)
    scenes: dict[str, list[tuple[float, str]]] = defaultdict(list)
    for row in nuscenes.Tables(tables).rows("sample"):
        if row["token"] in results:
            scenes[row["scene_token"]].append((row["timestamp"] / 1e6, row["token"]))
    missing = len(results) - sum(len(tokens) for tokens in scenes.values())
    if missing:
        raise DataError(f"{path}: {missing} of its samples are not in {tables / 'sample.json'}.\n  fix: correct --root")
    sequences = [
        DetectedSequence(scene, [
            _nuscenes_frame(results[token], token, scene, index, time, poses[token], path)
            for index, (time, token) in enumerate(sorted(tokens))
        ])
        for scene, tokens in scenes.items()
    ]  # fmt: skip
    return sequences, nuscenes.CLASSES, dict(submission.get("meta", {}))


def _nuscenes_frame(
    rows: Sequence[Any], token: str, scene: str, index: int, time: float, pose: Array, path: Path
) -> Detections:
    matrices = np.linalg.inv(pose) @ nuscenes.transforms(rows, path)
    size = np.array([row["size"] for row in rows], dtype=np.float64).reshape(-1, 3)[:, [1, 0, 2]]
    yaw = np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0])
    label = [nuscenes.CLASSES.index(row["detection_name"]) for row in rows]
    boxes = boxes_of(
        np.concatenate([matrices[:, :3, 3], size, yaw[:, None]], 1), label, [row["detection_score"] for row in rows]
    )
    speed = np.array([row["velocity"] for row in rows], dtype=np.float64).reshape(-1, 2) @ pose[:2, :2]
    return Detections(
        FrameMeta(token, scene, index, time), boxes.replace(velocity=torch.from_numpy(speed)), pose_of(pose)
    )


def write_nuscenes(
    path: Path, sequences: Sequence[Sequence[tuple[Detections, Tracks]]], meta: Mapping[str, Any]
) -> None:
    """A tracking submission: boxes in the global frame; classes that are not tracked are left out."""
    results: dict[str, list[dict[str, Any]]] = {}
    for number, frames in enumerate(sequences):
        for frame, tracks in frames:
            results[frame.meta.id] = _nuscenes_rows(frame, tracks, f"{number}_")
    write_text(path, json.dumps({"meta": dict(meta), "results": results}))


def _nuscenes_rows(frame: Detections, tracks: Tracks, prefix: str) -> list[dict[str, Any]]:
    assert frame.pose is not None
    pose, boxes = frame.pose.matrix[0].double().numpy(), tracks.boxes
    center = boxes.center.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
    yaw = boxes.yaw.double().numpy() + np.arctan2(pose[1, 0], pose[0, 0])
    speed = np.zeros((len(boxes), 2)) if boxes.velocity is None else boxes.velocity.double().numpy() @ pose[:2, :2].T
    names = [nuscenes.CLASSES[label] for label in boxes.label.tolist()]
    columns = zip(names, tracks.id.tolist(), center.tolist(), boxes.size[:, [1, 0, 2]].tolist(), yaw.tolist(),
                  speed.tolist(), boxes.score.tolist())  # fmt: skip
    return [
        {"sample_token": frame.meta.id, "translation": place, "size": size,
         "rotation": [float(np.cos(turn / 2)), 0.0, 0.0, float(np.sin(turn / 2))], "velocity": velocity,
         "tracking_id": f"{prefix}{number}", "tracking_name": name, "tracking_score": score}
        for name, number, place, size, turn, velocity, score in columns if name in nuscenes.TRACKED
    ]  # fmt: skip


# Tracking


def make_tracker(overrides: Sequence[str], classes: Sequence[str]) -> Tracker:
    """A tracker of boxes and, where there are any, poses; `overrides` choose and set it (`tracker=ab3dmot`)."""
    from lidarfw.assembly import build, plan
    from lidarfw.config import compose, to_plain
    from lidarfw.errors import ConfigError
    from lidarfw.types import DataSpec, Spec

    nodes = to_plain(compose(list(overrides))).get("tracker") or {}
    if len(nodes) != 1:
        raise ConfigError(f"one tracker is needed, found {', '.join(nodes) or 'none'}.\n  fix: tracker=NAME")
    inputs = {"boxes": Spec(Boxes, classes=tuple(classes)), "pose": Spec(Poses)}
    planned = plan({"tracker": nodes}, DataSpec(inputs, frozenset(), tuple(classes)))
    tracker: Tracker = build(planned).component(planned.of("tracker")[0]).eval()
    return tracker


def run(tracker: Tracker, sequence: DetectedSequence) -> Iterator[tuple[Detections, Tracks]]:
    """The frames of a sequence with their tracks, in order."""
    from lidarfw.types import FrameResult

    state, done = tracker.start(), list[FrameResult]()
    for frame in sequence.frames:
        posed = {} if frame.pose is None else {"pose": frame.pose}
        done += tracker.step(state, FrameResult(frame.meta), frame.boxes, **posed)
    for frame, result in zip(sequence.frames, [*done, *tracker.flush(state)], strict=True):
        assert result.tracks is not None  # every tracker sets them
        yield frame, result.tracks
