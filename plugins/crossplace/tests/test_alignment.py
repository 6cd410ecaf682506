"""Two fisheyes aligned by what both see."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Camera, Frame, FrameMeta, Image, Targets
from torch import Tensor

from lidarfw_crossplace import panorama
from lidarfw_crossplace.alignment import (
    Alignment,
    azimuth_of,
    fit_alignment,
    fit_polynomial,
    matches,
    place_of,
    pooled,
    rays_of,
)
from lidarfw_crossplace.transforms import Panorama

FOV = math.radians(200)
VIEW = panorama.sphere(1024)


def test_polynomial_alignment() -> None:
    u, v = np.meshgrid([0.0, 1, 2], [0.0, 1, 2])
    place = np.stack([u.ravel(), v.ravel()], 1)
    target = 1 + 0.5 * place[:, 0] - 0.25 * place[:, 1] + 0.1 * place[:, 0] ** 2 + 0.05 * place.prod(1)
    assert fit_polynomial(place, target, 2).tolist() == pytest.approx([1, 0.5, -0.25, 0.1, 0.05, 0], abs=1e-9)
    with pytest.raises(DataError, match="10 coefficients"):
        fit_polynomial(place[:5], target[:5], 3)


def rig(turn: float = 0.0) -> tuple[Camera, Camera]:
    """Two fisheyes that look to the left and to the right; the right one is turned about the vertical, radians."""
    left = ((1.0, 0, 0, 0), (0, 0, -1.0, 0), (0, 1.0, 0, 0), (0, 0, 0, 1.0))
    c, s = math.cos(turn), math.sin(turn)
    right = ((-c, -s, 0, 0), (0, 0, -1.0, 0), (s, -c, 0, 0), (0, 0, 0, 1.0))
    return tuple(Camera("mei", 900, 900, (300, 300, 449.5, 449.5), (1.0,), rows) for rows in (left, right))  # type: ignore[return-value]


def picture(camera: Camera, around: Tensor) -> Tensor:
    """What a camera sees of a painted sphere (H, W), (1, h, w)."""
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    rays = camera.rays(torch.stack([columns, rows], -1).reshape(-1, 2).double())
    directions = rays @ torch.tensor(camera.from_sensor)[:3, :3].double()
    row, column, _, _ = panorama.sphere(around.shape[1]).project(torch.nan_to_num(directions, 1.0))
    return around[row, column].view(1, camera.height, camera.width)


def painted(seed: int) -> Tensor:
    """A sphere (1024, 2048) of spots of many sizes."""
    import cv2

    random = np.random.default_rng(seed)
    sizes = [random.random((1024 // size, 2048 // size)).astype(np.float32) for size in (4, 16, 64)]
    return torch.from_numpy(sum(cv2.resize(part, (2048, 1024)) for part in sizes) / 3)


def apart(cameras: tuple[Camera, Camera], pictures: list[Tensor], alignment: Alignment) -> float:
    """Mean difference of what the cameras show where both see."""
    stitcher = panorama.stitcher(VIEW, cameras, FOV, alignment=alignment)
    seen = [part[0] for part in stitcher.alone(pictures)]
    both = (stitcher.weight > 0).all(0)
    return float((seen[0] - seen[1])[both].abs().mean())


def frame(pictures: list[Tensor], cameras: tuple[Camera, Camera]) -> Frame:
    """Colour pictures of KITTI-360's fisheyes."""
    images = {
        f"image_0{number + 2}": Image(grey.expand(1, 3, -1, -1), (camera,))
        for number, (grey, camera) in enumerate(zip(pictures, cameras, strict=True))
    }
    return Frame(dict(images), Targets(), FrameMeta("f", modality="camera"))


def found_in(cameras: tuple[Camera, Camera], pictures: list[Tensor]) -> tuple[np.ndarray, np.ndarray]:
    stitcher = panorama.stitcher(VIEW, cameras, FOV)
    one, other = (part[0] for part in stitcher.alone(pictures))
    return matches(one, other, (stitcher.weight > 0).all(0), VIEW, azimuth_of(cameras[1]))


def test_places_are_directions_seen_from_the_axis() -> None:
    rays = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.double), dim=1)
    axis = azimuth_of(rig()[1])
    assert axis == pytest.approx(-math.pi / 2)
    assert torch.allclose(rays_of(place_of(rays, axis), axis), rays)
    right = torch.tensor([[0.0, -1, 0], [-1, -0.01, 0], [1, 0, 1]]).double()
    assert place_of(right, axis).tolist() == [
        [0, 0], pytest.approx([0.5 - 0.01 / math.pi, 0], abs=1e-5), pytest.approx([-0.5, 0.25])
    ]  # fmt: skip


