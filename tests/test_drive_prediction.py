"""Label files, maps and pictures of labelled drives."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarfw import draw
from lidarfw.components.datasets.semantic_kitti import CLASSES, label_ids
from lidarfw.drive_prediction import StaticMap, Strip, save_labels
from lidarfw.errors import ConfigError, DataError
from lidarfw.io import read_points
from lidarfw.ops import range_project
from lidarfw.types import Boxes, FrameMeta, FrameResult, PointLabels, Points, Poses, RangeView

MOVING = ("static", "moving")


def result(label: list[int], x: float = 0.0, index: int = 0) -> FrameResult:
    """Points at 1 m, 2 m, 3 m, ... ahead of a sensor that stands at x; label -1 is none."""
    xyz = torch.tensor([[1.0 + i, 0, 0] for i in range(len(label))]).view(-1, 3)
    points = Points.from_scan(xyz, torch.zeros(len(label), 1))
    probability = (torch.tensor(label)[:, None] == torch.arange(2)).float()
    pose = torch.eye(4)[None].clone()
    pose[0, 0, 3] = x
    inputs = {"points": points, "pose": Poses(pose, torch.ones(1, dtype=torch.bool), torch.ones(1))}
    inputs["range"] = range_project(points, RangeView(4, 16, math.radians(20), math.radians(-20)))
    meta = FrameMeta(f"{index:06d}", "08", index)
    return FrameResult(meta, {"head.seg": PointLabels(probability, points.batch)}, None, None, inputs)


def test_ids_of_the_benchmarks() -> None:
    assert label_ids(MOVING).tolist() == [9, 251, 9]
    assert label_ids(["moving", "static"]).tolist() == [251, 9, 9]
    ids = dict(zip(CLASSES, label_ids(CLASSES).tolist(), strict=False))
    assert (ids["car"], ids["other-vehicle"], ids["road"], ids["motorcyclist"], ids["traffic-sign"]) == (
        10, 20, 40, 32, 81,
    )  # fmt: skip
    with pytest.raises(ConfigError, match="no class 'Car'"):
        label_ids(["Car"])


def test_label_files(tmp_path: Path) -> None:
    path = save_labels(result([0, 1, -1]), tmp_path, MOVING)
    assert path == tmp_path / "sequences" / "08" / "predictions" / "000000.label"
    assert np.fromfile(path, "<u4").tolist() == [9, 251, 9]
    no_labels = FrameResult(FrameMeta("a"), {"head.boxes": Boxes.empty()})
    with pytest.raises(DataError, match="--format json"):
        save_labels(no_labels, tmp_path, MOVING)


def test_a_map_of_what_stands_still(tmp_path: Path) -> None:
    still = StaticMap(cell=0.5)
    still.add(result([0, 1, 0]))
    still.add(result([0, 0], x=1.0))  # at 2 m and 3 m of the map: the second frame knows that 2 m is static
    assert sorted(still.points()[:, 0].tolist()) == [1.25, 2.25, 3.25]
    still.write(tmp_path / "map.ply")
    assert read_points(tmp_path / "map.ply").xyz[:, 0].tolist() == [1.25, 2.25, 3.25]
    without = result([0])
    del without.inputs["pose"]
    with pytest.raises(DataError, match="needs the pose"):
        still.add(without)
    with pytest.raises(DataError, match="leaves out the class 'moving'"):
        StaticMap(classes=("car",))


def test_labels_in_the_range_image() -> None:
    frame = result([1, 0, 0])
    image, points = frame.inputs["range"], frame.inputs["points"]
    picture = draw.range_labels(image, points, frame.of(PointLabels), MOVING, scale=1)
    assert picture.shape == (4, 16, 3)
    colours = picture[picture.max(-1) > 0]
    assert len(colours) == 1  # all three are in one pixel, and the nearest moves
    red, green, blue = colours[0].tolist()
    assert red > 2 * max(green, blue)
    grey = draw.range_labels(image, points, result([0, 1, 1]).of(PointLabels), MOVING, scale=2)
    assert grey.shape == (8, 16, 3)
    assert np.ptp(grey, axis=-1).max() == 0


def test_a_strip_has_evenly_spaced_frames() -> None:
    strip = Strip(9, MOVING, most=3)
    for index in range(9):
        strip.add(result([0, 1], index=index))
    assert strip.wanted == {0, 4, 8}
    assert len(strip.pictures) == 3
    picture = strip.picture()
    assert picture.shape[1] == 3 * 906
    assert picture.shape[0] > 0.9 * max(p.shape[0] for p in strip.pictures)
