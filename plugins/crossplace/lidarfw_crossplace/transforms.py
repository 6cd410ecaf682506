"""Frames -> panoramas of intensity, depth and semantics, alike for both sensors; and random headings for training."""

from __future__ import annotations

import functools
import hashlib
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from lidarfw._lazy import LazyModule
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Dataset, Transform
from lidarfw.types import BEV, Camera, DataSpec, Frame, Image, Points, RangeView, Spec

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from lidarfw_crossplace import alignment as aligning
    from lidarfw_crossplace import labels, networks, panorama
else:
    torch = LazyModule("torch")
    aligning = LazyModule("lidarfw_crossplace.alignment")
    networks = LazyModule("lidarfw_crossplace.networks")
    labels = LazyModule("lidarfw_crossplace.labels")
    panorama = LazyModule("lidarfw_crossplace.panorama")

CHANNELS = {"intensity": 1, "depth": 1, "semantics": 3}
FILLS = ("inpaint", "zero")
log = logging.getLogger(__name__)
_ALIGN_FRAMES = 50
_EGO_FRAMES = 200
_EGO_MOVES = 0.02  # standard deviation of the grey value below which a pixel shows the own vehicle


class Panorama(Transform):
    """The panorama of a frame by one of its sensors, which the frame's `modality` names: camera or lidar (paper 3).

    Gives the inputs `intensity` (grey value or remission), `depth` and `semantics` (colours of 16 classes), each an
    `Image` of values 0..1, and drops all others. Column and row of a direction are the same for both sensors.

    Scan: the nearest point of each pixel, range / `farthest`, gaps of a column filled. Camera: the fisheyes stitched by
    their calibration; depth from CAMERA_depth, raised to `power`; semantics from CAMERA_semantics. These two are the
    truth of a simulated rig, and are made as uncertain as networks for single pictures are; with `depth_network` and
    `semantics_network` they come from networks instead. Classes of points are those of the targets, or of the pictures
    that see them. What networks say is kept in `cache`, by `lidarfw prepare` for all frames that are trained on, in
    parallel, and for others when they are first asked for; what is there is not made again.
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
        alignment: str = "",
        ego_mask: str = "",
        ego_fill: str = "inpaint",
        depth_network: str = "",
        semantics_network: str = "",
        inpaint_network: str = "",
        cache: str = "",
        sphere: int = 1024,
    ) -> None:
        """Options.

        maps: which of intensity, depth, semantics. stack: give them as one input `panorama`, for early fusion. height,
        width, up, down: pixels, and elevations of the upper and lower edge in radians. nearest, farthest: metres, of
        points. gap: rows of a column that are filled between two points, negative for any. cameras: inputs to stitch.
        fov: of a camera, radians. alignment: file that says where the second of two cameras shows what the first does,
        by what both see (paper 3.1); made from the frames if it is not there; empty: by calibration alone. power: of
        the depth of pictures. ego_mask: picture, white where the own vehicle is; made from the frames if it is not
        there; empty for none. ego_fill: inpaint or zero, for intensity and depth of cameras; the classes there are
        road. depth_network, semantics_network: of the library transformers, by name or folder. inpaint_network:
        TorchScript file of LaMa, instead of the classical inpainting. cache: folder for what these say. sphere: columns
        of the panorama that they look at.
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
        if alignment and len(self.cameras) != 2:
            raise ConfigError(
                f"transform 'panorama': alignment is of two cameras, there are {len(self.cameras)}\n  fix: alignment=''"
            )
        self.alignment, self.ego_mask, self.ego_fill = alignment, ego_mask, ego_fill
        self.networks = {"depth": depth_network, "semantics": semantics_network, "inpaint": inpaint_network}
        self.cache, self.sphere = cache, sphere
        if any(self.networks.values()) and not cache:
            raise ConfigError(
                "transform 'panorama': networks need a folder for what they say\n"
                "  fix: transform.panorama.cache=runs/panoramas"
            )
        self.classes: tuple[str, ...] = ()

    def spec(self, data: DataSpec) -> DataSpec:
        """The panoramas instead of what the sensors gave. ConfigError where an input is missing."""
        simulated = [kind for kind in ("depth", "semantics") if kind in self.maps and not self.networks[kind]]
        kinds = [""] + [f"_{kind}" for kind in simulated]
        pictures = [f"{name}{kind}" for name in self.cameras for kind in kinds]
        seeing = any(name in data.inputs for name in self.cameras)
        missing = [name for name in pictures if name not in data.inputs]
        if missing and (seeing or "points" not in data.inputs):
            raise ConfigError(
                f"transform 'panorama' needs the input {missing[0]}; there are {', '.join(data.inputs)}\n"
                "  fix: transform.panorama.maps=[intensity], or depth and semantics by the dataset or by networks\n"
                "       (depth_network, semantics_network)"
            )
        channels = {name: CHANNELS[name] for name in self.maps}
        channels = {"panorama": sum(channels.values())} if self.stack else channels
        camera = panorama.camera_of(self.view)
        return DataSpec({n: Spec(Image, c, 1, camera) for n, c in channels.items()}, data.targets, data.classes)

    def attach(self, dataset: Dataset) -> None:
        """Know the classes of the points."""
        self.classes = tuple(dataset.spec.classes)

    def prepare(self, dataset: Dataset, workers: int = 1) -> None:
        """Make alignment and mask of the own vehicle from frames of the dataset, unless they stand; ask networks."""
        if self.alignment and not Path(self.alignment).is_file():
            self._align(dataset)
        if self.ego_mask and not Path(self.ego_mask).is_file():
            from lidarfw.draw import write_png

            greys = torch.stack([self._seen(dataset[number]) for number in _spread(len(dataset), _EGO_FRAMES)])
            still = (greys.std(0, correction=0) < _EGO_MOVES) & (greys.mean(0) > 0)
            write_png(self.ego_mask, np.repeat((still[0].numpy() * np.uint8(255))[..., None], 3, 2))
        if self._asked:
            self._ask_all(dataset, workers)

    def _align(self, dataset: Dataset) -> None:
        """Fit where the second camera shows what the first does, by frames of the dataset."""
        view, found = RangeView(1024, 4096, math.pi / 4, -math.pi / 4), []
        for number in _spread(len(dataset), _ALIGN_FRAMES):
            rig, pictures = self._rig(dataset[number])
            stitcher = panorama.stitcher(view, rig, self.fov)
            one, other = (panorama.grey(part)[0] for part in stitcher.alone(pictures))
            found.append(aligning.matches(one, other, (stitcher.weight > 0).all(0), view, aligning.azimuth_of(rig[1])))
        try:
            aligning.pooled(found).save(self.alignment)
        except DataError as error:
            log.warning("%s\n  the cameras are stitched by their calibration alone", error)
            aligning.Alignment().save(self.alignment)

    def _ask_all(self, dataset: Dataset, workers: int) -> None:
        """Ask the networks about every frame that is not in the cache, `workers` frames at a time."""
        from rich.progress import track

        metas, settings = [dataset.meta(number) for number in range(len(dataset))], self._settings()
        missing = [
            number
            for number, meta in enumerate(metas)
            if meta.modality != "lidar" and not networks.kept(networks.file_of(self.cache, meta.id), settings)
        ]
        work = torch.utils.data.DataLoader(  # its processes are started, fed and ended by torch
            networks.Work(self, dataset, missing), None, num_workers=workers if workers > 1 else 0
        )
        for _ in track(work, "networks look at pictures", total=len(missing), transient=True):
            pass

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
        missing = [f"{name}_semantics" for name in self.cameras if f"{name}_semantics" not in frame.inputs]
        if missing:
            raise DataError(
                f"frame {frame.meta.id}: transform 'panorama' finds no classes of its points: they have no labels, and "
                f"there is no input {missing[0]}\n"
                "  fix: data with classes of points, or a model without the map semantics"
            )
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
        said = self.said(frame)
        makers = {"intensity": lambda: self._grey(frame) if said.intensity is None else said.intensity[None],
                  "depth": lambda: self._depth(frame, rng, said) ** self.power,
                  "semantics": lambda: self._semantics(frame, rng, said)}  # fmt: skip
        return {name: makers[name]() for name in self.maps}

    def said(self, frame: Frame) -> networks.Said:
        """What networks say of the pictures of a frame: from the cache, else asked now and kept."""
        if not self._asked:
            return networks.Said()
        path, settings = networks.file_of(self.cache, frame.meta.id), self._settings()
        if path.is_file():
            return networks.Said.load(path, settings)
        said = self._ask(frame)
        said.save(path, settings)
        return said

    @property
    def _asked(self) -> list[str]:
        """The maps that come from networks."""
        answering = {"intensity": "inpaint", "depth": "depth", "semantics": "semantics"}
        return [name for name in CHANNELS if name in self.maps and self.networks[answering[name]]]

    def _settings(self) -> str:
        """All that an answer depends on; of the own vehicle its mask, whatever its file is called."""
        mask = hashlib.blake2b(self._ego.numpy().tobytes(), digest_size=8).hexdigest()
        return (
            f"{', '.join(self._asked)} by {self.networks} in {self.view} of {self.sphere} columns, cameras "
            f"{', '.join(self.cameras)} of {self.fov} radians, {self._aligned}, own vehicle {mask} "
            f"filled by {self.ego_fill}"
        )

    def _ask(self, frame: Frame) -> networks.Said:
        """Let the networks look at the whole stitched panorama, and cut out what the LiDAR sees."""
        whole = panorama.sphere(self.sphere)
        stitcher, pictures = self._pictures(frame, view=whole)
        picture, crop = stitcher.blend(pictures), panorama.stitcher(self.view, (panorama.camera_of(whole),), math.pi)
        said = networks.Said()
        if "depth" in self.maps and self._depth_network:
            inverse = crop.blend([self._depth_network(picture)[None]])[0]
            covered = crop.blend([stitcher.covered[None].float()])[0] > 0.5
            said.depth = self._filled(panorama.depth_from_inverse(inverse, covered & ~self._ego)[None])[0]
        if "semantics" in self.maps and self._semantics_network:
            said.classes = crop.pick([self._semantics_network(picture)[None].float()])[0].to(torch.uint8)
        if "intensity" in self._asked:
            said.intensity = self._grey(frame)[0]
        return said

    @functools.cached_property
    def _depth_network(self) -> networks.DepthNetwork:
        return networks.DepthNetwork(self.networks["depth"])

    @functools.cached_property
    def _semantics_network(self) -> networks.SemanticNetwork:
        return networks.SemanticNetwork(self.networks["semantics"])

    @functools.cached_property
    def _inpaint_network(self) -> networks.InpaintingNetwork | None:
        return networks.InpaintingNetwork(self.networks["inpaint"]) if self.networks["inpaint"] else None

    def _pictures(
        self, frame: Frame, kind: str = "", view: RangeView | None = None
    ) -> tuple[panorama.Stitcher, list[Tensor]]:
        rig, pictures = self._rig(frame, kind)
        return panorama.stitcher(view or self.view, rig, self.fov, alignment=self._aligned), pictures

    def _rig(self, frame: Frame, kind: str = "") -> tuple[tuple[Camera, ...], list[Tensor]]:
        """The cameras and their pictures (C, h, w)."""
        missing = [name for name in self.cameras if f"{name}{kind}" not in frame.inputs]
        if missing:
            raise DataError(f"frame {frame.meta.id} has no input {missing[0]}{kind}; it has {', '.join(frame.inputs)}")
        images = [frame.inputs[f"{name}{kind}"] for name in self.cameras]
        return tuple(image.cameras[0] for image in images), [image.features[0] for image in images]

    @functools.cached_property
    def _aligned(self) -> aligning.Alignment:
        if self.alignment and not Path(self.alignment).is_file():
            raise DataError(f"{self.alignment}: no such file\n  fix: lidarfw prepare with this experiment makes it")
        return aligning.Alignment.load(self.alignment) if self.alignment else aligning.Alignment()

    def _seen(self, frame: Frame) -> Tensor:
        """(1, H, W) grey values, own vehicle and all."""
        stitcher, pictures = self._pictures(frame)
        return panorama.grey(stitcher.blend(pictures))

    def _grey(self, frame: Frame) -> Tensor:
        return self._filled(self._seen(frame))

    def _depth(self, frame: Frame, rng: np.random.Generator, said: networks.Said) -> Tensor:
        if said.depth is not None:
            return said.depth[None]
        stitcher, pictures = self._pictures(frame, "_depth")
        inverse = panorama.simulated_inverse_depth(stitcher.pick(pictures)[0], rng)
        depth = panorama.depth_from_inverse(inverse, stitcher.covered & ~self._ego)
        return self._filled(depth[None])

    def _semantics(self, frame: Frame, rng: np.random.Generator, said: networks.Said) -> Tensor:
        classes = said.classes
        if classes is None:
            stitcher, pictures = self._pictures(frame, "_semantics")
            truth = labels.kitti_360_table()[stitcher.pick(pictures)[0].long()]
            classes = labels.simulated_labels(torch.where(stitcher.covered, truth, labels.NOTHING), rng)
        return labels.coloured(torch.where(self._ego, labels.ROAD, classes).to(torch.uint8))

    def _filled(self, values: Tensor) -> Tensor:
        """A map (1, H, W) without the own vehicle."""
        if self.ego_fill == "zero":
            return torch.where(self._ego, 0, values)
        if self._inpaint_network and bool(self._ego.any()):
            return self._inpaint_network(values[0], self._ego)[None]
        return panorama.inpainted(values[0], self._ego)[None]

    @functools.cached_property
    def _own_vehicle(self) -> Tensor:
        from lidarfw.io import read_image

        if not Path(self.ego_mask).is_file():
            raise DataError(
                f"{self.ego_mask}: the mask of the own vehicle is not there (transform.panorama.ego_mask)\n"
                "  fix: lidarfw prepare with the overrides of the training makes it, in the folder that this runs in"
            )
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
        if not self.ego_mask:
            return torch.zeros(self.view.height, self.view.width, dtype=torch.bool)
        return self._own_vehicle


