"""KITTI's object files: labels, calibration and results as text, and their boxes in the LiDAR frame.

Source of the formats: Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite",
CVPR 2012, and the readme of the object development kit. A KITTI box is given in the rectified frame of camera 0
(x right, y down, z ahead) by the centre of its underside, h w l, and rotation_y about the downward y axis; lidarfw's
is the geometric centre in the LiDAR frame with yaw = -rotation_y - pi/2.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from lidarfw._lazy import LazyModule
from lidarfw.errors import DataError
from lidarfw.files import write_text
from lidarfw.types import Boxes, Camera

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")

Array = npt.NDArray[np.float64]

TYPES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc", "DontCare")
TRACKING_TYPES = (*TYPES, "Person")  # tracking labels call a seated person so
NEUTRAL = {"Van": "Car", "Person_sitting": "Pedestrian"}  # neither right nor wrong for the class
IMAGE, RECTIFIED = "image", "rectified"  # cameras of a frame: the left colour picture, and the frame of the labels
_COLUMNS = (
    "type", "truncation", "occlusion", "alpha", "left", "top", "right", "bottom", "height", "width", "length",
    "x", "y", "z", "rotation_y", "score",
)  # fmt: skip
_NEAR = 0.1  # metres in front of the camera at which boxes are cut before they are projected


@dataclass(frozen=True)
class Label:
    """One line of a label or result file."""

    type: str
    truncation: float  # share outside the picture 0..1, -1 unknown
    occlusion: int  # 0 visible, 1 partly, 2 largely, 3 unknown, -1 not given
    alpha: float  # observation angle, radians, -10 unknown
    box2d: tuple[float, float, float, float]  # left, top, right, bottom, pixels
    size: tuple[float, float, float]  # height, width, length, metres
    location: tuple[float, float, float]  # centre of the underside, rectified camera frame, metres
    rotation_y: float  # radians, 0 = heading along the camera's x
    score: float | None = None  # results only

    def line(self) -> str:
        """The line of the file, without the line end."""
        head = f"{self.type} {self.truncation:g} {self.occlusion} {self.alpha:.4f}"
        numbers = (*self.box2d, *self.size, *self.location, self.rotation_y)
        tail = "" if self.score is None else f" {self.score:.12g}"
        return " ".join([head, *(f"{number:.4f}" for number in numbers)]) + tail


@dataclass(frozen=True)
class TrackLabel:
    """One line of a label or result file of KITTI tracking: an object and its identity in the sequence."""

    frame: int
    id: int  # the same number for the same object in every frame; -1 for DontCare
    label: Label  # in tracking labels truncation is a level: 0 none, 1 partly, 2 largely

    def line(self) -> str:
        """The line of the file, without the line end."""
        return f"{self.frame} {self.id} {self.label.line()}"


@dataclass(frozen=True, eq=False)
class Calibration:
    """The part of a calibration file that boxes, poses and pictures of camera 2 need; matrices in float64."""

    p2: Array  # (3, 4) rectified camera frame -> pixels of the left colour picture
    r0_rect: Array  # (3, 3) camera 0 -> rectified
    velo_to_cam: Array  # (3, 4) LiDAR -> camera 0
    imu_to_velo: Array | None = None  # (3, 4) inertial unit -> LiDAR, where the file has it

    @property
    def to_rectified(self) -> Array:
        """(4, 4) LiDAR -> rectified camera frame."""
        return _square(self.r0_rect) @ _square(self.velo_to_cam)

    def cameras(self, width: int, height: int) -> dict[str, Camera]:
        """The cameras `image` (P2) and `rectified` (same lens at camera 0, the frame of the labels).

        P2 = K [I | t]: its fourth column is the place of camera 2 beside camera 0 and goes into `from_sensor`.
        """
        fx, fy, cx, cy = self.p2[0, 0], self.p2[1, 1], self.p2[0, 2], self.p2[1, 2]
        shift = np.eye(4)
        shift[:3, 3] = np.linalg.solve(self.p2[:, :3], self.p2[:, 3])
        matrices = {IMAGE: shift @ self.to_rectified, RECTIFIED: self.to_rectified}
        lens = (float(fx), float(fy), float(cx), float(cy))
        return {name: Camera("pinhole", width, height, lens, (), _rows(m)) for name, m in matrices.items()}


def _square(matrix: Array) -> Array:
    whole = np.eye(4)
    whole[:3, : matrix.shape[1]] = matrix
    return whole


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in matrix)


def wrap_angle(angle: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def read_text(path: str | Path) -> str:
    """A text file; DataError where it is missing, not readable or not text."""
    try:
        return Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(
            f"{path}: expected text, found bytes that are not UTF-8. Unpack or download it again."
        ) from error
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}. Is the root of the dataset right?") from error


def read_labels(path: str | Path, types: Sequence[str] = TYPES) -> list[Label]:
    """The objects of a label (15 columns) or result file (16 columns), in file order.

    DataError names file, line, column, expected and found value: unknown type, wrong number of columns, a value
    that is no finite number, a size that is not positive, rotation_y in degrees.
    """
    rows = [(number, line.split()) for number, line in enumerate(read_text(path).splitlines(), 1) if line.strip()]
    return [_parse(values, f"{path}, line {number}", types) for number, values in rows]


def _parse(values: list[str], where: str, types: Sequence[str]) -> Label:
    if len(values) not in (15, 16):
        raise DataError(f"{where}: expected 15 columns (16 in results), found {len(values)}: {' '.join(values)[:80]}")
    if values[0] not in types:
        known = ", ".join(types)
        raise DataError(
            f"{where}: type: expected one of {known}, found {values[0]!r}. Correct the line or the classes."
        )
    numbers = [_number(text, f"{where}: {name}") for text, name in zip(values[1:], _COLUMNS[1:], strict=False)]
    if numbers[1] not in (-1, 0, 1, 2, 3):
        raise DataError(f"{where}: occlusion: expected -1, 0, 1, 2 or 3, found {numbers[1]:g}")
    box2d, size, location = tuple(numbers[3:7]), tuple(numbers[7:10]), tuple(numbers[10:13])
    label = Label(values[0], numbers[0], int(numbers[1]), numbers[2], box2d, size, location, *numbers[13:])  # type: ignore[arg-type]
    _check(label, where)
    return label


def _number(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DataError(f"{where}: expected a finite number, found {text!r}. Correct the line or leave the frame out.")
    return value


def _check(label: Label, where: str) -> None:
    left, top, right, bottom = label.box2d
    if right < left or bottom < top:
        raise DataError(f"{where}: 2D box: expected left <= right and top <= bottom, found {label.box2d}")
    if label.type == "DontCare":
        return
    if min(label.size) <= 0:
        raise DataError(f"{where}: height, width, length: expected positive metres, found {label.size}")
    if abs(label.rotation_y) > 2 * math.pi:
        raise DataError(
            f"{where}: rotation_y: expected radians in [-pi, pi], found {label.rotation_y}. Is it in degrees?"
        )


def read_calibration(path: str | Path) -> Calibration:
    """The calibration of a frame. DataError where a key is missing or its matrix cannot be what it should be."""
    table = _keys(path)
    p2 = _matrix(table, "P2", (3, 4), path)
    zero = p2[[0, 1, 2, 2], [1, 0, 0, 1]]
    if not (p2[0, 0] > 0 and p2[1, 1] > 0 and np.allclose(zero, 0) and np.isclose(p2[2, 2], 1)):
        raise DataError(f"{path}: P2: expected fx 0 cx / 0 fy cy / 0 0 1 with fx, fy > 0, found {p2[:, :3].tolist()}")
    rectify, extrinsics = _matrix(table, "R0_rect", (3, 3), path), _matrix(table, "Tr_velo_to_cam", (3, 4), path)
    inertial = _matrix(table, "Tr_imu_to_velo", (3, 4), path) if "Tr_imu_to_velo" in table else None
    for key, matrix in (("R0_rect", rectify), ("Tr_velo_to_cam", extrinsics), ("Tr_imu_to_velo", inertial)):
        rotation = np.eye(3) if matrix is None else matrix[:, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) or np.linalg.det(rotation) < 0:
            raise DataError(f"{path}: {key}: expected a rotation (orthonormal), found {rotation.tolist()}")
    return Calibration(p2, rectify, extrinsics, inertial)


_TRACKING_KEYS = {"R_rect": "R0_rect", "Tr_velo_cam": "Tr_velo_to_cam", "Tr_imu_velo": "Tr_imu_to_velo"}


def _keys(path: str | Path) -> dict[str, list[str]]:
    """Values by key, under the names of the object benchmark; the tracking benchmark has others, without a colon."""
    rows = [line.split() for line in read_text(path).splitlines() if line.strip()]
    named = [(row[0].removesuffix(":"), row[1:]) for row in rows]
    return {_TRACKING_KEYS.get(key, key): values for key, values in named}


_EARTH = 6378137.0  # metres, radius at the equator


def poses_from_oxts(rows: Array) -> Array:
    """Poses (N, 4, 4) of the inertial unit from OXTS rows (N, 30): latitude, longitude, altitude, roll, pitch, yaw ...

    The map is east, north, up with its origin at the first row. Mercator projection at the scale of the first
    latitude: the readme of the raw data development kit (Geiger et al., IJRR 2013).
    """
    from scipy.spatial.transform import Rotation  # slow to import

    latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    scale = np.cos(latitude[:1]) * _EARTH
    place = np.stack([scale * longitude, scale * np.log(np.tan(math.pi / 4 + latitude / 2)), rows[:, 2]], 1)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    poses[:, :3, 3] = place - place[:1]
    return poses


def _matrix(table: Mapping[str, list[str]], key: str, shape: tuple[int, int], path: str | Path) -> Array:
    if key not in table:
        raise DataError(
            f"{path}: no key {key}; it has {', '.join(k for k in table if k) or 'none'}. Download it again."
        )
    values = [_number(text, f"{path}: {key}") for text in table[key]]
    if len(values) != shape[0] * shape[1]:
        raise DataError(f"{path}: {key}: expected {shape[0]} x {shape[1]} numbers, found {len(values)}")
    return np.array(values).reshape(shape)


def boxes_from_labels(labels: Sequence[Label], calibration: Calibration, classes: Sequence[str]) -> tuple[Boxes, Boxes]:
    """The boxes to learn and the neutral ones, in the LiDAR frame.

    Neutral are Van for Car and Person_sitting for Pedestrian (label of that class) and DontCare (label -1, only
    box2d is known: centre, size and yaw are 0); a type that stands in `classes` is never neutral. Other types are
    left out. `row` is the place in `labels`; of results the score is taken too.
    """
    known = {name: index for index, name in enumerate(classes)}
    neutral = {name: known[base] for name, base in NEUTRAL.items() if base in known} | {"DontCare": -1}
    learnt = [(row, known[label.type]) for row, label in enumerate(labels) if label.type in known]
    ignored = [(row, neutral[b.type]) for row, b in enumerate(labels) if b.type in neutral and b.type not in known]
    learnt_boxes, ignored_boxes = (_boxes(labels, chosen, calibration) for chosen in (learnt, ignored))
    return learnt_boxes, ignored_boxes


def _boxes(labels: Sequence[Label], chosen: Sequence[tuple[int, int]], calibration: Calibration) -> Boxes:
    picked = [labels[row] for row, _ in chosen]
    table = np.array([(*b.location, *b.size, b.rotation_y, *b.box2d, b.truncation, b.alpha) for b in picked]).reshape(
        -1, 13
    )
    dont_care = np.array([label == -1 for _, label in chosen], dtype=bool)
    center = table[:, :3] - np.array([0, 0.5, 0]) * table[:, 3:4]
    to_lidar = np.linalg.inv(calibration.to_rectified)
    boxes = np.concatenate(
        [center @ to_lidar[:3, :3].T + to_lidar[:3, 3], table[:, [5, 4, 3]], wrap_angle(-table[:, 6:7] - math.pi / 2)],
        1,
    )
    boxes[dont_care] = 0
    index = np.array(chosen, dtype=np.int64).reshape(-1, 2)
    score = [1.0 if label.score is None else label.score for label in picked]
    return Boxes.from_tensor(torch.tensor(boxes, dtype=torch.float32), torch.tensor(index[:, 1])).replace(
        score=torch.tensor(score, dtype=torch.float32),
        box2d=torch.tensor(table[:, 7:11], dtype=torch.float32),
        truncation=torch.tensor(table[:, 11], dtype=torch.float32),
        alpha=torch.tensor(table[:, 12], dtype=torch.float32),
        occlusion=torch.tensor([label.occlusion for label in picked], dtype=torch.int64),
        row=torch.tensor(index[:, 0]),
    )


def level_boxes(boxes: Boxes, cameras: Mapping[str, Camera]) -> Array:
    """Boxes (M, 7) x, y, z, l, w, h, yaw in the levelled frame: that of the labels with its axes named as usual.

    The axes of the rectified camera frame, renamed to x ahead, y left, z up. KITTI's boxes stand upright there,
    not in the LiDAR frame, which is tilted by the extrinsics; so overlaps are measured there.
    """
    matrix = np.array(camera_of(cameras, RECTIFIED).from_sensor)
    table: Array = boxes.tensor.detach().cpu().double().numpy()
    center = table[:, :3] @ matrix[:3, :3].T + matrix[:3, 3]
    return np.concatenate([center[:, 2:], -center[:, :2], table[:, 3:]], 1)


def camera_of(cameras: Mapping[str, Camera], name: str) -> Camera:
    """A camera of a frame; DataError where the frame does not have it."""
    if name not in cameras:
        there = ", ".join(cameras) or "none"
        raise DataError(
            f"KITTI results need the camera '{name}' of the frame; it has {there}.\n"
            f"  fix: read the frame with dataset=kitti, or set its cameras from lidarfw.kitti.read_calibration"
        )
    return cameras[name]


def observation_angles(level: Array) -> Array:
    """Alpha (M,) of levelled boxes (M, 7): rotation_y less the bearing of the box from the camera."""
    return wrap_angle(-level[:, 6] - math.pi / 2 + np.arctan2(level[:, 1], level[:, 0]))


_SIGNS = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
_EDGES = np.array([(a, b) for a, b in itertools.combinations(range(8), 2) if (_SIGNS[a] != _SIGNS[b]).sum() == 1])


def _box_points(level: Array, cameras: Mapping[str, Camera]) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Points (M, 20, 3) in the frame of the picture's camera whose hull is the box in front of it, and which count.

    The 8 corners, and the places where the 12 edges pass the near plane.
    """
    cosine, sine, zero = np.cos(level[:, 6]), np.sin(level[:, 6]), np.zeros(len(level))
    turn = np.stack([cosine, -sine, zero, sine, cosine, zero, zero, zero, zero + 1], 1).reshape(-1, 3, 3)
    corners = (_SIGNS * level[:, None, 3:6]) @ turn.transpose(0, 2, 1) + level[:, None, :3]
    corners = np.stack([-corners[..., 1], -corners[..., 2], corners[..., 0]], -1)
    picture, rectified = (np.array(camera_of(cameras, name).from_sensor) for name in (IMAGE, RECTIFIED))
    matrix = picture @ np.linalg.inv(rectified)
    corners = corners @ matrix[:3, :3].T + matrix[:3, 3]
    start, end = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    crosses = (start[..., 2] < _NEAR) != (end[..., 2] < _NEAR)
    rise = np.where(crosses, end[..., 2] - start[..., 2], 1)
    crossings = start + ((_NEAR - start[..., 2]) / rise)[..., None] * (end - start)
    return np.concatenate([corners, crossings], 1), np.concatenate([corners[..., 2] >= _NEAR, crosses], 1)


