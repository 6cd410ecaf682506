"""NCLT: Carlevaris-Bianco et al., "University of Michigan North Campus long-term vision and lidar dataset", 2016."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any, ClassVar

import numpy as np
from lidarfw.components.datasets.drives import from_angles, inverse
from lidarfw.components.datasets.nclt import LIDAR, RIG, NcltDataset
from lidarfw.files import write_text
from lidarfw.types import Camera

from lidarfw_town.camera import ladybug_cameras
from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.layouts.base import TO_NED, Layout, Place, angles, rings, write_array, write_picture
from lidarfw_town.render import photograph

_BODY = np.diag([1.0, -1, -1, 1])  # x ahead, y left, z up <-> x ahead, y right, z down
_STEP, _OFFSET = 0.005, -100.0  # metres of a unit, and of 0
_POINT = np.dtype([("place", "<u2", (3,)), ("intensity", "u1"), ("laser", "u1")])
_TO_LIDAR = np.block([[np.eye(3), -LIDAR[:, None]], [np.zeros(3), 1]]) @ _BODY  # from the body


class NcltLayout(Layout):
    """NCLT: ROOT/SESSION/{velodyne_sync,lb3}, ROOT/ground_truth, ROOT/{cam_params,U2D_ALL_1616X1232}.

    Every session goes round the same circuit of one town, every second one the other way. Scans are compensated for
    ego motion; the format rounds them to 5 mm, and has no room for points over 100 m behind, left or above. Pictures
    of all six cameras are taken at the moment of the scan by lenses without distortion. `width` is theirs; they lie on
    their side.
    """

    drives: ClassVar = {split: NcltDataset.splits[split] for split in ("train", "test")}
    one_town = True

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        session = self.root / self.name(place.drive)
        begin = datetime.strptime(session.name, "%Y-%m-%d").replace(tzinfo=timezone.utc)
        stamp = int(begin.timestamp()) * 1_000_000 + round(frame.time * 1e6)
        write_array(session / "velodyne_sync" / f"{stamp}.bin", _scan(frame), _POINT)
        for name, camera in ladybug_cameras(self.width).items() if self.width else ():
            write_picture(session / "lb3" / name / f"{stamp}.tiff", photograph(drive, frame, camera).image)
        body = TO_NED @ frame.pose @ _TO_LIDAR
        return {"row": ",".join([str(stamp), *(f"{value:.9f}" for value in [*body[:3, 3].tolist(), *angles(body)])])}

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for number, drive in enumerate(parts):
            rows = "".join(part["row"] + "\n" for part in drive)
            write_text(self.root / "ground_truth" / f"groundtruth_{self.name(number)}.csv", rows)
        for name, camera in ladybug_cameras(self.width).items() if self.width else ():
            self._calibration(name, camera)

    def _calibration(self, name: str, camera: Camera) -> None:
        fx, fy, cx, cy = camera.intrinsics
        folder, rig = self.root / "cam_params", from_angles(np.array([[*RIG[:3], *np.radians(RIG[3:])]]))[0]
        place = inverse(np.array(camera.from_sensor) @ _TO_LIDAR @ rig)
        row = [*place[:3, 3].tolist(), *np.degrees(angles(place)).tolist()]
        write_text(folder / f"K_{name.lower()}.csv", _table([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        write_text(folder / f"x_lb3_c{name[-1]}.csv", _table([row]))
        head = f"width/cols = {camera.width} , height/rows = {camera.height}\n"
        pixels = (f"{row} {column} {row} {column}\n" for row in range(camera.height) for column in range(camera.width))
        write_text(self.root / "U2D_ALL_1616X1232" / f"U2D_{name}_1616X1232.txt", head + "".join(pixels))


def _scan(frame: TownFrame) -> np.ndarray:
    """The points that the format can hold, -100 to 227.67 m along each axis of the body; others would wrap round."""
    places = np.round(((frame.points[:, :3] + LIDAR) @ _BODY[:3, :3] - _OFFSET) / _STEP)
    held = ((places >= 0) & (places <= np.iinfo(np.uint16).max)).all(1)
    table = np.zeros(held.sum(), _POINT)
    table["place"], table["laser"] = places[held], rings(frame)[held]
    table["intensity"] = np.round(frame.points[held, 3] * 255)
    return table


def _table(rows: Sequence[Sequence[float]]) -> str:
    return "".join(",".join(f"{value:.12f}" for value in row) + "\n" for row in rows)
