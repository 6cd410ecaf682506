"""Frames -> panoramas of intensity, depth and semantics, alike for both sensors; and random headings for training."""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Dataset, Transform
from lidarfw.types import BEV, DataSpec, Frame, Image, Points, RangeView, Spec

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from lidarfw_crossplace import labels, panorama
else:
    torch = LazyModule("torch")
    labels = LazyModule("lidarfw_crossplace.labels")
    panorama = LazyModule("lidarfw_crossplace.panorama")

CHANNELS = {"intensity": 1, "depth": 1, "semantics": 3}
FILLS = ("inpaint", "zero")
_EGO_FRAMES = 200
_EGO_MOVES = 0.02  # standard deviation of the grey value below which a pixel shows the own vehicle


class Panorama(Transform):
    """The panorama of a frame by one of its sensors, which the frame's `modality` names: camera or lidar (paper 3).

    Gives the inputs `intensity` (grey value or remission), `depth` and `semantics` (colours of 16 classes), each an
    `Image` of values 0..1, and drops all others. Column and row of a direction are the same for both sensors.

    Scan: the nearest point of each pixel, range / `farthest`, gaps of a column filled. Camera: the fisheyes stitched by
    their calibration; depth from CAMERA_depth, raised to `power`; semantics from CAMERA_semantics. These two are the
    truth of a simulated rig, and are made as uncertain as networks for single pictures are. Classes of points are those
    of the targets, or of the pictures that see them.
    """

    example: ClassVar[dict[str, Any]] = {"maps": ("intensity",), "cameras": ("image",), "width": 128, "height": 16}

    def __init__(
        self,
        *,
        maps: tuple[str, ...] = ("intensity", "depth", "semantics"),
        stack: bool = False,
        height: int = 64,
        width: int = 1024,
        up: float = 0.03490658503988659,
        down: float = -0.4328416544945937,
        nearest: float = 2.5,
        farthest: float = 120.0,
        gap: int = 4,
        cameras: tuple[str, ...] = ("image_02", "image_03"),
        fov: float = 3.2288591161895095,
        power: float = 5.0,
        ego_mask: str = "",
        ego_fill: str = "inpaint",
    ) -> None:
        """Options.

        maps: which of intensity, depth, semantics. stack: give them as one input `panorama`, for early fusion. height,
        width, up, down: pixels, and elevations of the upper and lower edge in radians. nearest, farthest: metres, of
        points. gap: rows of a column that are filled between two points, negative for any. cameras: inputs to stitch.
        fov: of a camera, radians. power: of the depth of pictures. ego_mask: picture, white where the own vehicle is;
        made from the frames if it is not there; empty for none. ego_fill: inpaint or zero, for intensity and depth of
        cameras; the classes there are road.
        """
        unknown = [name for name in maps if name not in CHANNELS]
        if unknown or not maps or ego_fill not in FILLS:
            raise ConfigError(
                f"transform 'panorama': maps are {', '.join(CHANNELS)}, ego_fill is {' or '.join(FILLS)}; "
                f"got {list(maps)} and {ego_fill!r}"
            )
        self.maps, self.stack, self.cameras = tuple(maps), stack, tuple(cameras)
        self.view = RangeView(height, width, up, down)
        self.nearest, self.farthest, self.gap, self.fov, self.power = nearest, farthest, gap, fov, power
        self.ego_mask, self.ego_fill = ego_mask, ego_fill
        self.classes: tuple[str, ...] = ()

    def spec(self, data: DataSpec) -> DataSpec:
        """The panoramas instead of what the sensors gave. ConfigError where an input is missing."""
        kinds = [""] + [f"_{kind}" for kind in ("depth", "semantics") if kind in self.maps]
        pictures = [f"{name}{kind}" for name in self.cameras for kind in kinds]
        seeing = any(name in data.inputs for name in self.cameras)
        missing = [name for name in pictures if name not in data.inputs]
        if missing and (seeing or "points" not in data.inputs):
            raise ConfigError(
                f"transform 'panorama' needs the input {missing[0]}; there are {', '.join(data.inputs)}\n"
                "  fix: give depth and semantics by the dataset, or transform.panorama.maps=[intensity]"
            )
        channels = {name: CHANNELS[name] for name in self.maps}
        channels = {"panorama": sum(channels.values())} if self.stack else channels
        camera = panorama.camera_of(self.view)
        return DataSpec({n: Spec(Image, c, 1, camera) for n, c in channels.items()}, data.targets, data.classes)

    def attach(self, dataset: Dataset) -> None:
        """Know the classes of the points."""
        self.classes = tuple(dataset.spec.classes)

    def prepare(self, dataset: Dataset, workers: int = 1) -> None:
        """Make the mask of the own vehicle from frames of the dataset, unless it stands."""
        if self.ego_mask and not Path(self.ego_mask).is_file():
            from lidarfw.draw import write_png

            steps = np.linspace(0, len(dataset) - 1, min(len(dataset), _EGO_FRAMES)).round().astype(int)
            greys = torch.stack([self._grey(dataset[int(number)]) for number in np.unique(steps)])
            still = (greys.std(0, correction=0) < _EGO_MOVES) & (greys.mean(0) > 0)
            write_png(self.ego_mask, np.repeat((still[0].numpy() * np.uint8(255))[..., None], 3, 2))

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with panoramas as its inputs."""
        modality = frame.meta.modality or ("lidar" if "points" in frame.inputs else "camera")
        made = self._scan_maps(frame) if modality == "lidar" else self._camera_maps(frame, rng)
        made = {"panorama": torch.cat([made[name] for name in self.maps])} if self.stack else made
        camera = panorama.camera_of(self.view)
        inputs = {name: Image(value[None].float(), (camera,)) for name, value in made.items()}
        return Frame(inputs, frame.targets, frame.meta)

    # the scan

    def _scan_maps(self, frame: Frame) -> dict[str, Tensor]:
        from lidarfw.ops import range_project

        points: Points = frame.inputs["points"]
        distance = points.xyz.norm(dim=1)
        kept = (distance >= self.nearest) & (distance <= self.farthest)
        features = [points.features[:, :1]] if points.features.shape[1] else [torch.zeros(len(points), 1)]
        if "semantics" in self.maps:
            features.append(self._point_classes(frame)[:, None].float())
        image = range_project(points.replace(features=torch.cat(features, 1), time=None)[kept], self.view)
        values, mask = image.features[0], image.mask[0]
        numbers, _ = panorama.interpolate_columns(values[:2], mask, self.gap)
        made = {"intensity": numbers[1:2].clamp(0, 1), "depth": numbers[:1] / self.farthest}
        if "semantics" in self.maps:
            classes, known = panorama.interpolate_columns(values[2:3], mask, self.gap, distance=values[0])
            said = torch.where(known, classes[0], labels.NOTHING).to(torch.uint8)
            made["semantics"] = labels.coloured(torch.where(self._ego, labels.ROAD, said))
        return {name: made[name] for name in self.maps}

    def _point_classes(self, frame: Frame) -> Tensor:
        """(N,) unified class of every point."""
        if frame.targets.points is not None and self.classes:
            return labels.table_of((*self.classes, "unlabeled"))[frame.targets.points.label]
        xyz, found = frame.inputs["points"].xyz, torch.full((len(frame.inputs["points"]),), labels.UNKNOWN)
        for name in self.cameras:
            picture: Image = frame.inputs[f"{name}_semantics"]
            uv, _, valid = picture.cameras[0].project(xyz)
            column, row = uv[valid].round().long().unbind(1)
            seen = picture.features[0, 0, row, column].long()
            found[valid] = labels.kitti_360_table()[seen].long()
        return found

    # the cameras

    def _camera_maps(self, frame: Frame, rng: np.random.Generator) -> dict[str, Tensor]:
        makers = {"intensity": lambda: self._grey(frame), "depth": lambda: self._depth(frame, rng),
                  "semantics": lambda: self._semantics(frame, rng)}  # fmt: skip
        return {name: makers[name]() for name in self.maps}

    def _pictures(self, frame: Frame, kind: str = "") -> tuple[panorama.Stitcher, list[Tensor]]:
        missing = [name for name in self.cameras if f"{name}{kind}" not in frame.inputs]
        if missing:
            raise DataError(f"frame {frame.meta.id} has no input {missing[0]}{kind}; it has {', '.join(frame.inputs)}")
        images = [frame.inputs[f"{name}{kind}"] for name in self.cameras]
        rig = tuple(image.cameras[0] for image in images)
        return panorama.stitcher(self.view, rig, self.fov), [image.features[0] for image in images]

    def _grey(self, frame: Frame) -> Tensor:
        stitcher, pictures = self._pictures(frame)
        return self._filled(panorama.grey(stitcher.blend(pictures)))

    def _depth(self, frame: Frame, rng: np.random.Generator) -> Tensor:
        stitcher, pictures = self._pictures(frame, "_depth")
        inverse = panorama.simulated_inverse_depth(stitcher.pick(pictures)[0], rng)
        depth = panorama.depth_from_inverse(inverse, stitcher.covered & ~self._ego)
        return self._filled(depth[None]) ** self.power

    def _semantics(self, frame: Frame, rng: np.random.Generator) -> Tensor:
        stitcher, pictures = self._pictures(frame, "_semantics")
        classes = labels.kitti_360_table()[stitcher.pick(pictures)[0].long()]
        said = labels.simulated_labels(torch.where(stitcher.covered, classes, labels.NOTHING), rng)
        return labels.coloured(torch.where(self._ego, labels.ROAD, said).to(torch.uint8))

    def _filled(self, values: Tensor) -> Tensor:
        """A map (1, H, W) without the own vehicle."""
        if self.ego_fill == "zero":
            return torch.where(self._ego, 0, values)
        return panorama.inpainted(values[0], self._ego)[None]

    @functools.cached_property
    def _own_vehicle(self) -> Tensor:
        from lidarfw.io import read_image

        picture = read_image(Path(self.ego_mask))
        if picture.shape[:2] != (self.view.height, self.view.width):
            raise DataError(
                f"{self.ego_mask}: expected {self.view.width} x {self.view.height} pixels, the panorama, found "
                f"{picture.shape[1]} x {picture.shape[0]}\n  fix: remove it, it is made again"
            )
        return torch.from_numpy(picture[..., 0] > 127)

    @property
    def _ego(self) -> Tensor:
        """(H, W) bool: pixel shows the own vehicle."""
        if not self.ego_mask or not Path(self.ego_mask).is_file():
            return torch.zeros(self.view.height, self.view.width, dtype=torch.bool)
        return self._own_vehicle


class RandomHeading(Transform):
    """Another heading of the vehicle: panoramas are rolled, bird's-eye views turned about their middle.

    The map of a bird's-eye view is interpolated; the sensor is in its middle. Poses stay: losses on places do not look
    at the heading.
    """

    train_only = True

    def __init__(self, *, angle: float = math.pi) -> None:
        """Options: angle, the heading changes by up to so much to either side, radians."""
        self.angle = angle

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The turned frame; all its panoramas and maps turn alike."""
        angle = float(rng.uniform(-self.angle, self.angle))
        return Frame({name: turned(value, angle) for name, value in frame.inputs.items()}, frame.targets, frame.meta)


class AnyHeading(RandomHeading):
    """The same in evaluation too, to see whether a descriptor knows a place from any side."""

    train_only = False


def turned(value: Any, angle: float) -> Any:
    """A panorama or bird's-eye view after the vehicle has turned right by `angle` radians; others stay as they are."""
    if isinstance(value, Image) and value.cameras[0].model == "equirectangular":
        step = round(angle / (2 * math.pi) * value.features.shape[3])
        return value.replace(features=value.features.roll(-step, 3))
    if isinstance(value, BEV):
        cos, sin = math.cos(angle), math.sin(angle)
        matrix = torch.tensor([[[cos, sin, 0], [-sin, cos, 0]]]).expand(value.batch_size, -1, -1)
        grid = torch.nn.functional.affine_grid(matrix, list(value.features.shape), align_corners=False)
        features = torch.nn.functional.grid_sample(value.features, grid, align_corners=False)
        return value.replace(features=features)
    return value