def test_a_camera_that_is_turned_by_two_degrees_is_found_out() -> None:
    """The calibration says that the right camera looks straight to the right; it does not."""
    said, true = rig(), rig(math.radians(2))
    scenes = [[picture(camera, around) for camera in true] for around in map(painted, range(2))]
    alignment = pooled([found_in(said, pictures) for pictures in scenes])
    new = [picture(camera, painted(7)) for camera in true]
    before, after, best = apart(said, new, Alignment()), apart(said, new, alignment), apart(true, new, Alignment())
    assert after < best + 0.2 * (before - best), (before, after, best)


def test_outside_the_matches_the_calibration_stands() -> None:
    place = np.stack(np.meshgrid(np.linspace(0.4, 0.6, 6), np.linspace(-0.2, 0.0, 6)), -1).reshape(-1, 2)
    alignment = fit_alignment(place, place + 0.01)
    inside, far = torch.tensor([[0.5, -0.1]]), torch.tensor([[-0.5, -0.1], [0.5, 0.4], [0.5, -0.5], [0.9, 0.0]])
    assert torch.allclose(alignment.moved(inside), inside + 0.01, atol=1e-6)
    assert torch.equal(alignment.moved(far), far)
    near = torch.tensor([[0.65, -0.1]])  # half way out
    assert torch.allclose(alignment.moved(near), near + 0.005, atol=2e-3)


def test_wrong_matches_do_not_count() -> None:
    random = np.random.default_rng(0)
    place = random.uniform(-0.5, 0.5, (100, 2))
    target = place + 0.01
    target[:40] += random.uniform(-0.05, 0.05, (40, 2))
    moved = fit_alignment(place, target).moved(torch.tensor([[0.1, 0.1]]).double())
    assert moved[0].tolist() == pytest.approx([0.11, 0.11], abs=5e-4)


@pytest.mark.parametrize("count", [0, 3, 17])
def test_too_few_matches_are_told(count: int) -> None:
    place = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 2))
    with pytest.raises(DataError, match=f"of {count} matches of both cameras agree, needed are 18"):
        fit_alignment(place, place)


def test_pictures_without_a_corner_have_no_matches() -> None:
    flat = torch.full((512, 1024), 0.5)
    place, target = matches(flat, flat, torch.ones(512, 1024, dtype=torch.bool), VIEW, 0.0)
    assert place.shape == target.shape == (0, 2)


def test_panoramas_are_aligned_by_frames_of_the_dataset(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    said, true = rig(), rig(math.radians(2))
    frames = [frame([picture(camera, painted(seed)) for camera in true], said) for seed in (0, 1, 7)]
    options: dict[str, Any] = {"maps": ("intensity",), "fov": FOV, "alignment": str(tmp_path / "rig.json")}
    made = Panorama(**options)
    with pytest.raises(DataError, match=r"rig.json: no such file(.|\n)*lidarfw prepare"):
        made(frames[2], np.random.default_rng(0))
    made.prepare(frames[:2])  # type: ignore[arg-type]
    assert "calibration" not in caplog.text
    intensity, plain, right = (
        transform(one, np.random.default_rng(0)).inputs["intensity"].features[0, 0]
        for transform, one in (
            (made, frames[2]),
            (Panorama(maps=("intensity",), fov=FOV), frames[2]),
            (Panorama(maps=("intensity",), fov=FOV), frame([picture(c, painted(7)) for c in true], true)),
        )
    )
    both = slice(500, 524)  # columns ahead, which both see
    assert (intensity - right)[:, both].abs().mean() < 0.5 * (plain - right)[:, both].abs().mean()


def test_frames_without_matches_leave_the_calibration_and_say_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    flat = frame([torch.full((1, 900, 900), 0.5)] * 2, rig())
    options: dict[str, Any] = {"maps": ("intensity",), "fov": FOV}
    made = Panorama(**options, alignment=str(tmp_path / "rig.json"))
    made.prepare([flat])  # type: ignore[arg-type]
    assert "0 of 0 matches of both cameras agree, needed are 18" in caplog.text
    assert "by their calibration alone" in caplog.text
    made(flat, np.random.default_rng(0))
    with pytest.raises(ConfigError, match="two cameras"):
        Panorama(**options, cameras=("image",), alignment="rig.json")


def test_the_file(tmp_path: Path) -> None:
    place = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2))
    alignment = fit_alignment(place, place + 0.01)
    alignment.save(tmp_path / "rig.json")
    assert Alignment.load(tmp_path / "rig.json") == alignment
    assert replace(alignment, hull=()) != alignment
    (tmp_path / "broken.json").write_text("{}")
    with pytest.raises(DataError, match=r"broken.json holds no alignment of cameras(.|\n)*remove it"):
        Alignment.load(tmp_path / "broken.json")
