"""Range images, residual images and distance maps of frames."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from lidarfw.components.transforms.augmentation import RandomFlip, RandomRotation
from lidarfw.errors import ConfigError
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import DataSpec, Frame, FrameMeta, PointLabels, Points, RangeImage, Spec, Targets, collate
from torch import Tensor

from lidarfw_dpdc_mos.distance import on_pixels
from lidarfw_dpdc_mos.transforms import DropFeatures, EdgeDistance, RangeCrop, RangeProjection, ResidualImages

RNG = np.random.default_rng(0)


def frame(xyz: list[list[float]], time: list[float] | None = None, label: list[int] | None = None) -> Frame:
    """A frame of these points, remission 0.5."""
    points = Points.from_scan(
        torch.tensor(xyz).view(-1, 3), torch.full((len(xyz), 1), 0.5), None if time is None else torch.tensor(time)
    )
    known = None
    if label is not None:
        known = PointLabels((torch.tensor(label)[:, None] == torch.arange(2)).float(), points.batch)
    return Frame({"points": points}, Targets(points=known), FrameMeta("f"))


def at(azimuth: float, distance: float, elevation: float = -5.0) -> list[float]:
    a, e = math.radians(azimuth), math.radians(elevation)
    return [distance * math.cos(e) * math.cos(a), distance * math.cos(e) * math.sin(a), distance * math.sin(e)]


def test_pixels_of_the_paper_view() -> None:
    xyz = [(10, 0, 0), (0, 10, -1), (5, 5, -1.73), (-10, 0.001, 0), (-10, -1e-9, 0), (10, 0, 1), (0, 0, 0)]
    projected = RangeProjection()(frame([list(map(float, p)) for p in xyz]), RNG)
    pixel = projected.inputs["range"].pixel
    found = [(int(p) % 2048, int(p) // 2048) if p >= 0 else None for p in pixel]
    # straight behind, -180 and 180 degrees are one direction: column 0 (the reference code clips to 2047)
    assert found == [(1024, 6), (512, 19), (768, 38), (0, 6), (0, 6), (1024, 0), None]
    assert RangeProjection(fov_policy="drop")(frame([[10.0, 0.0, 1.0]]), RNG).inputs["range"].pixel.tolist() == [-1]


def test_the_image_holds_range_and_remission() -> None:
    image: RangeImage = RangeProjection()(frame([at(10, 20), at(10, 9), at(-50, 30)]), RNG).inputs["range"]
    assert image.features.shape == (1, 2, 64, 2048)
    assert int(image.mask.sum()) == 2
    assert sorted(image.features[0, 0][image.mask[0]].tolist()) == pytest.approx([9, 30])
    assert image.features[0, 1][image.mask[0]].tolist() == [0.5, 0.5]
    assert float(image.features[:, :, ~image.mask[0]].abs().max()) == 0


def test_without_remission_the_image_holds_the_range_alone() -> None:
    given = frame([at(10, 20), at(-50, 30)])
    bare = DropFeatures()(given, RNG)
    assert RangeProjection()(bare, RNG).inputs["range"].features.shape == (1, 1, 64, 2048)
    data = DropFeatures().spec(DataSpec({"points": Spec(Points, 1)}, sweeps=2))
    assert ResidualImages(count=1).spec(RangeProjection().spec(data)).inputs["range"].channels == 2
    with pytest.raises(ConfigError, match="drop_features needs"):
        DropFeatures().spec(DataSpec())


def residuals(now: list[float], before: list[float], **options: object) -> list[float]:
    """Residuals of points in columns of their own; -1 for none."""
    angles = [10.0 * i for i in range(len(now))]
    rows = [(at(a, r), 0.0) for a, r in zip(angles, now) if r > 0]
    rows += [(at(a, r), -0.1) for a, r in zip(angles, before) if r > 0]
    projected = RangeProjection()(frame([p for p, _ in rows], [t for _, t in rows]), RNG)
    done = ResidualImages(count=1, **options)(projected, RNG)  # type: ignore[arg-type]
    image = done.inputs["range"]
    assert len(done.inputs["points"]) == len(image.pixel) == sum(r > 0 for r in now)
    found: Tensor = image.features[0, 2].flatten()[image.pixel]
    return [float(v) for v in found]


def test_residuals() -> None:
    now, before = [10, 20, 49, 51, 1.5, 30], [9, 20.5, -1, 48, 1.6, 45]
    assert residuals(now, before) == pytest.approx([0.1, 0.025, 0, 0, 0, 0.5], abs=1e-5)
    assert residuals(now, before, signed=True) == pytest.approx([-0.1, 0.025, 0, 0, 0, 0.5], abs=1e-5)
    assert residuals(now, before, max_range=60, min_range=1) == pytest.approx(
        [0.1, 0.025, 0, 3 / 51, 0.1 / 1.5, 0.5], abs=1e-5
    )
    assert residuals([3, 10], [30, 10], limit=5) == pytest.approx([5, 0], abs=1e-5)


def test_residuals_against_the_nearest_range_around() -> None:
    """The past scan is half a pixel off at an edge: within one pixel it has the same range, on the pixel it has not."""
    step = 360 / 2048
    now = [(at(0, 10), 0.0), (at(step, 10), 0.0), (at(5 * step, 10), 0.0)]
    past = [(at(0, 20), -0.1), (at(step, 10), -0.1), (at(5 * step, 20), -0.1)]
    projected = RangeProjection()(frame([p for p, _ in now + past], [t for _, t in now + past]), RNG)
    for search, expected in ((0, [1, 0, 1]), (1, [0, 0, 1])):
        image = ResidualImages(count=1, search=search)(projected, RNG).inputs["range"]
        assert image.features[0, 2].flatten()[image.pixel].tolist() == pytest.approx(expected, abs=1e-4)


def test_a_sector_keeps_what_is_in_it() -> None:
    """Features, points, labels and distance maps of a sector are those of the full turn, also across its border."""
    degrees = [-179, -178, -90, 0, 90, 178, 179]
    given = frame([at(a, 10 + abs(a) / 100) for a in degrees], label=[0, 0, 0, 0, 0, 0, 1])
    whole = EdgeDistance()(RangeProjection(height=16, width=256)(given, RNG), RNG)
    cut = RangeCrop(columns=32, moving=1.0)(whole, np.random.default_rng(2))
    image, points, labels = cut.inputs["range"], cut.inputs["points"], cut.targets.points
    assert image.features.shape == (1, 2, 16, 32)
    assert labels is not None
    assert 1 in labels.label.tolist()
    assert 1 < len(points) < len(degrees)
    assert image.features[0, 0].flatten()[image.pixel].tolist() == pytest.approx(points.xyz.norm(dim=1).tolist())
    assert cut.targets.pixels is not None
    assert whole.targets.pixels is not None
    assert cut.targets.pixels.features.shape == (1, 1, 16, 32)
    of_moving = int(image.pixel[labels.label == 1])
    assert cut.targets.pixels.features.flatten()[of_moving] == 0
    both = collate([cut, cut])
    assert both.inputs["range"].pixel.tolist() == [*image.pixel.tolist(), *(image.pixel + 16 * 32).tolist()]


def test_sectors_without_what_moves_lie_anywhere() -> None:
    given = RangeProjection(width=256)(frame([at(a, 10) for a in range(0, 360, 4)], label=[0] * 90), RNG)
    crop, rng = RangeCrop(columns=64), np.random.default_rng(0)
    first = {float(crop(given, rng).inputs["points"].xyz[0, 1]) for _ in range(8)}
    assert len(first) > 4
    assert len(RangeCrop(columns=256)(given, rng).inputs["points"]) == 90
    assert RangeCrop(columns=512)(given, rng).inputs["range"].features.shape[3] == 256
    empty = RangeProjection(width=256)(frame([]), RNG)
    assert len(crop(empty, rng).inputs["points"]) == 0


def test_strides_gaps_and_the_start_of_a_sequence() -> None:
    times = [0.0, -0.1, -0.2, -0.3, -0.4]
    whole = frame([at(0, 10 + k) for k in range(5)], times)

    def channels(transform: ResidualImages, given: Frame = whole) -> list[float]:
        image = transform(RangeProjection()(given, RNG), RNG).inputs["range"]
        return [round(float(image.features[0, c].max()), 4) for c in range(2, image.features.shape[1])]

    assert channels(ResidualImages(count=2)) == [0.1, 0.2]
    assert channels(ResidualImages(count=2, stride=2)) == [0.2, 0.4]
    assert channels(ResidualImages(count=0)) == []
    assert channels(ResidualImages(count=3), frame([at(0, 10), at(0, 11)], [0.0, -0.1])) == [0.1, 0, 0]
    assert channels(ResidualImages(count=2), frame([at(0, 10)])) == [0, 0]
    gap = frame([at(0, 10), at(0, 11), at(0, 12)], [0.0, -0.1, -0.9])
    assert channels(ResidualImages(count=2), gap) == [0.1, 0]


def test_augmentation_moves_all_scans_alike() -> None:
    """What stands still has residual 0 whichever way the scene is turned, and residuals do not depend on the turn."""
    data = SyntheticDataset(frames=3, sequence_length=3, sweeps=3)
    original = data[2]
    for augment in (RandomFlip(axes=("x", "y"), probability=1.0), RandomRotation(angle=math.pi)):
        totals = []
        for given in (original, augment(original, np.random.default_rng(3))):
            image = ResidualImages(count=2)(RangeProjection(height=32, width=256)(given, RNG), RNG).inputs["range"]
            totals.append(float((image.features[0, 2:] > 0.02).sum()))
        assert totals[0] > 50
        assert totals[1] == pytest.approx(totals[0], rel=0.3)  # other pixel borders, the same scene


def test_labels_stay_with_their_points() -> None:
    given = frame([at(0, 10), at(20, 12), at(0, 11)], [0.0, 0.0, -0.1], [1, 0, 1])
    done = ResidualImages(count=1)(RangeProjection()(given, RNG), RNG)
    assert done.targets.points is not None
    assert done.targets.points.label.tolist() == [1, 0]
    assert (given.inputs["points"].xyz.shape[0], done.inputs["points"].xyz.shape[0]) == (3, 2)


def test_distance_maps_in_the_loader() -> None:
    xyz = [at(a / 2048 * 360, 10) for a in range(-2, 3)] + [at(a / 2048 * 360, 12) for a in range(3, 30)]
    label = [1] * 5 + [0] * 27
    done = EdgeDistance()(ResidualImages(count=0)(RangeProjection()(frame(xyz, label=label), RNG), RNG), RNG)
    pixels = done.targets.pixels
    assert pixels is not None
    assert pixels.features.shape == (1, 1, 64, 2048)
    row = int(done.inputs["range"].pixel[0]) // 2048
    assert pixels.features[0, 0, row, 1022:1030].tolist() == [0, 0, 0, 0, 0, 1, 2, 3]
    assert EdgeDistance()(RangeProjection()(frame(xyz), RNG), RNG).targets.pixels is None


def test_a_pixel_shows_its_nearest_point() -> None:
    given = frame([at(0, 12), at(0, 10), at(90, 5)], label=[0, 1, 0])
    image = RangeProjection()(given, RNG).inputs["range"]
    points = given.inputs["points"]
    found = on_pixels(torch.tensor([7, 8, 9]), image, points, empty=-1)
    assert sorted(found[found >= 0].tolist()) == [8, 9]
    assert found.flatten()[image.pixel].tolist() == [8, 8, 9]


def test_errors_say_what_to_do() -> None:
    data = DataSpec({"points": Spec(Points, 1)}, sweeps=2)
    with pytest.raises(ConfigError, match="range_projection,residual_images"):
        ResidualImages().spec(data)
    projected = RangeProjection().spec(data)
    with pytest.raises(ConfigError, match="sweeps=3"):
        ResidualImages().spec(projected)
    assert ResidualImages(count=1).spec(projected).inputs["range"].channels == 3
    with pytest.raises(ConfigError, match="range_projection"):
        EdgeDistance().spec(data)
    with pytest.raises(ConfigError, match="clip, drop"):
        RangeProjection(fov_policy="keep")
    with pytest.raises(ConfigError, match="multiple of 16"):
        RangeCrop(columns=100)
    with pytest.raises(ConfigError, match="range_projection,range_crop"):
        RangeCrop().spec(data)
    with pytest.raises(ConfigError, match="is a share"):
        RangeCrop(moving=2.0)
    with pytest.raises(ConfigError, match="search >= 0"):
        ResidualImages(search=-1)
    with pytest.raises(ConfigError, match="needs the input `points`"):
        RangeProjection().spec(DataSpec())
