"""Writes nuScenes tables: the vehicle's and sensors' poses are given as matrices, objects in the global frame."""

from __future__ import annotations

import json
from pathlib import Path

from scipy.spatial.transform import Rotation

CATEGORIES = ("vehicle.car", "human.pedestrian.adult", "animal", "vehicle.bicycle")
ATTRIBUTES = ("vehicle.moving", "vehicle.parked", "pedestrian.standing", "cycle.with_rider")


def pose(matrix) -> dict:
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    return {"translation": list(map(float, matrix[:3, 3])), "rotation": [float(w), float(x), float(y), float(z)]}


class Writer:
    """Rows of the tables, in the order in which they are added."""

    def __init__(self, categories=CATEGORIES):
        names = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor", "sample_annotation")
        self.tables: dict[str, list[dict]] = {name: [] for name in (*names, "instance", "category", "attribute")}
        self.category = {name: self.add("category", name=name) for name in categories}
        self.attribute = {name: self.add("attribute", name=name) for name in ATTRIBUTES}
        self.last: dict[str, dict] = {}

    def add(self, table, **values) -> str:
        token = f"{table}-{len(self.tables[table])}"
        self.tables[table].append({"token": token, **values})
        return token

    def sensor(self, channel, matrix, lens=()) -> str:
        sensor = self.add("sensor", channel=channel, modality="lidar")
        return self.add("calibrated_sensor", sensor_token=sensor, camera_intrinsic=lens, **pose(matrix))

    def data(self, sample, sensor, time, ego, file, key=True, size=(0, 0)) -> str:
        ego_pose = self.add("ego_pose", timestamp=time, **pose(ego))
        links = {"sample_token": sample, "ego_pose_token": ego_pose, "calibrated_sensor_token": sensor}
        values = {"timestamp": time, "is_key_frame": key, "filename": file, "width": size[0], "height": size[1]}
        return self.add("sample_data", **links, **values)

    def object(self, sample, instance, matrix, size, points, category, attribute=None) -> None:
        if instance not in self.last:
            token = self.add("instance", category_token=self.category[category])
            self.last[instance] = {"instance_token": token, "token": ""}
        before = self.last[instance]
        row = {
            "sample_token": sample,
            "instance_token": before["instance_token"],
            "attribute_tokens": [self.attribute[attribute]] if attribute else [],
            "size": [size[1], size[0], size[2]],
            "prev": before["token"],
            "next": "",
            "num_lidar_pts": points,
            "num_radar_pts": 0,
            **pose(matrix),
        }
        before["next"] = self.add("sample_annotation", **row)
        self.last[instance] = self.tables["sample_annotation"][-1]

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.tables.items():
            (folder / f"{name}.json").write_text(json.dumps(rows))