def project_level_boxes(level: Array, cameras: Mapping[str, Camera]) -> Array:
    """2D boxes (M, 4) left, top, right, bottom of levelled boxes (M, 7), cut at the picture; 0 where out of sight."""
    camera = camera_of(cameras, IMAGE)
    points, counts = _box_points(level, cameras)
    fx, fy, cx, cy = camera.intrinsics
    depth = np.where(counts, points[..., 2], 1)
    uv = points[..., :2] / depth[..., None] * (fx, fy) + (cx, cy)
    border = np.array([camera.width - 1, camera.height - 1])
    low = np.where(counts[..., None], uv, np.inf).min(1).clip(0, border)
    high = np.where(counts[..., None], uv, -np.inf).max(1).clip(0, border)
    visible = ((high > low).all(1) & counts.any(1))[:, None]
    return np.where(visible, np.concatenate([low, high], 1), 0.0)


def labels_from_boxes(boxes: Boxes, classes: Sequence[str], cameras: Mapping[str, Camera]) -> list[Label]:
    """Result lines of the boxes of one frame, in their order; `cameras` are those of the frame's meta.

    Truncation and occlusion are -1 (results do not give them); the 2D box is that around the projected 3D box.
    """
    level = level_boxes(boxes, cameras)
    rectangles, alphas = project_level_boxes(level, cameras), observation_angles(level)
    rotations = wrap_angle(-level[:, 6] - math.pi / 2)
    bottom = np.stack([-level[:, 1], -level[:, 2] + level[:, 5] / 2, level[:, 0]], 1)
    columns: list[Any] = [boxes.label.tolist(), alphas.tolist(), rectangles.tolist(), level[:, [5, 4, 3]].tolist()]
    columns += [bottom.tolist(), rotations.tolist(), boxes.score.detach().cpu().double().tolist()]
    return [
        Label(classes[label], -1, -1, alpha, tuple(rectangle), tuple(size), tuple(place), rotation, score)
        for label, alpha, rectangle, size, place, rotation, score in zip(*columns, strict=True)
    ]


