"""Both sensors in one panorama: projection, stitching, interpolation, depth, classes."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import BEV, Camera, DataSpec, Frame, FrameMeta, Grid, Image, Points, RangeView, Spec, Targets

from lidarfw_crossplace import labels, panorama
from lidarfw_crossplace.transforms import Panorama, turned

VIEW = RangeView(64, 1024, math.radians(2), math.radians(-24.8))
LEFT = Camera(
    "mei", 1400, 1400, (1336.3220825849971, 1335.7883350012958, 716.94323510126321, 705.76498308221585),
    (2.2134047507854890, 0.016798235660113681, 1.6548773243373522, 4.2223943394772046e-4, 4.2462134260997584e-4),
)  # fmt: skip
RIGHT = Camera(
    "mei", 1400, 1400, (1485.4388981875156, 1484.9477411748708, 698.88316784030962, 698.14541887723055),
    (2.5535139132482758, 0.049370396274089505, 4.5068455478645308, 1.3477698472982495e-3, -7.0340482615055284e-4),
)  # fmt: skip


@pytest.mark.parametrize(
    ("camera", "ray", "pixel"),
    [
        (LEFT, (0, 0, 1), (716.9432, 705.7650)), (LEFT, (1, 0, 1), (1042.7485, 705.7980)),
        (LEFT, (0, 1, 1), (716.9765, 1031.4395)), (LEFT, (1, 0, 0), (1364.7281, 705.8801)),
        (LEFT, (-1, 0.5, 0.2), (199.8533, 964.3505)), (LEFT, (3, -1, 5), (938.9921, 631.8013)),
        (RIGHT, (1, 0, 1), (1024.8310, 698.2395)), (RIGHT, (-1, 0.5, 0.2), (179.5838, 957.9016)),
        (Camera("mei", 640, 640, (300, 300, 320, 320), (1.0,)), (1, 0, -0.1), (651.496269, 320)),
        (Camera("mei", 640, 640, (300, 300, 320, 320), (1.0,)), (1, 1, 1), (429.807621, 429.807621)),
    ],
)  # fmt: skip
def test_fisheyes_of_kitti_360(camera: Camera, ray: tuple[float, ...], pixel: tuple[float, ...]) -> None:
    rays = torch.nn.functional.normalize(torch.tensor([ray], dtype=torch.float64))
    uv, _, _ = camera.project(rays)
    assert uv[0].tolist() == pytest.approx(pixel, abs=1e-4)
    assert (camera.rays(uv) - rays).norm() < 1e-9


@pytest.mark.parametrize(
    ("point", "pixel"),
    [
        ((10, 0, 0), (512, 4)), ((0, 10, -1.73), (256, 28)), ((-10, 0, 0), (0, 4)), ((5, -5, -1), (640, 23)),
        ((20, 0, 0.7), None), ((3, 0, -1.73), None),
    ],
)  # fmt: skip
def test_projection_of_scans(point: tuple[float, ...], pixel: tuple[int, int] | None) -> None:
    row, column, _, inside = VIEW.project(torch.tensor([point], dtype=torch.float64))
    assert bool(inside) == (pixel is not None)
    if pixel:
        assert (int(column), int(row)) == pixel


def test_panorama_camera_sees_what_the_range_view_sees() -> None:
    rays = VIEW.direction(torch.tensor([0.0, 10, 63]), torch.tensor([5.0, 512, 1000]))
    uv, _, valid = panorama.camera_of(VIEW).project(rays)
    assert valid.all()
    assert torch.allclose(uv, torch.tensor([[5.0, 0], [512, 10], [1000, 63]]), atol=1e-3)


def rig() -> tuple[Camera, Camera]:
    """Two opposite fisheyes: x right, y down, z to the left or right of the vehicle."""
    left = ((1.0, 0, 0, 0), (0, 0, -1.0, 0), (0, 1.0, 0, 0), (0, 0, 0, 1.0))
    right = ((-1.0, 0, 0, 0), (0, 0, -1.0, 0), (0, -1.0, 0, 0), (0, 0, 0, 1.0))
    return tuple(Camera("mei", 1200, 1200, (450, 450, 599.5, 599.5), (1.0,), m) for m in (left, right))  # type: ignore[return-value]


def ladybug() -> tuple[Camera, ...]:
    """Five pinholes that look all round, each on its side: right of a picture is down."""
    turns = [math.radians(72 * number) for number in range(5)]
    axes = [((0, 0, -1.0, 0), (-math.sin(a), math.cos(a), 0, 0), (math.cos(a), math.sin(a), 0, 0)) for a in turns]
    return tuple(Camera("pinhole", 1616, 1232, (400, 400, 808, 616), (), (*rows, (0, 0, 0, 1.0))) for rows in axes)


RIGS = {"fisheyes": (rig(), math.radians(185)), "ladybug": (ladybug(), 1.75)}


def lit(cameras: tuple[Camera, ...], point: tuple[float, float, float]) -> list[torch.Tensor]:
    """Black pictures with a bright spot where the point is."""
    pictures = [torch.zeros(3, camera.height, camera.width) for camera in cameras]
    for camera, picture in zip(cameras, pictures, strict=True):
        uv, _, valid = camera.project(torch.tensor([point]))
        if valid:
            column, row = uv[0].round().long().tolist()
            picture[:, row - 3 : row + 4, column - 3 : column + 4] = 1
    return pictures


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize(("degrees", "column"), [(90, 256), (0, 512), (-90, 768), (30, 426)])
def test_both_sensors_see_a_beacon_in_the_same_column(degrees: float, column: int, name: str) -> None:
    beacon = (20 * math.cos(math.radians(degrees)), 20 * math.sin(math.radians(degrees)), -3.0)
    cameras, fov = RIGS[name]
    pictures = lit(cameras, beacon)
    inputs = {f"camera_{i}": Image(p[None], (c,)) for i, (p, c) in enumerate(zip(pictures, cameras, strict=True))}
    transform, found = Panorama(maps=("intensity",), cameras=tuple(inputs), fov=fov), []
    inputs["points"] = Points.from_scan(torch.tensor([beacon]), torch.ones(1, 1))  # type: ignore[assignment]
    for modality in ("camera", "lidar"):
        frame = Frame(inputs, Targets(), FrameMeta("f", modality=modality))
        bright = transform(frame, np.random.default_rng(0)).inputs["intensity"].features[0, 0]
        row, at = (bright > bright.max() / 2).nonzero().float().mean(0).tolist()
        assert abs(at - column) <= 1
        found.append((row, at))
    (row, at), (other_row, other) = found
    assert abs(at - other) <= 1
    assert abs(row - other_row) <= 1


def test_five_pictures_cover_the_panorama_of_an_hdl32() -> None:
    view = RangeView(32, 1024, 0.1866, -0.5353)
    assert panorama.stitcher(view, *RIGS["ladybug"]).covered.all()


def test_two_fisheyes_cover_the_panorama_and_blend_over_their_overlap() -> None:
    stitcher = panorama.stitcher(VIEW, rig(), math.radians(185))
    assert stitcher.covered.all()
    assert torch.allclose(stitcher.weight.sum(0), torch.ones(64, 1024))
    level = stitcher.weight[0, 4]  # of the left camera, at the horizon
    assert level[256] == 1
    assert level[768] == 0
    assert float(level[511:513].mean()) == pytest.approx(0.5, abs=0.02)
    mixed = ((level > 0) & (level < 1)).sum() * 360 / 1024
    assert float(mixed) == pytest.approx(2 * 5, abs=1)  # 5 degrees ahead and behind
    constant = stitcher.blend([torch.full((1, 1200, 1200), 0.3)] * 2)
    assert torch.allclose(constant, torch.full_like(constant, 0.3), atol=1e-6)


def test_crop_of_the_whole_sphere() -> None:
    sphere = panorama.camera_of(panorama.sphere(1024))
    rows = torch.arange(512.0)[None, :, None].expand(1, -1, 1024)
    crop = panorama.stitcher(VIEW, (sphere,), math.pi).blend([rows.contiguous()])[0, :, 100] + 0.5
    step = 26.8 / 180 * 512 / 64
    assert float(crop[0] - step / 2) == pytest.approx(250.31, abs=0.01)
    assert float(crop[-1] + step / 2) == pytest.approx(326.54, abs=0.01)


COLUMN = [0.0, 10, 0, 0, 16, 0, 0, 0, 0, 0, 30, 0]
WHOLE = [0, 10, 12, 14, 16, 18.3333, 20.6667, 23, 25.3333, 27.6667, 30, 0]


SHORT = [0, 10, 12, 14, 16, 0, 0, 0, 0, 0, 30, 0]


@pytest.mark.parametrize(("gap", "expected"), [(4, SHORT), (2, SHORT), (1, COLUMN), (-1, WHOLE)])
def test_gaps_of_a_column(gap: int, expected: list[float]) -> None:
    values = torch.tensor(COLUMN)[None, :, None]
    filled, known = panorama.interpolate_columns(values, values[0] > 0, gap)
    assert filled[0, :, 0].tolist() == pytest.approx(expected, abs=1e-4)
    assert known[:, 0].tolist() == [value > 0 for value in expected]


def test_labels_are_copied_from_the_nearer_row_and_at_a_tie_from_the_nearer_point() -> None:
    values = torch.tensor([3.0, 0, 0, 7, 0, 9])[None, :, None]
    distance = torch.tensor([5.0, 0, 0, 9, 0, 4])[:, None]
    filled, _ = panorama.interpolate_columns(values, values[0] > 0, 4, distance)
    assert filled[0, :, 0].tolist() == [3, 3, 7, 7, 9, 9]


def test_power_of_depth() -> None:
    powers = torch.tensor([0, 0.25, 0.5, 0.75, 0.9, 1]) ** Panorama().power
    assert powers.tolist() == pytest.approx([0, 0.000977, 0.03125, 0.237305, 0.59049, 1], abs=1e-5)


def test_power_makes_inverted_inverse_depth_proportional_to_distance() -> None:
    metres = torch.tensor([[3.0, 5, 10, 20, 40, 80]])
    inverse = 7 / metres + 2
    depth = (inverse.max() - inverse) / (inverse.max() - inverse.min())
    found = panorama.depth_from_inverse(inverse, metres > 0)
    assert (found - depth).abs().max() < 0.05
    line = [float(torch.corrcoef(torch.cat([metres, depth**p]))[0, 1]) for p in range(1, 6)]
    assert line == sorted(line)
    assert line[0] == pytest.approx(0.704, abs=2e-3)
    assert line[4] == pytest.approx(0.923, abs=2e-3)


def test_simulated_depth_is_the_same_for_the_same_generator() -> None:
    metres = torch.linspace(3, 50, 64).expand(32, -1).contiguous()
    one, other = (panorama.simulated_inverse_depth(metres, np.random.default_rng(3)) for _ in range(2))
    assert torch.equal(one, other)
    assert torch.corrcoef(torch.stack([one.flatten(), (1 / metres).flatten()]))[0, 1] > 0.9


def test_every_class_of_both_datasets_has_a_place() -> None:
    assert len(labels.CITYSCAPES) == 19
    assert len(labels.SEMANTIC_KITTI) == 20
    assert list(labels.CITYSCAPES.values()) == [0, 1, 2, 3, 3, 4, 4, 5, 6, 7, 15, 8, 9, 10, 11, 12, 12, 13, 14]
    assert list(labels.SEMANTIC_KITTI.values()) == [
        15, 10, 14, 13, 11, 12, 8, 9, 9, 0, 15, 1, 7, 2, 3, 6, 6, 7, 4, 5
    ]  # fmt: skip
    for table in (labels.CITYSCAPES, labels.SEMANTIC_KITTI):
        assert set(table.values()) == set(range(16))
    shared = set(labels.CITYSCAPES) & set(labels.SEMANTIC_KITTI)
    assert all(labels.CITYSCAPES[name] == labels.SEMANTIC_KITTI[name] for name in shared)
    assert len(labels.CLASSES) == len(labels.PALETTE) == 16


def test_no_data_is_black_and_road_is_not() -> None:
    colours = labels.coloured(torch.tensor([[0, 15, labels.NOTHING]], dtype=torch.uint8))
    assert colours[:, 0].T.tolist()[1:] == [[0, 0, 0], [0, 0, 0]]
    assert colours[:, 0, 0].tolist() == pytest.approx([128 / 255, 64 / 255, 128 / 255])


def test_own_vehicle_is_filled_and_its_classes_are_road(tmp_path: Path) -> None:
    from lidarfw.draw import write_png

    mask = np.zeros((64, 1024, 3), np.uint8)
    mask[40:, 500:520] = 255
    write_png(tmp_path / "ego.png", mask)
    pictures = {f"image_0{i + 2}": Image(torch.full((1, 3, 1200, 1200), 0.5), (c,)) for i, c in enumerate(rig())}
    frame = Frame(dict(pictures), Targets(), FrameMeta("f", modality="camera"))
    options = {"maps": ("intensity",), "ego_mask": str(tmp_path / "ego.png")}
    for fill, expected in (("zero", 0.0), ("inpaint", 0.5)):
        made = Panorama(**options, ego_fill=fill)(frame, np.random.default_rng(0))  # type: ignore[arg-type]
        values = made.inputs["intensity"].features[0, 0]
        assert float(values[50, 510]) == pytest.approx(expected, abs=0.01)
        assert float(values[50, 100]) == pytest.approx(0.5, abs=0.01)
    small = Panorama(**options, height=32)  # type: ignore[arg-type]
    with pytest.raises(DataError, match="expected 1024 x 32"):
        small(frame, np.random.default_rng(0))


def test_maps_that_the_data_cannot_give_are_refused() -> None:
    data = DataSpec(
        {"points": Spec(Points, 1), "image_02": Spec(Image, 3, 1, LEFT), "image_03": Spec(Image, 3, 1, RIGHT)}
    )
    with pytest.raises(ConfigError, match=r"image_02_depth.*\n.*maps=\[intensity\]"):
        Panorama().spec(data)
    given = Panorama(maps=("intensity",)).spec(data).inputs
    assert list(given) == ["intensity"]
    assert given["intensity"].geometry == panorama.camera_of(Panorama().view)


def test_turning_rolls_panoramas_and_turns_maps() -> None:
    image = Image(torch.rand(1, 1, 4, 8), (panorama.camera_of(RangeView(4, 8, 0.5, -0.5)),))
    quarter = turned(image, math.pi / 2)
    assert torch.equal(quarter.features, image.features.roll(-2, 3))
    bev = BEV(torch.rand(1, 1, 6, 6), Grid((-3, -3, 0), (3, 3, 1), (1, 1, 1)))
    assert torch.allclose(
        turned(bev, math.pi / 2).features, bev.features.rot90(1, (2, 3)), atol=1e-5
    ) or torch.allclose(turned(bev, math.pi / 2).features, bev.features.rot90(-1, (2, 3)), atol=1e-5)
    assert torch.allclose(turned(turned(bev, math.pi), math.pi).features, bev.features, atol=1e-5)


def test_views_are_moved_by_metres() -> None:
    grid = Grid((-4.0, -4.0, -1.0), (4.0, 4.0, 1.0), (0.5, 0.5, 2.0))
    bev = BEV(torch.rand(1, 1, 16, 16), grid)
    moved = turned(bev, 0.0, (1.0, -0.5)).features
    assert torch.allclose(moved[..., 1:, :-2], bev.features[..., :-1, 2:], atol=1e-5)
    assert torch.equal(turned(bev, 0.0).features, turned(bev, 0.0, (0.0, 0.0)).features)


def test_classes_of_points_and_a_mask_that_are_not_there_are_asked_for(tmp_path: Path) -> None:
    scan = Frame(
        {"points": Points.from_scan(torch.rand(5, 3) * 20, torch.rand(5, 1))},
        Targets(),
        FrameMeta("f", modality="lidar"),
    )
    with pytest.raises(DataError, match="no input image_02_semantics\n  fix: "):
        Panorama(maps=("semantics",))(scan, np.random.default_rng(0))
    pictures = {f"image_0{i + 2}": Image(torch.rand(1, 3, 1200, 1200), (c,)) for i, c in enumerate(rig())}
    frame = Frame(dict(pictures), Targets(), FrameMeta("f", modality="camera"))
    masked = Panorama(maps=("intensity",), ego_mask=str(tmp_path / "ego.png"))
    with pytest.raises(DataError, match=r"ego\.png.*is not there.*\n  fix: lidarfw prepare"):
        masked(frame, np.random.default_rng(0))