def _spread(count: int, most: int) -> list[int]:
    """At most so many numbers of frames, evenly spread."""
    return [int(number) for number in np.unique(np.linspace(0, count - 1, min(count, most)).round())]


class RandomHeading(Transform):
    """Another heading of the vehicle: panoramas are rolled, bird's-eye views turned about their middle.

    The map of a bird's-eye view is interpolated; the sensor is in its middle. With `shift` it is moved too, as if the
    vehicle had driven a little beside. Poses stay: losses on places do not look at the heading, nor at so little.
    """

    train_only = True

    def __init__(self, *, angle: float = math.pi, shift: float = 0.0) -> None:
        """Options: angle, the heading changes by up to so much to either side, radians; shift, of bird's-eye views
        along each axis, up to so many metres."""
        self.angle, self.shift = angle, shift

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The turned frame; all its panoramas and maps turn alike."""
        angle = float(rng.uniform(-self.angle, self.angle))
        x, y = (float(value) for value in rng.uniform(-self.shift, self.shift, 2))
        inputs = {name: turned(value, angle, (x, y)) for name, value in frame.inputs.items()}
        return Frame(inputs, frame.targets, frame.meta)


class AnyHeading(RandomHeading):
    """The same in evaluation too, to see whether a descriptor knows a place from any side."""

    train_only = False


def turned(value: Any, angle: float, shift: tuple[float, float] = (0.0, 0.0)) -> Any:
    """A panorama or bird's-eye view after the vehicle has turned right by `angle` radians; others stay as they are.

    `shift`, metres along columns and rows: how far a bird's-eye view is moved.
    """
    if isinstance(value, Image) and value.cameras[0].model == "equirectangular":
        step = round(angle / (2 * math.pi) * value.features.shape[3])
        return value.replace(features=value.features.roll(-step, 3))
    if isinstance(value, BEV):
        cos, sin = math.cos(angle), math.sin(angle)
        (x0, y0, _), (x1, y1, _) = value.grid.lower, value.grid.upper
        across, down = 2 * shift[0] / (x1 - x0), 2 * shift[1] / (y1 - y0)  # in units of half the map
        matrix = torch.tensor([[[cos, sin, across], [-sin, cos, down]]]).expand(value.batch_size, -1, -1)
        grid = torch.nn.functional.affine_grid(matrix, list(value.features.shape), align_corners=False)
        features = torch.nn.functional.grid_sample(value.features, grid, align_corners=False)
        return value.replace(features=features)
    return value
