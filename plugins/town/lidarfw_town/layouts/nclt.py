"""NCLT: Carlevaris-Bianco et al., "University of Michigan North Campus long-term vision and lidar dataset", 2016."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from typing import Any, ClassVar

import numpy as np
from lidarfw.components.datasets.nclt import NcltDataset
from lidarfw.files import write_text

from lidarfw_town.drive import Drive, TownFrame
from lidarfw_town.layouts.base import TO_NED, Layout, Place, angles, rings, write_array

_BODY = np.diag([1.0, -1, -1, 1])  # x ahead, y left, z up <-> x ahead, y right, z down
_STEP, _OFFSET = 0.005, -100.0  # metres of a unit, and of 0
_POINT = np.dtype([("place", "<u2", (3,)), ("intensity", "u1"), ("laser", "u1")])


class NcltLayout(Layout):
    """NCLT: ROOT/SESSION/velodyne_sync/UTIME.bin and ROOT/ground_truth/groundtruth_SESSION.csv.

    Every session goes round the same circuit of one town, every second one the other way. The body is where the LiDAR
    is. Scans are compensated for ego motion; the format rounds them to 5 mm.
    """

    drives: ClassVar = {split: NcltDataset.splits[split] for split in ("train", "test")}
    one_town = True

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        begin = datetime.strptime(self.name(place.drive), "%Y-%m-%d").replace(tzinfo=timezone.utc)
        stamp = int(begin.timestamp()) * 1_000_000 + round(frame.time * 1e6)
        table = np.zeros(len(frame.points), _POINT)
        table["place"] = np.round((frame.points[:, :3] @ _BODY[:3, :3] - _OFFSET) / _STEP)
        table["intensity"], table["laser"] = np.round(frame.points[:, 3] * 255), rings(frame)
        write_array(self.root / self.name(place.drive) / "velodyne_sync" / f"{stamp}.bin", table, _POINT)
        body = TO_NED @ frame.pose @ _BODY
        return {"row": ",".join([str(stamp), *(f"{value:.9f}" for value in [*body[:3, 3].tolist(), *angles(body)])])}

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        for number, drive in enumerate(parts):
            rows = "".join(part["row"] + "\n" for part in drive)
            write_text(self.root / "ground_truth" / f"groundtruth_{self.name(number)}.csv", rows)
