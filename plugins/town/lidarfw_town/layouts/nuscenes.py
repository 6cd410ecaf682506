"""nuScenes v1.0: Caesar et al., "nuScenes: a multimodal dataset for autonomous driving", CVPR 2020, and its schema."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from lidarfw.components.datasets.drives import inverse
from lidarfw.files import write_text
from lidarfw.nuscenes import CAMERAS, FROM_NUSCENES, LIDAR
from lidarfw.types import Camera

from lidarfw_town.drive import Drive, Object, TownFrame
from lidarfw_town.layouts.base import Layout, Place, rings, write_array, write_picture
from lidarfw_town.mesh import Array
from lidarfw_town.render import photograph

Row = dict[str, Any]

_KEY = 5  # steps of 0.1 s from one key frame to the next
_BEGIN = 1_532_400_000_000_000  # microseconds
_HOUR = 3_600_000_000
_MOUNT = np.array([[1.0, 0, 0, 0.94], [0, 1, 0, 0], [0, 0, 1, 1.84], [0, 0, 0, 1]])  # LiDAR in the vehicle, our axes
_FIRST_PARKED = 10_000  # ids from here on stand in a slot
_YAWS = dict(zip(CAMERAS, (0, -55, -110, 180, 110, 55)))  # degrees
_CATEGORIES = {
    "car": "vehicle.car", "van": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid",
    "pedestrian": "human.pedestrian.adult", "cyclist": "vehicle.bicycle", "motorcyclist": "vehicle.motorcycle",
}  # fmt: skip
_ATTRIBUTES = (
    "vehicle.moving", "vehicle.stopped", "vehicle.parked", "cycle.with_rider", "pedestrian.moving",
    "pedestrian.standing",
)  # fmt: skip
_VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}
_TABLES = (
    "category", "attribute", "visibility", "instance", "sensor", "calibrated_sensor", "ego_pose", "log", "scene",
    "sample", "sample_data", "sample_annotation", "map",
)  # fmt: skip


def _scenes(*numbers: int) -> tuple[str, ...]:
    return tuple(f"scene-{number:04d}" for number in numbers)


class NuScenesLayout(Layout):
    """nuScenes: ROOT/v1.0-trainval with the tables, ROOT/samples and ROOT/sweeps. Every scene is in another town.

    Frames are scans, ten a second (there are twenty there), every fifth is a key frame with pictures and annotations.
    Scans are compensated for ego motion. `width` is that of the six pictures.
    """

    drives: ClassVar = {  # numbers that the splits of the dataset have
        "train": _scenes(1, 2, *range(4, 12), *range(19, 35)),
        "val": _scenes(3, *range(12, 19), 35, 36, 38, 39),
    }

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        scene, key = self.name(place.drive), frame.number % _KEY == 0
        time = _BEGIN + int(scene[-4:]) * _HOUR + round(frame.time * 1e6)
        xyz = frame.points[:, :3] @ FROM_NUSCENES[:3, :3]
        table = np.concatenate([xyz, np.round(frame.points[:, 3:] * 255), rings(frame)[:, None]], 1)
        files = {LIDAR: self._file(LIDAR, scene, time, key, "pcd.bin")}
        write_array(self.root / files[LIDAR], table)
        for channel, camera in cameras(self.width).items() if key and self.width else ():
            files[channel] = self._file(channel, scene, time, key, "png")
            write_picture(self.root / files[channel], photograph(drive, frame, camera).image)
        objects = [_annotated(thing, frame.pose) for thing in frame.objects if thing.kind in _CATEGORIES]
        ego = frame.pose @ inverse(_MOUNT)
        return {"time": time, "key": key, "files": files, "ego": _placed(ego), "objects": objects if key else []}

    def _file(self, channel: str, scene: str, time: int, key: bool, suffix: str) -> str:
        return f"{'samples' if key else 'sweeps'}/{channel}/{scene}__{channel}__{time}.{suffix}"

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        """Add the scenes to the tables, which may hold those of another split."""
        tables: dict[str, list[Row]] = {name: [] for name in _TABLES}
        _constant(tables, self.width)
        for number, drive in enumerate(parts):
            _Scene(self.name(number), tables, self.width).add(drive)
        for name, rows in tables.items():
            _merge(self.root / "v1.0-trainval" / f"{name}.json", rows)


def cameras(width: int) -> dict[str, Camera]:
    """The six cameras: around the LiDAR, and the one that looks back and widest at the tail."""
    found = {}
    for channel, degrees in _YAWS.items():
        focal, reach, drop = (0.5, 2.7, 0.7) if degrees == 180 else (0.79, 0.5, 0.3)
        yaw = math.radians(degrees)
        ahead, right = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([math.sin(yaw), -math.cos(yaw), 0])
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, [0, 0, -1], ahead], 1)
        pose[:3, 3] = reach * ahead - (0, 0, drop)
        height = round(width * 9 / 16)
        lens = (focal * width, focal * width, (width - 1) / 2, (height - 1) / 2)
        found[channel] = Camera("pinhole", width, height, lens).transformed(pose)
    return found


def token(*words: str | int) -> str:
    """32 hexadecimal digits that name a row."""
    return hashlib.md5("/".join(map(str, words)).encode(), usedforsecurity=False).hexdigest()


def _placed(matrix: Array) -> Row:
    """Translation and rotation (quaternion w, x, y, z) of a transform (4, 4)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
    return {"translation": matrix[:3, 3].tolist(), "rotation": [w, x, y, z]}


