"""The Oxford Radar RobotCar dataset: Barnes et al., ICRA 2020; with boxes beside the scans."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from lidarfw.components.datasets.drives import from_angles, inverse
from lidarfw.components.datasets.oxford import OxfordDataset
from lidarfw.files import write_text

from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.layouts.base import TO_NED, Layout, Place, angles, box_lines, write_array
from lidarfw_town.mesh import Array

_NAMES = dict.fromkeys(("car", "van", "truck", "bus"), "Vehicle")
_NAMES |= {"cyclist": "Cyclist", "motorcyclist": "Cyclist", "pedestrian": "Pedestrian"}
_TO_VELODYNE = np.diag([-1.0, 1, -1, 1])  # x ahead, y left, z up -> x back, y left, z down
_ORIGIN = (5_735_000.0, 620_000.0, 0.0)  # northing, easting, down of the town's origin
# on the vehicle (x ahead, y right, z down): x y z roll pitch yaw
_MOUNTED = {"velodyne_left": (-0.60, -0.34, -0.27, 0.0, 0.0, np.pi), "ins": (-1.71, 0.12, 1.19, 0.0, 0.0, 0.0)}
_HEADER = (
    "timestamp,ins_status,latitude,longitude,altitude,northing,easting,down,utm_zone,velocity_north,velocity_east,"
    "velocity_down,roll,pitch,yaw\n"
)
_AROUND = (-0.4, -0.2, 0.0, 0.2, 0.4)  # periods: 50 rows of the inertial unit in a second, as there


class OxfordLayout(Layout):
    """Oxford Radar RobotCar: ROOT/TRAVERSAL-radar-oxford-10k with velodyne_left, gps/ins.csv, boxes; ROOT/extrinsics.

    Every traversal goes round the same circuit of one town, every second one the other way, with other parked
    vehicles, traffic and light. Scans are compensated for ego motion.
    """

    drives: ClassVar = {split: OxfordDataset.splits[split] for split in ("train", "test")}
    one_town = True

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        folder, stamp = self._folder(place.drive), self._stamp(place.drive, frame.time)
        table = np.concatenate([frame.points[:, :3] @ _TO_VELODYNE[:3, :3], frame.points[:, 3:] * 255], 1)
        write_array(folder / "velodyne_left" / f"{stamp}.bin", table.T)
        write_text(folder / "boxes" / f"{stamp}.txt", box_lines(frame, _NAMES))
        moments = frame.number + np.array(_AROUND)
        stamps = [self._stamp(place.drive, float(moment) * drive.lidar.turn) for moment in moments]
        return {"stamps": stamps, "poses": drive.poses(moments).tolist()}

    def _folder(self, drive: int) -> Path:
        return self.root / f"{self.name(drive)}-radar-oxford-10k"

    def _stamp(self, drive: int, seconds: float) -> int:
        """Microseconds since 1970, from the begin of the traversal that its name says."""
        begin = datetime.strptime(self.name(drive), "%Y-%m-%d-%H-%M-%S").replace(tzinfo=timezone.utc)
        return int(begin.timestamp()) * 1_000_000 + round(seconds * 1e6)

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for name, mount in _MOUNTED.items():
            write_text(self.root / "extrinsics" / f"{name}.txt", " ".join(f"{value:.15g}" for value in mount) + "\n")
        for number, drive in enumerate(parts):
            stamps = [stamp for part in drive for stamp in part["stamps"]]
            poses = np.concatenate([part["poses"] for part in drive])
            rows = (f"{s},{_ins_row(p)}\n" for s, p in zip(stamps, inertial_poses(poses)))
            write_text(self._folder(number) / "gps" / "ins.csv", _HEADER + "".join(rows))


def inertial_poses(poses: Array) -> Array:
    """Poses (F, 4, 4) of the inertial unit in northing, easting, down, of those of the LiDAR in the world."""
    vehicle = {name: from_angles(np.array([mount]))[0] for name, mount in _MOUNTED.items()}
    from_inertial = inverse(_TO_VELODYNE) @ inverse(vehicle["velodyne_left"]) @ vehicle["ins"]
    found = TO_NED @ poses @ from_inertial
    found[:, :3, 3] += _ORIGIN
    return np.asarray(found)


def _ins_row(pose: Array) -> str:
    """The values of a row after its time; what no loader needs is constant."""
    place = ",".join(f"{value:.6f}" for value in pose[:3, 3])
    turn = ",".join(f"{value:.9f}" for value in angles(pose))
    return f"INS_SOLUTION_GOOD,51.76,-1.26,110,{place},30U,0,0,0,{turn}"
