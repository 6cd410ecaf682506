"""Transforms of the input `image`: its camera and the rectangles of the labels go along, boxes in space stay."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError
from lidarfw.interfaces.data import Transform
from lidarfw.types import Boxes, Camera, DataSpec, Frame, Image, Spec

if TYPE_CHECKING:
    import torch
else:
    torch = LazyModule("torch")


def _mapped(camera: Camera, scale: tuple[float, float], move: tuple[float, float], size: tuple[int, int]) -> Camera:
    """The camera of a picture whose pixel p became scale * p + move, in a picture of another size."""
    fx, fy, cx, cy = camera.intrinsics
    intrinsics = (fx * scale[0], fy * scale[1], cx * scale[0] + move[0], cy * scale[1] + move[1])
    return replace(camera, width=size[0], height=size[1], intrinsics=intrinsics)


def map_picture(frame: Frame, scale: tuple[float, float], move: tuple[float, float], size: tuple[int, int]) -> Frame:
    """The frame with its picture drawn anew: pixel p becomes scale * p + move, what is beyond is black."""
    import cv2

    image: Image = frame.inputs["image"]
    matrix = np.array([[scale[0], 0, move[0]], [0, scale[1], move[1]]])
    kind = cv2.INTER_AREA if max(scale) < 1 else cv2.INTER_LINEAR
    pixels = image.features[0].permute(1, 2, 0).numpy()
    if move == (0.0, 0.0):
        drawn = cv2.resize(pixels, size, interpolation=kind)
    else:
        drawn = cv2.warpAffine(pixels, matrix, size, flags=cv2.INTER_LINEAR)
    picture = torch.from_numpy(np.ascontiguousarray(drawn)).permute(2, 0, 1)[None]
    camera = _mapped(image.cameras[0], scale, move, size)
    targets = frame.targets
    moved: dict[str, Any] = {
        name: _move_rectangles(getattr(targets, name), scale, move) for name in ("boxes", "ignored")
    }
    if targets.tracks is not None:
        moved["tracks"] = targets.tracks.replace(boxes=_move_rectangles(targets.tracks.boxes, scale, move))
    return frame.replace(
        inputs={**frame.inputs, "image": Image(picture, (camera,), image.stride)}, targets=targets.replace(**moved)
    )


def _move_rectangles(boxes: Boxes | None, scale: tuple[float, float], move: tuple[float, float]) -> Boxes | None:
    if boxes is None or boxes.box2d is None:
        return boxes
    return boxes.replace(box2d=boxes.box2d * boxes.box2d.new_tensor(scale * 2) + boxes.box2d.new_tensor(move * 2))


class ResizePicture(Transform):
    """Bring the input `image` to `width` x `height` pixels; its camera and the labels' rectangles go along.

    The cameras in the meta of a frame stay those of the picture's file.
    """

    example: ClassVar = {"width": 208, "height": 64}

    def __init__(self, *, width: int = 800, height: int = 448) -> None:
        if width < 1 or height < 1:
            raise ConfigError(f"resize_picture: expected a width and height above 0, found {width} x {height}")
        self.size = (width, height)

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with the resized picture."""
        camera = frame.inputs["image"].cameras[0]
        return map_picture(frame, *_resizing(camera, self.size), self.size)

    def spec(self, data: DataSpec) -> DataSpec:
        """The data with the camera of the resized picture."""
        known = _image_of(data, "resize_picture")
        if not isinstance(known.geometry, Camera):
            return data
        camera = _mapped(known.geometry, *_resizing(known.geometry, self.size), self.size)
        return replace(data, inputs={**data.inputs, "image": replace(known, geometry=camera)})


def _resizing(camera: Camera, size: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Scale and move of pixels, whose centres are at whole numbers."""
    x, y = size[0] / camera.width, size[1] / camera.height
    return (x, y), ((x - 1) / 2, (y - 1) / 2)


def _image_of(data: DataSpec, name: str) -> Spec:
    if "image" not in data.inputs:
        there = ", ".join(data.inputs) or "none"
        raise ConfigError(
            f"transform {name} needs the input 'image'; the dataset has {there}.\n  fix: its option image"
        )
    return data.inputs["image"]


class RandomPicture(Transform):
    """Scale and shift the input `image` at random, both normally distributed, all pictures of a clip alike.

    `scale` is the standard deviation of the factor about 1, `shift` that of the shift as a share of the picture's size
    (Time3D augments so, section 4.1; CenterTrack's values for nuScenes). Objects stay where they are in space: the
    camera changes.
    """

    train_only = True

    def __init__(self, *, scale: float = 0.05, shift: float = 0.01) -> None:
        if not (0 <= scale < 0.5 and 0 <= shift < 0.5):
            raise ConfigError(f"random_picture: expected scale and shift in 0..0.5, found {scale}, {shift}")
        self.scale, self.shift = scale, shift

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with another view."""
        camera = frame.inputs["image"].cameras[0]
        factor = float(np.clip(1 + self.scale * rng.normal(), 0.5, 2))
        drawn = self.shift * rng.normal(size=2) + 0.5 * (1 - factor)  # scaled about the middle
        move = (float(drawn[0] * camera.width), float(drawn[1] * camera.height))
        return map_picture(frame, (factor, factor), move, (camera.width, camera.height))

    def spec(self, data: DataSpec) -> DataSpec:
        """Unchanged; ConfigError where there is no picture."""
        _image_of(data, "random_picture")
        return data
