"""`python -m lidarfw_town.statistics`: how like real scans the town's are, as one figure and a table.

Both folders are read by the core's KITTI loader; sequences of SemanticKITTI, real or of the town, add whole scans.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from lidarfw.errors import DataError, LidarfwError
from lidarfw.files import atomic_path

from lidarfw_town.mesh import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_TABLE = (5, 25, 50, 75, 95)  # percentiles
_MOVING = (252, 259)  # first and last of SemanticKITTI's moving classes


@dataclass(frozen=True, eq=False)
class Statistics:
    """Of whole scans: points a scan (S,), ranges (P,) in metres, remission (P,), share of moving points.

    Of labelled cars in the camera's view that nothing hides: distance (C,), points (C,), and size (C, 3) l, w, h.
    """

    counts: Array
    ranges: Array
    remission: Array
    moving: float
    car_distance: Array
    car_points: Array
    car_size: Array

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of what the table shows."""
        near = (self.car_distance > 10) & (self.car_distance < 20)
        return [
            ("points a scan", f"{self.counts.mean():.0f}"),
            ("range, percentiles 5 25 50 75 95 (m)", _percentiles(self.ranges, 1)),
            ("remission, percentiles 5 25 50 75 95", _percentiles(self.remission, 2)),
            ("moving points (%)", f"{100 * self.moving:.2f}"),
            ("points on an unoccluded car at 10-20 m, median", f"{np.median(self.car_points[near]):.0f}"),
            ("mean length, width, height of cars (m)", " ".join(f"{v:.2f}" for v in self.car_size.mean(0))),
        ]


def _percentiles(values: Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in np.percentile(values, _TABLE))


def collect(objects: str | Path, sequences: str | Path) -> Statistics:
    """Statistics of a KITTI object folder (it holds training/) and a SemanticKITTI folder (it holds dataset/)."""
    scans = sorted(Path(sequences).glob("dataset/sequences/*/velodyne/*.bin"))
    if not scans:
        raise DataError(f"{sequences}: no scans in dataset/sequences/*/velodyne")
    tables = [np.fromfile(path, "<f4").reshape(-1, 4) for path in scans]
    labels = [np.fromfile(p.parents[1] / "labels" / f"{p.stem}.label", "<u4") & 0xFFFF for p in scans]
    label, points = np.concatenate(labels), np.concatenate(tables).astype(np.float64)
    moving = float(((label >= _MOVING[0]) & (label <= _MOVING[1])).mean())
    cars = _cars(str(objects))
    ranges = np.linalg.norm(points[:, :3], axis=1)
    counts = np.array([len(table) for table in tables], float)
    return Statistics(counts, ranges, points[:, 3], moving, cars[:, 0], cars[:, 1], cars[:, 2:])


def _cars(root: str) -> Array:
    """Distance, points, length, width, height of the cars that nothing hides."""
    from lidarfw.components.datasets.kitti import KittiDataset
    from lidarfw.ops import points_in_boxes_mask

    dataset = KittiDataset(root=root, split="all", classes=("Car",))
    rows = []
    for number in range(len(dataset)):
        frame = dataset[number]
        boxes = frame.targets.boxes
        if boxes is None or boxes.occlusion is None or boxes.truncation is None:
            raise DataError(f"{root}: frame {frame.meta.id} has no labels with occlusion and truncation")
        seen = (boxes.occlusion <= 0) & (boxes.truncation <= 0.05)
        inside = points_in_boxes_mask(frame.inputs["points"].xyz, boxes.tensor).sum(0)
        table = np.concatenate([boxes.center.norm(dim=1)[:, None], inside[:, None], boxes.size], 1)
        rows.append(table[np.asarray(seen)])
    return np.concatenate(rows).astype(np.float64)


def draw(path: str | Path, town: Statistics, real: Statistics) -> None:
    """Histograms of both as one PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((13, 7.5), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    most = float(max(town.counts.max(), real.counts.max())) / 1000
    _histogram(
        axes[0, 0], town.counts / 1000, real.counts / 1000, np.linspace(0, most * 1.05, 61), "points a scan (1000)"
    )
    _histogram(axes[0, 1], town.ranges, real.ranges, np.linspace(0, 85, 86), "range (m)")
    _histogram(axes[0, 2], town.remission, real.remission, np.linspace(0, 1, 51), "remission")
    _against_distance(axes[1, 0], town, real)
    _histogram(axes[1, 1], town.car_size[:, 0], real.car_size[:, 0], np.linspace(2.8, 5.5, 19), "length of cars (m)")
    _histogram(axes[1, 2], town.car_size[:, 2], real.car_size[:, 2], np.linspace(1.2, 2.1, 19), "height of cars (m)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _histogram(axes: Axes, town: Array, real: Array, edges: Array, title: str) -> None:
    for values, name, colour in ((real, "real", "#111111"), (town, "town", "#D55E00")):
        axes.hist(values, edges.tolist(), density=True, histtype="step", linewidth=1.6, color=colour, label=name)
    axes.set_title(title, loc="left")
    axes.set_yticks([])
    axes.legend()


def _against_distance(axes: Axes, town: Statistics, real: Statistics) -> None:
    for one, name, colour in ((town, "town", "#D55E00"), (real, "real", "#111111")):
        axes.scatter(
            one.car_distance, np.maximum(one.car_points, 0.7), s=12, color=colour, alpha=0.6, linewidths=0, label=name
        )
    axes.set(yscale="log", xlabel="distance (m)")
    axes.set_title("points on unoccluded cars", loc="left")
    axes.legend()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; its exit code."""
    parser = argparse.ArgumentParser(prog="python -m lidarfw_town.statistics", description=__doc__)
    for name in ("town", "real"):
        parser.add_argument(f"--{name}-objects", required=True, help="folder of KITTI objects; it holds training/")
        parser.add_argument(f"--{name}-sequences", required=True, help="folder of SemanticKITTI; it holds dataset/")
    parser.add_argument("--out", required=True, help="the PNG")
    given = parser.parse_args(arguments)
    try:
        town = collect(given.town_objects, given.town_sequences)
        real = collect(given.real_objects, given.real_sequences)
    except LidarfwError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for (name, ours), (_, theirs) in zip(town.rows(), real.rows()):
        print(f"| {name} | {ours} | {theirs} |")
    draw(given.out, town, real)
    return 0


if __name__ == "__main__":
    sys.exit(main())
