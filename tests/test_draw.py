"""Pictures show what they should, where it should be: read back from their pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from lidarfw import draw
from lidarfw.errors import DataError
from lidarfw.types import Boxes, Camera, PointLabels, Points, RangeImage, RangeView, Tracks

CLASSES = ("Car", "Pedestrian", "Cyclist")
TURN = ((0.0, -1.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
CAMERA = Camera("pinhole", 640, 480, (500.0, 500.0, 320.0, 240.0), (), TURN)
EXTENT = (-20.0, 20.0, -20.0, 20.0)


def boxes(*rows: tuple[float, ...], label: int = 0, score: float = 0.75) -> Boxes:
    tensor = torch.tensor(rows, dtype=torch.float32).reshape(-1, 7)
    return Boxes.from_tensor(tensor, torch.full((len(rows),), label), torch.full((len(rows),), score))


def scan(count: int = 500) -> Points:
    rng = np.random.default_rng(0)
    return Points.from_scan(torch.tensor(rng.uniform(-20, 20, (count, 3))).float(), torch.rand(count, 1))


def pixels(picture: draw.Picture, colour: str, tolerance: int = 12) -> np.ndarray:
    """Row and column (K, 2) of the pixels of a colour."""
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return np.argwhere((np.abs(picture.astype(int) - rgb) <= tolerance).all(-1))


@pytest.fixture(scope="module")
def place() -> Callable[[float, float], np.ndarray]:
    """Row and column of a place x, y in pictures of EXTENT, by two small boxes at its corners."""
    ends = boxes((19.9, 19.9, 0, 0.1, 0.1, 1, 0), (-19.9, -19.9, 0, 0.1, 0.1, 1, 0), label=1)
    picture = draw.birds_eye(None, ends, extent=EXTENT)
    found = pixels(picture, draw.colour_of(1))
    inside = found[found[:, 1] < picture.shape[1] * 0.815]  # without the legend
    first, last = inside.min(0), inside.max(0)
    return lambda x, y: first + (last - first) * (np.array([20 - x, 20 - y]) / 40)


def near(found: np.ndarray, pixel: np.ndarray, reach: float = 4) -> bool:
    return bool((np.abs(found - pixel).max(1) < reach).any())


def test_a_box_stands_at_its_place_seen_from_above(place: Callable[[float, float], np.ndarray]) -> None:
    """x is up and y to the left."""
    picture = draw.birds_eye(scan(), boxes((10, -5, 0, 6, 4, 2, 0)), classes=CLASSES, extent=EXTENT)
    found = pixels(picture, draw.colour_of(0))
    for x in (7, 13):
        for y in (-3, -7):
            assert near(found, place(x, y))
            assert not near(found, place(x, -y), 20)
    assert not near(found, place(6, -5), 8)


@pytest.mark.parametrize("yaw", [0.0, math.pi / 2, 2.5])
def test_the_heading_line_sticks_out_in_front(yaw: float, place: Callable[[float, float], np.ndarray]) -> None:
    found = pixels(draw.birds_eye(None, boxes((1, 2, 0, 10, 6, 2, yaw)), extent=EXTENT), draw.colour_of(0))
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    assert near(found, place(*(np.array([1, 2]) + 6 * ahead)))
    assert not near(found, place(*(np.array([1, 2]) - 6 * ahead)), 8)


def test_truth_and_predictions_and_tracks_are_told_apart() -> None:
    truth, found = boxes((5, 5, 0, 4, 2, 2, 0)), boxes((-5, -5, 0, 4, 2, 2, 0), label=2)
    plain = draw.birds_eye(scan(), None, extent=EXTENT)
    both = draw.birds_eye(scan(), found, truth, CLASSES, extent=EXTENT)
    tracks = draw.birds_eye(scan(), Tracks(found, torch.tensor([17])), truth, CLASSES, extent=EXTENT)
    assert len(pixels(both, draw.colour_of(2), 3)) > len(pixels(plain, draw.colour_of(2), 3)) + 50
    assert plain.shape == both.shape == tracks.shape
    assert (both != tracks).any()  # score and number
    assert len(pixels(both, "#111111")) > len(pixels(plain, "#111111")) + 50


@pytest.mark.parametrize(
    ("points", "found"), [(None, None), (None, boxes()), (scan(0), boxes()), (scan(1), boxes((0, 0, 0, 1, 1, 1, 0)))]
)
def test_little_or_nothing_gives_a_picture(points: Points | None, found: Boxes | None) -> None:
    picture = draw.birds_eye(points, found, boxes(), CLASSES)
    assert picture.dtype == np.uint8
    assert picture.shape[2] == 3
    assert picture.std() > 0


def test_colour_by_intensity_and_unknown_colour() -> None:
    assert (draw.birds_eye(scan(), colour="intensity") != draw.birds_eye(scan())).any()
    with pytest.raises(ValueError, match="height or intensity"):
        draw.birds_eye(scan(), colour="smell")


def test_points_by_class_and_grey_where_unlabelled(place: Callable[[float, float], np.ndarray]) -> None:
    xyz = torch.tensor([[10.0, 10, 0], [-10, 10, 0], [0, -10, 0]])
    points = Points.from_scan(xyz, torch.zeros(3, 0))
    labels = PointLabels(torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, 0, 0]]), points.batch)
    picture = draw.birds_eye(points, None, None, CLASSES, labels=labels, extent=EXTENT)
    for (x, y, _), colour in zip(xyz.tolist(), (draw.colour_of(0), draw.colour_of(2), "#BBBBBB"), strict=True):
        assert near(pixels(picture, colour, 40), place(x, y))


# Camera


def drawn(camera: Camera, box: Boxes) -> np.ndarray:
    """Pixels that drawing a box changed."""
    grey = np.full((camera.height, camera.width, 3), 128, np.uint8)
    return np.argwhere((draw.camera_view(grey, camera, box, classes=CLASSES) != grey).any(-1))


def test_a_box_covers_its_pixels_in_the_picture() -> None:
    """Hand projection: the near face, 8 m ahead, is 2 x 2 m: 125 pixels; the caption stands above."""
    found = drawn(CAMERA, boxes((10, 0, 0, 4, 2, 2, 0)))
    assert np.abs(found[:, 1].min() - (320 - 62.5)) < 4
    assert np.abs(found[:, 1].max() - (320 + 62.5)) < 4
    assert np.abs(found[:, 0].max() - (240 + 62.5)) < 4


@pytest.mark.parametrize(
    "row", [(-10.0, 0, 0, 4, 2, 2, 0), (10.0, 100.0, 0, 4, 2, 2, 0), (-50.0, 0.0, 0, 4, 2, 2, 1.0)], ids=str
)
def test_a_box_out_of_sight_leaves_the_picture_alone(row: tuple[float, ...]) -> None:
    assert len(drawn(CAMERA, boxes(row))) == 0


def test_a_box_that_passes_the_camera_is_cut_at_the_near_plane() -> None:
    """A wall from 20 m behind to 20 m ahead, 2 m to the left: it fills the left of the picture and never the right."""
    found = drawn(CAMERA, boxes((0, 2, 0, 40, 0.1, 2, 0)))
    assert len(found) > 500
    far = 320 - 500 * 1.95 / 20
    assert found[:, 1].max() < far + 60  # the caption may reach a little beyond
    assert found[:, 1].min() == 0


@pytest.mark.parametrize(
    "camera",
    [
        Camera("fisheye", 640, 480, (200.0, 200.0, 320.0, 240.0), (0.02, -0.01, 0.0, 0.0), TURN),
        Camera("mei", 640, 480, (400.0, 400.0, 320.0, 240.0), (1.2, 0.0, 0.0, 0.0, 0.0), TURN),
        Camera("equirectangular", 640, 320, (640 / (2 * math.pi), 320 / math.pi, 319.5, 159.5), (), TURN),
    ],
    ids=lambda camera: camera.model,
)
def test_edges_are_curved_where_the_lens_curves_them(camera: Camera) -> None:
    """A long bar high above: its edges must reach pixels that a straight line between its ends misses."""
    bar = boxes((4, 0, 3, 0.1, 12, 0.1, 0))
    found = drawn(camera, bar)
    ends, _, valid = camera.project(torch.tensor([[4.0, 6.0, 3.0], [4.0, -6.0, 3.0], [4.0, 0.0, 3.0]]))
    assert valid[2]
    row, straight = float(ends[2, 1]), float(ends[:2, 1].mean())
    assert abs(row - straight) > 15
    column = found[np.abs(found[:, 1] - 320) < 3]
    assert np.abs(column[:, 0] - row).min() < 4


def test_truth_and_tracks_on_the_picture() -> None:
    grey = np.full((480, 640, 3), 128, np.uint8)
    truth = boxes((10, 0, 0, 4, 2, 2, 0))
    assert (draw.camera_view(grey, CAMERA, None, truth) > 200).all(-1).sum() > 200
    tracks = draw.camera_view(grey, CAMERA, Tracks(truth, torch.tensor([3])), None, CLASSES)
    assert (tracks != draw.camera_view(grey, CAMERA, truth, None, CLASSES)).any()
    assert (grey == 128).all()  # the given picture stays as it is


# Range images, files, curves


def test_range_picture_is_grey_without_points() -> None:
    mask = torch.zeros(1, 8, 32, dtype=torch.bool)
    mask[0, 2:4, 5:9] = True
    xyz = torch.ones(1, 3, 8, 32) * mask[:, None]
    image = RangeImage(torch.rand(1, 1, 8, 32), xyz, mask, torch.zeros(0), RangeView(8, 32, 0.1, -0.2))
    picture = draw.range_picture(image, scale=2)
    assert picture.shape == ((8 + 2 + 8) * 2, 32, 3)
    coloured = np.ptp(picture[:16].astype(int), axis=-1) > 5
    assert np.array_equal(coloured[::2], mask[0].numpy())
    assert draw.range_picture(image.replace(mask=mask & False)).std() >= 0


def test_png_keeps_the_pixels(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    draw.write_png(tmp_path / "a" / "b.png", picture)
    assert np.array_equal(cv2.imread(str(tmp_path / "a" / "b.png"))[..., ::-1], picture)


def test_metrics_become_curves(tmp_path: Path) -> None:
    rows = ["step,epoch,loss/total,loss/center/heatmap,val/box_ap/car,learning_rate"]
    rows += [f"{i},0,{8 / (i + 1)},{4 / (i + 1)},,0.001" for i in range(60)] + ["59,0,,,0.5,"]
    (tmp_path / "metrics.csv").write_text("\n".join(rows))
    metrics = draw.read_metrics(tmp_path / "metrics.csv")
    assert set(metrics) == {"loss/total", "loss/center/heatmap", "val/box_ap/car", "learning_rate"}
    assert metrics["val/box_ap/car"][0].tolist() == [59]
    assert metrics["loss/total"][1][0] == 8
    whole = draw.curves(metrics)
    assert whole.shape[0] > draw.curves({"loss/total": metrics["loss/total"]}).shape[0]
    assert draw.curves({}).dtype == np.uint8


def test_a_metrics_file_that_is_none(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="cannot be read"):
        draw.read_metrics(tmp_path / "none.csv")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="column `step`, found a, b"):
        draw.read_metrics(tmp_path / "other.csv")
