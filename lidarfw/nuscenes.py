"""The nuScenes tables (v1.0): scenes with their scans, pictures, poses and objects, read directly from the JSON files.

Source: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020, and its schema. The LiDAR's
frame there is x right, y ahead, z up; here it is x ahead, y left, z up: `FROM_NUSCENES`. A size there is width,
length, height.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lidarfw.errors import DataError

Array = npt.NDArray[np.float64]
Row = dict[str, Any]

FROM_NUSCENES = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])  # their LiDAR frame -> ours
CAMERAS = ("CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT")
LIDAR = "LIDAR_TOP"
CLASSES = (
    "car", "truck", "bus", "trailer", "construction_vehicle", "pedestrian", "motorcycle", "bicycle", "traffic_cone",
    "barrier",
)  # fmt: skip
TRACKED = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "trailer", "truck")  # of the tracking benchmark
CATEGORIES = {  # of the detection benchmark; other categories are not learnt
    "movable_object.barrier": "barrier",
    "movable_object.trafficcone": "traffic_cone",
    "vehicle.bicycle": "bicycle",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.car": "car",
    "vehicle.construction": "construction_vehicle",
    "vehicle.motorcycle": "motorcycle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.trailer": "trailer",
    "vehicle.truck": "truck",
}
_MOVING = {"vehicle.moving": 1, "pedestrian.moving": 1, "vehicle.parked": 0, "vehicle.stopped": 0}
_MOVING |= {"pedestrian.standing": 0, "pedestrian.sitting_lying_down": 0, "cycle.without_rider": 0}
_LONGEST = 1.5  # seconds between two annotations up to which they tell a velocity, as in the benchmark
_KEYS = {
    "scene": ("token", "name"),
    "sample": ("token", "scene_token", "timestamp"),
    "sample_data": (
        "sample_token", "ego_pose_token", "calibrated_sensor_token", "timestamp", "is_key_frame", "filename", "width",
        "height",
    ),
    "ego_pose": ("token", "translation", "rotation"),
    "calibrated_sensor": ("token", "sensor_token", "translation", "rotation", "camera_intrinsic"),
    "sensor": ("token", "channel"),
    "sample_annotation": (
        "token", "sample_token", "instance_token", "attribute_tokens", "translation", "size", "rotation", "prev",
        "next", "num_lidar_pts", "num_radar_pts",
    ),
    "instance": ("token", "category_token"),
    "category": ("token", "name"),
    "attribute": ("token", "name"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sweeps:
    """The scans of a scene in order of time, those between the key frames too."""

    files: list[str]  # from the root of the dataset
    times: Array  # (N,) seconds
    poses: Array  # (N, 4, 4) LiDAR, in our convention -> global


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of a key frame."""

    file: str
    size: tuple[int, int]  # width, height
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy
    pose: Array  # (4, 4) camera -> global


@dataclass(frozen=True, eq=False)
class Objects:
    """The annotations of a key frame, in the global frame."""

    center: Array  # (M, 3)
    size: Array  # (M, 3) length, width, height
    heading: Array  # (M, 3) unit vector
    velocity: Array  # (M, 3) m/s, NaN where it is not known
    category: list[str]
    track: npt.NDArray[np.int64]  # (M,) number of the instance in its table
    points: npt.NDArray[np.int64]  # (M,) LiDAR and radar points inside
    moving: npt.NDArray[np.int8]  # (M,) by the attribute: 1 moving, 0 static, -1 unknown


@dataclass(frozen=True, eq=False)
class Scene:
    """One scene of 20 seconds."""

    name: str
    sweeps: Sweeps
    keys: list[int]  # places of the key frames in the sweeps
    pictures: list[dict[str, Picture]]  # of every key frame, by channel
    objects: list[Objects]  # of every key frame