def _annotated(thing: Object, pose: Array) -> Row:
    """What an annotation says of an object of a scan with a pose."""
    x, y, z, length, width, height, yaw = thing.box
    box = np.eye(4)
    box[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    box[:3, 3] = x, y, z
    row = {"id": thing.id, "category": _CATEGORIES[thing.kind], "size": [width, length, height]}
    row |= {"attribute": _attribute(thing), "visibility": str(1 + int(np.searchsorted((0.4, 0.6, 0.8), thing.visible)))}
    return row | {"num_lidar_pts": thing.points, **_placed(pose @ box)}


def _attribute(thing: Object) -> str:
    if thing.kind in ("cyclist", "motorcyclist"):
        return "cycle.with_rider"
    if thing.kind == "pedestrian":
        return "pedestrian.moving" if thing.moving else "pedestrian.standing"
    still = "vehicle.parked" if thing.id >= _FIRST_PARKED else "vehicle.stopped"
    return "vehicle.moving" if thing.moving else still


def _constant(tables: dict[str, list[Row]], width: int) -> None:
    """The rows that no frame changes."""
    tables["category"] = [_named("category", name) for name in dict.fromkeys(_CATEGORIES.values())]
    tables["attribute"] = [_named("attribute", name) for name in _ATTRIBUTES]
    tables["visibility"] = [{"token": t, "level": level, "description": level} for t, level in _VISIBILITY.items()]
    lidar = _placed(_MOUNT @ FROM_NUSCENES) | {"camera_intrinsic": []}
    rows = {LIDAR: lidar}
    for channel, camera in cameras(width).items() if width else ():
        fx, fy, cx, cy = camera.intrinsics
        place = _placed(_MOUNT @ inverse(np.array(camera.from_sensor)))
        rows[channel] = place | {"camera_intrinsic": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}
    for channel, row in rows.items():
        kind = "lidar" if channel == LIDAR else "camera"
        tables["sensor"].append({"token": token("sensor", channel), "channel": channel, "modality": kind})
        links = {"token": token("calibrated_sensor", channel), "sensor_token": token("sensor", channel)}
        tables["calibrated_sensor"].append(links | row)


def _named(table: str, name: str) -> Row:
    return {"token": token(table, name), "name": name, "description": name}


class _Scene:
    """Adds the rows of a scene to the tables."""

    def __init__(self, name: str, tables: dict[str, list[Row]], width: int) -> None:
        self.name, self.tables, self.width = name, tables, width

    def add(self, frames: Sequence[Row]) -> None:
        """Rows of its frames, in order of time."""
        keys = [frame for frame in frames if frame["key"]]
        log = token("log", self.name)
        samples = [
            {"token": token("sample", self.name, frame["time"]), "timestamp": frame["time"], "scene_token": self.token}
            for frame in keys
        ]
        first, last = samples[0]["token"], samples[-1]["token"]
        row = {"token": self.token, "log_token": log, "nbr_samples": len(keys), "name": self.name, "description": ""}
        self.tables["scene"].append(row | {"first_sample_token": first, "last_sample_token": last})
        place = {"vehicle": "town", "date_captured": "2018-07-24", "location": "town"}
        self.tables["log"].append({"token": log, "logfile": self.name} | place)
        ground = {"category": "semantic_prior", "filename": "", "log_tokens": [log]}
        self.tables["map"].append({"token": token("map", self.name)} | ground)
        self.tables["sample"] += _linked(samples)
        self._data(frames, samples)
        self._annotations(keys, samples)

    @property
    def token(self) -> str:
        return token("scene", self.name)

    def _data(self, frames: Sequence[Row], samples: Sequence[Row]) -> None:
        """The files of every channel, each with the pose of the vehicle; sweeps belong to the nearest key frame."""
        times = np.array([sample["timestamp"] for sample in samples])
        rows: dict[str, list[Row]] = {}
        for frame in frames:
            nearest = samples[int(np.abs(times - frame["time"]).argmin())]["token"]
            for channel, file in frame["files"].items():
                width, height = (0, 0) if channel == LIDAR else (self.width, round(self.width * 9 / 16))
                own = token("sample_data", self.name, file)
                links = {"token": own, "sample_token": nearest, "ego_pose_token": own}
                links |= {"calibrated_sensor_token": token("calibrated_sensor", channel), "timestamp": frame["time"]}
                what = {"fileformat": file.rpartition(".")[2].replace("bin", "pcd"), "is_key_frame": frame["key"]}
                size = {"height": height, "width": width, "filename": file}
                rows.setdefault(channel, []).append(links | what | size)
                self.tables["ego_pose"].append({"token": own, "timestamp": frame["time"]} | frame["ego"])
        self.tables["sample_data"] += itertools.chain.from_iterable(map(_linked, rows.values()))

    def _annotations(self, keys: Sequence[Row], samples: Sequence[Row]) -> None:
        """Those of every object over the key frames, and the object itself."""
        rows: dict[int, list[Row]] = {}
        for frame, sample in zip(keys, samples):
            for thing in frame["objects"]:
                own = {"token": token("annotation", sample["token"], thing["id"]), "sample_token": sample["token"]}
                own |= {"instance_token": token("instance", self.name, thing["id"])}
                own |= {"attribute_tokens": [token("attribute", thing["attribute"])]}
                own |= {"visibility_token": thing["visibility"], "num_radar_pts": 0}
                kept = ("translation", "size", "rotation", "num_lidar_pts")
                rows.setdefault(thing["id"], []).append(own | {key: thing[key] for key in kept})
        categories = {thing["id"]: thing["category"] for frame in keys for thing in frame["objects"]}
        for number, own_rows in rows.items():
            self.tables["sample_annotation"] += _linked(own_rows)
            category = token("category", categories[number])
            ends = {"first_annotation_token": own_rows[0]["token"], "last_annotation_token": own_rows[-1]["token"]}
            instance = {"token": own_rows[0]["instance_token"], "category_token": category}
            self.tables["instance"].append(instance | {"nbr_annotations": len(own_rows)} | ends)


def _linked(rows: Sequence[Row]) -> list[Row]:
    """Rows with the token of the one before and after, "" at the ends."""
    tokens = ["", *(row["token"] for row in rows), ""]
    return [row | {"prev": tokens[n], "next": tokens[n + 2]} for n, row in enumerate(rows)]


def _merge(path: Path, rows: Sequence[Row]) -> None:
    """Write a table with the rows that are there and these, in an order that does not depend on who came first."""
    there = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    whole = {row["token"]: row for row in [*there, *rows]}
    ordered = sorted(whole.values(), key=lambda row: (row.get("name", ""), row.get("timestamp", 0), row["token"]))
    write_text(path, json.dumps(ordered, indent=0) + "\n")