def read_tracks(path: str | Path, types: Sequence[str] = TRACKING_TYPES) -> list[TrackLabel]:
    """The objects of a label (17 columns) or result file (18 columns) of KITTI tracking, one sequence, in file order.

    DataError names file, line, column, expected and found value, as `read_labels` does.
    """
    rows = [(number, line.split()) for number, line in enumerate(read_text(path).splitlines(), 1) if line.strip()]
    return [_parse_track(values, f"{path}, line {number}", types) for number, values in rows]


def _parse_track(values: list[str], where: str, types: Sequence[str]) -> TrackLabel:
    if len(values) not in (17, 18):
        raise DataError(f"{where}: expected 17 columns (18 in results), found {len(values)}: {' '.join(values)[:80]}")
    frame, track = (
        _number(text, f"{where}: {name}") for text, name in zip(values, ("frame", "track id"), strict=False)
    )
    if frame < 0 or frame % 1 or track < -1 or track % 1:
        raise DataError(f"{where}: frame, track id: expected whole numbers from 0 (id -1 for none), found {values[:2]}")
    return TrackLabel(int(frame), int(track), _parse(values[2:], where, types))


def as_object(line: TrackLabel) -> TrackLabel:
    """A label in the terms of the object benchmark: truncation 0..1 for the levels 0..2, and its name of a type."""
    kind = "Person_sitting" if line.label.type == "Person" else line.label.type
    return replace(line, label=replace(line.label, type=kind, truncation=max(line.label.truncation / 2, -1.0)))


def write_tracks(path: str | Path, labels: Sequence[TrackLabel]) -> None:
    """Write a label or result file of KITTI tracking, atomically; an empty file for a sequence without objects."""
    write_text(path, "".join(label.line() + "\n" for label in labels))


def write_results(path: str | Path, labels: Sequence[Label]) -> None:
    """Write a label or result file, atomically; an empty file for a frame without objects."""
    write_text(path, "".join(label.line() + "\n" for label in labels))
