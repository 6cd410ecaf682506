"""`python -m lidarfw_town.statistics`: how like real scans the town's are, as one figure and a table.

Both folders are read by the core's KITTI loader; sequences of SemanticKITTI, real or of the town, add whole scans.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
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
_GROUPS = {
    "road": (40, 60), "parking": (44,), "pavement": (48,), "terrain": (49, 72), "building": (50,), "fence": (51,),
    "vegetation": (70, 71), "pole, sign": (80, 81), "vehicle": (10, 13, 18, 20, 252, 256, 257, 258, 259),
    "person": (11, 15, 30, 31, 32, 253, 254, 255), "other": (0, 1, 52, 99),
}  # fmt: skip
_DISTANCES = np.array([4, 8, 12, 17, 23, 30, 40, 55, 75])  # metres between which the points on cars are counted
_REAL, _TOWN = "#111111", "#D55E00"


@dataclass(frozen=True, eq=False)
class Statistics:
    """Of whole scans: points a scan (S,), ranges (P,) in metres, remission (P,), moving points (S,), groups.

    `moving` are shares of the points of a scan, `groups` those of all points by class. Of labelled cars in the
    camera's view that nothing hides: distance (C,), points (C,), and size (C, 3) l, w, h.
    """

    counts: Array
    ranges: Array
    remission: Array
    moving: Array
    groups: dict[str, float]
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
            ("points without remission (%)", f"{100 * (self.remission == 0).mean():.1f}"),
            ("moving points (%)", f"{100 * np.average(self.moving, weights=self.counts):.2f}"),
            ("points on an unoccluded car at 10-20 m, median", f"{_median(self.car_points[near]):.0f}"),
            ("length, width, height of cars, mean (m)", _list(self.car_size, np.mean)),
            ("length, width, height of cars, deviation (m)", _list(self.car_size, np.std)),
            *((f"{name} (%)", f"{100 * share:.1f}") for name, share in self.groups.items()),
        ]


def _percentiles(values: Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in np.percentile(values, _TABLE))


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def _list(table: Array, what: Callable[[Array], float]) -> str:
    return " ".join(f"{what(column):.2f}" for column in table.T) if len(table) else "-"


def collect(objects: str | Path, sequences: str | Path) -> Statistics:
    """Statistics of a KITTI object folder (it holds training/) and a SemanticKITTI folder (it holds dataset/)."""
    scans = sorted(Path(sequences).glob("dataset/sequences/*/velodyne/*.bin"))
    if not scans:
        raise DataError(f"{sequences}: no scans in dataset/sequences/*/velodyne")
    tables = [np.fromfile(path, "<f4").reshape(-1, 4) for path in scans]
    labels = [np.fromfile(p.parents[1] / "labels" / f"{p.stem}.label", "<u4") & 0xFFFF for p in scans]
    points = np.concatenate(tables).astype(np.float64)
    moving = np.array([((label >= _MOVING[0]) & (label <= _MOVING[1])).mean() for label in labels])
    label = np.concatenate(labels)
    groups = {name: float(np.isin(label, ids).mean()) for name, ids in _GROUPS.items()}
    cars = _cars(str(objects))
    ranges = np.linalg.norm(points[:, :3], axis=1)
    counts = np.array([len(table) for table in tables], float)
    return Statistics(counts, ranges, points[:, 3], moving, groups, cars[:, 0], cars[:, 1], cars[:, 2:])


def _cars(root: str) -> Array:
    """Distance, points, length, width, height of the cars that nothing hides."""
    from lidarfw.components.datasets.kitti import KittiDataset
    from lidarfw.ops import points_per_box

    dataset = KittiDataset(root=root, split="all", classes=("Car",))
    rows = []
    for number in range(len(dataset)):
        frame = dataset[number]
        boxes = frame.targets.boxes
        if boxes is None or boxes.occlusion is None or boxes.truncation is None:
            raise DataError(f"{root}: frame {frame.meta.id} has no labels with occlusion and truncation")
        seen = (boxes.occlusion <= 0) & (boxes.truncation <= 0.05)
        inside = points_per_box(frame.inputs["points"].xyz, boxes.tensor)
        table = np.concatenate([boxes.center.norm(dim=1)[:, None], inside[:, None], boxes.size], 1)
        rows.append(table[np.asarray(seen)])
    return np.concatenate(rows).astype(np.float64)


def draw(path: str | Path, town: Statistics, real: Statistics) -> None:
    """Curves of both as one PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((15, 10), dpi=90, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(3, 3)
    _curves(axes[0, 0], town.counts / 1e3, real.counts / 1e3, np.linspace(100, 132, 33), "points a scan (thousands)")
    _curves(axes[0, 1], town.ranges, real.ranges, np.linspace(0, 85, 86), "range (m)")
    _curves(axes[0, 2], town.remission, real.remission, np.linspace(0, 1, 51), "remission")
    _against_distance(axes[1, 0], town, real)
    _cumulative(axes[1, 1], town.moving * 100, real.moving * 100, "moving points of a scan (%), cumulative")
    _shares(axes[1, 2], town, real)
    spans = ((2.8, 5.5, "length"), (1.3, 2.1, "width"), (1.2, 2.1, "height"))
    for column, (low, high, name) in enumerate(spans):
        edges = np.linspace(low, high, 19)
        ours, theirs = town.car_size[:, column], real.car_size[:, column]
        _curves(axes[2, column], ours, theirs, edges, f"{name} of cars (m)")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png")


def _finish(axes: Axes, title: str) -> None:
    axes.set_title(title, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False)


def _curves(axes: Axes, town: Array, real: Array, edges: Array, title: str) -> None:
    for values, name, colour in ((real, "real", _REAL), (town, "town", _TOWN)):
        values = values[(values >= edges[0]) & (values <= edges[-1])]
        if len(values):
            axes.hist(values, edges.tolist(), density=True, histtype="step", linewidth=1.6, color=colour, label=name)
    axes.set_yticks([])
    _finish(axes, title)


def _cumulative(axes: Axes, town: Array, real: Array, title: str) -> None:
    for values, name, colour in ((real, "real", _REAL), (town, "town", _TOWN)):
        axes.step(np.sort(values), np.linspace(0, 1, len(values)), where="post", color=colour, label=name)
    _finish(axes, title)


def _against_distance(axes: Axes, town: Statistics, real: Statistics) -> None:
    """Median and quartiles of the points on cars, by distance."""
    for one, name, colour in ((real, "real", _REAL), (town, "town", _TOWN)):
        which = np.digitize(one.car_distance, _DISTANCES)
        bins = [number for number in range(1, len(_DISTANCES)) if (which == number).sum() >= 2]
        if not bins:
            continue
        middle = [float(np.median(one.car_distance[which == number])) for number in bins]
        low, half, high = np.array([np.percentile(one.car_points[which == b], (25, 50, 75)) for b in bins]).T
        axes.plot(middle, np.maximum(half, 0.7), "o-", color=colour, label=name)
        axes.fill_between(middle, np.maximum(low, 0.7), np.maximum(high, 0.7), color=colour, alpha=0.18, linewidth=0)
    axes.set_yscale("symlog")
    axes.set_xlabel("distance (m)")
    _finish(axes, "points on unoccluded cars, median and quartiles")


def _shares(axes: Axes, town: Statistics, real: Statistics) -> None:
    place = np.arange(len(_GROUPS))[::-1]
    for one, name, colour, shift in ((real, "real", _REAL, 0.2), (town, "town", _TOWN, -0.2)):
        shares = [100 * one.groups[group] for group in _GROUPS]
        axes.barh(place + shift, shares, height=0.38, color=colour, label=name)
    axes.set_yticks(place.tolist(), list(_GROUPS))
    _finish(axes, "points by class (%)")


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