class Tables:
    """The JSON files of one version; DataError names the file and the key that is missing."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def rows(self, name: str) -> list[Row]:
        """The rows of a table."""
        path = self.folder / f"{name}.json"
        try:
            rows = json.loads(path.read_bytes())
        except OSError as error:
            raise DataError(
                f"cannot read {path}: {error.strerror or error}.\n"
                f"  fix: unpack the metadata, or correct root and version"
            ) from error
        except ValueError as error:
            raise DataError(f"{path}: is no JSON: {error}. Unpack the metadata again.") from error
        if not isinstance(rows, list):
            raise DataError(f"{path}: expected a list of rows, found {type(rows).__name__}")
        for number, row in enumerate(rows):
            missing = [key for key in _KEYS[name] if key not in row]
            if missing:
                raise DataError(f"{path}: row {number} has no {missing[0]}; it has {', '.join(row)}")
        return rows

    def by_token(self, name: str) -> Tokens:
        """The rows of a table by their token."""
        return Tokens(self.folder / f"{name}.json", {row["token"]: row for row in self.rows(name)})


@dataclass(frozen=True, eq=False)
class Tokens:
    """Rows by token; DataError where a token is not there."""

    path: Path
    rows: Mapping[str, Row]

    def __getitem__(self, token: str) -> Row:
        if token not in self.rows:
            raise DataError(f"{self.path}: has no token {token!r}, which another table names. Unpack them again.")
        return self.rows[token]


def scene_names(folder: Path) -> list[str]:
    """Names of all scenes of a version, in the order of its table."""
    return [row["name"] for row in Tables(folder).rows("scene")]


def read_scenes(folder: Path, names: Sequence[str]) -> dict[str, Scene]:
    """The scenes of these names, from the tables in `folder` (ROOT/v1.0-trainval)."""
    tables = Tables(folder)
    scenes = {row["token"]: row["name"] for row in tables.rows("scene") if row["name"] in set(names)}
    unknown = set(names) - set(scenes.values())
    if unknown:
        raise DataError(f"{folder / 'scene.json'}: has no scene {min(unknown)!r}.\n  fix: correct split or version")
    samples = {row["token"]: row for row in tables.rows("sample") if row["scene_token"] in scenes}
    data = _sensor_data(tables, samples)
    objects = _objects(tables, samples)
    found: dict[str, list[Row]] = {token: [] for token in scenes}
    for row in data:
        found[samples[row["sample_token"]]["scene_token"]].append(row)
    return {scenes[token]: _scene(scenes[token], rows, objects, folder) for token, rows in found.items()}


def _sensor_data(tables: Tables, samples: Mapping[str, Row]) -> list[Row]:
    """LiDAR scans, and pictures of key frames, with their channel, calibration and pose in the global frame."""
    channels, calibrated = tables.by_token("sensor"), tables.by_token("calibrated_sensor")
    chosen = []
    for row in tables.rows("sample_data"):
        if row["sample_token"] not in samples:
            continue
        sensor = calibrated[row["calibrated_sensor_token"]]
        channel = channels[sensor["sensor_token"]]["channel"]
        if channel == LIDAR or (channel in CAMERAS and row["is_key_frame"]):
            chosen.append({**row, "channel": channel, "sensor": sensor})
    needed = {row["ego_pose_token"] for row in chosen}
    path = tables.folder / "ego_pose.json"
    egos = Tokens(path, {row["token"]: row for row in tables.rows("ego_pose") if row["token"] in needed})
    vehicle = transforms([egos[row["ego_pose_token"]] for row in chosen], path)
    mounted = transforms([row["sensor"] for row in chosen], tables.folder / "calibrated_sensor.json")
    for row, pose in zip(chosen, vehicle @ mounted, strict=True):
        row["pose"] = pose
    return chosen


def lidar_poses(folder: Path) -> dict[str, Array]:
    """Pose (4, 4) of the LiDAR in the global frame, in our axes, at the key frame of every sample, by its token."""
    tables = Tables(folder)
    samples = {row["token"]: row for row in tables.rows("sample")}
    rows = [row for row in _sensor_data(tables, samples) if row["channel"] == LIDAR and row["is_key_frame"]]
    to_ours = FROM_NUSCENES.T  # a rotation: its inverse
    return {row["sample_token"]: row["pose"] @ to_ours for row in rows}


def transforms(rows: Sequence[Row], path: Path) -> Array:
    """(N, 4, 4) of rows with `translation` and `rotation` (quaternion w, x, y, z)."""
    from scipy.spatial.transform import Rotation  # slow to import

    try:
        shift = np.array([row["translation"] for row in rows], dtype=np.float64).reshape(-1, 3)
        turn = np.array([row["rotation"] for row in rows], dtype=np.float64).reshape(-1, 4)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}: expected translation of 3 and rotation of 4 numbers: {error}") from error
    wrong = ~(np.isfinite(shift).all(1) & (np.abs(np.linalg.norm(turn, axis=1) - 1) < 1e-2))
    if wrong.any():
        raise DataError(f"{path}: expected finite numbers and a quaternion of length 1, found {rows[wrong.argmax()]}")
    matrices = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        matrices[:, :3, :3] = Rotation.from_quat(turn[:, [1, 2, 3, 0]]).as_matrix()
    matrices[:, :3, 3] = shift
    return matrices


def _scene(name: str, rows: list[Row], objects: Mapping[str, Objects], folder: Path) -> Scene:
    scans = sorted((row for row in rows if row["channel"] == LIDAR), key=lambda row: row["timestamp"])
    keys = [place for place, row in enumerate(scans) if row["is_key_frame"]]
    pictures: dict[str, dict[str, Picture]] = {}
    for row in rows:
        if row["channel"] != LIDAR:
            pictures.setdefault(row["sample_token"], {})[row["channel"]] = _picture(row, folder)
    to_ours = FROM_NUSCENES.T  # a rotation: its inverse
    sweeps = Sweeps(
        [row["filename"] for row in scans],
        np.array([row["timestamp"] / 1e6 for row in scans]),
        np.array([row["pose"] for row in scans]).reshape(-1, 4, 4) @ to_ours,
    )
    tokens = [scans[place]["sample_token"] for place in keys]
    return Scene(name, sweeps, keys, [pictures.get(t, {}) for t in tokens], [objects[t] for t in tokens])


def _picture(row: Row, folder: Path) -> Picture:
    try:
        lens = np.array(row["sensor"]["camera_intrinsic"], dtype=np.float64).reshape(3, 3)
    except (TypeError, ValueError):
        found = row["sensor"]["camera_intrinsic"]
        raise DataError(
            f"{folder / 'calibrated_sensor.json'}: camera_intrinsic: expected 3 x 3 numbers, found {found}"
        ) from None
    intrinsics = (float(lens[0, 0]), float(lens[1, 1]), float(lens[0, 2]), float(lens[1, 2]))
    return Picture(row["filename"], (row["width"], row["height"]), intrinsics, row["pose"])


def _objects(tables: Tables, samples: Mapping[str, Row]) -> dict[str, Objects]:
    """The annotations of every sample, by its token."""
    rows = [row for row in tables.rows("sample_annotation") if row["sample_token"] in samples]
    instances = tables.by_token("instance")
    numbers = {token: number for number, token in enumerate(instances.rows)}
    categories, attributes = tables.by_token("category"), tables.by_token("attribute")
    poses = transforms(rows, tables.folder / "sample_annotation.json")
    velocity = _velocities(rows, poses[:, :3, 3], samples)
    size = np.array([row["size"] for row in rows], dtype=np.float64).reshape(-1, 3)[:, [1, 0, 2]]
    names = [categories[instances[row["instance_token"]]["category_token"]]["name"] for row in rows]
    track = np.array([numbers[row["instance_token"]] for row in rows], dtype=np.int64)
    points = np.array([row["num_lidar_pts"] + row["num_radar_pts"] for row in rows], dtype=np.int64)
    states = [[_MOVING.get(attributes[t]["name"], -1) for t in row["attribute_tokens"]] for row in rows]
    moving = np.array([max(state, default=-1) for state in states], dtype=np.int8)
    places: dict[str, list[int]] = {token: [] for token in samples}
    for number, row in enumerate(rows):
        places[row["sample_token"]].append(number)
    return {
        token: Objects(
            poses[at, :3, 3], size[at], poses[at, :3, 0], velocity[at], [names[i] for i in at], track[at], points[at],
            moving[at],
        )
        for token, at in ((token, np.array(place, dtype=np.int64)) for token, place in places.items())
    }  # fmt: skip


def _velocities(rows: Sequence[Row], center: Array, samples: Mapping[str, Row]) -> Array:
    """(M, 3) m/s by the annotations of the same object before and after; NaN where they are too far apart.

    The rule of the benchmark: across one interval up to 1.5 s, across two up to 3 s.
    """
    number = {row["token"]: place for place, row in enumerate(rows)}
    before = np.array([number.get(row["prev"], i) for i, row in enumerate(rows)], dtype=np.int64)
    after = np.array([number.get(row["next"], i) for i, row in enumerate(rows)], dtype=np.int64)
    time = np.array([samples[row["sample_token"]]["timestamp"] / 1e6 for row in rows])
    apart = time[after] - time[before]
    own = np.arange(len(rows))
    longest = _LONGEST * ((before != own).astype(int) + (after != own))
    known = (apart > 0) & (apart <= longest)
    speed = (center[after] - center[before]) / np.where(known, apart, 1)[:, None]
    return np.where(known[:, None], speed, np.nan)
