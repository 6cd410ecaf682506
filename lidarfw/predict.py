"""From scan and picture files to results and pictures: what `lidarfw predict` does, for use from Python too."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lidarfw import draw, kitti
from lidarfw.assembly import make_dataset, make_transforms
from lidarfw.components.datasets.drives import read_table
from lidarfw.data import evaluation_data
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import atomic_path, natural, write_text
from lidarfw.io import IMAGE_SUFFIXES, SCAN_READERS, read_image, read_points
from lidarfw.model import PerceptionModel
from lidarfw.ops import transform
from lidarfw.types import (
    Boxes,
    Camera,
    DataSpec,
    Frame,
    FrameMeta,
    FrameResult,
    Grid,
    Image,
    PointLabels,
    Points,
    Poses,
    RangeImage,
    Spec,
    Targets,
)

PERIOD = 0.1  # seconds between the scans of a folder, where nothing says otherwise
FORMATS = ("json", "npz", "kitti", "label")
_SHOWN = 400  # points of a scan in the picture of a trajectory


@dataclass(frozen=True)
class Source:
    """The files of one frame."""

    path: Path  # the scan, or the picture of a model without LiDAR
    calibration: Path | None = None
    image: Path | None = None

    @property
    def id(self) -> str:
        """Name of the frame, and of the files written for it."""
        return re.sub(r"\.(pcd\.bin|[^.]+)$", "", self.path.name, flags=re.IGNORECASE)


# From files to frames


def find_sources(
    paths: Sequence[str | Path], lidar: bool, calibration: Path | None = None, image: Path | None = None
) -> list[Source]:
    """The frames in files and folders; a folder gives its scans (pictures, unless `lidar`) in order of their names.

    Calibration and picture of a scan in KITTI's layout (ROOT/velodyne/ID.bin) are found beside it. DataError where
    there is nothing, or two frames would write the same files.
    """
    suffixes = tuple(SCAN_READERS) if lidar else IMAGE_SUFFIXES
    files = [file for path in paths for file in _files(Path(path), suffixes)]
    if image is not None and len(files) != 1:
        raise DataError(f"--image is the picture of one scan, and there are {len(files)}; leave it out")
    sources = [_source(file, calibration, image, lidar) for file in files]
    seen: dict[str, Source] = {}
    for source in sources:
        if source.id in seen:
            raise DataError(
                f"{seen[source.id].path} and {source.path} would both write {source.id}.*\n"
                f"  fix: predict them in two runs with an -o of their own"
            )
        seen[source.id] = source
    return sources


def _files(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    if not path.is_dir():
        return [path]
    files = [file for file in path.iterdir() if file.suffix.lower() in suffixes and file.is_file()]
    if not files:
        raise DataError(f"{path}: no file in this folder ends in {', '.join(suffixes)}")
    return sorted(files, key=lambda file: natural(file.name))


def _source(file: Path, calibration: Path | None, image: Path | None, lidar: bool) -> Source:
    if not lidar:
        return Source(file, calibration, file)
    root, name = file.absolute().parent.parent, Source(file).id
    beside = root / "calib" / f"{name}.txt"
    pictures = [root / "image_2" / f"{name}{suffix}" for suffix in IMAGE_SUFFIXES]
    return Source(
        file,
        calibration or (beside if beside.is_file() else None),
        image or next((picture for picture in pictures if picture.is_file()), None),
    )


class FrameReader:
    """Makes the frames that a model learned from out of files: inputs of the model's data spec, then its transforms."""

    def __init__(
        self, model: PerceptionModel, columns: int | None = None, repair: bool = False, intensity_max: float = 1.0
    ) -> None:
        """Options are those of `lidarfw.io.read_points`; intensities are divided by `intensity_max`."""
        self.data = model.plan.data
        if not 0 < intensity_max < math.inf:
            raise ConfigError(f"the full scale of intensity must be above 0, got {intensity_max:g}")
        if columns is not None and columns < 3:
            raise ConfigError(f"a scan has at least 3 columns (x, y, z), got {columns}")
        self.columns, self.repair, self.intensity_max = columns, repair, intensity_max
        self.transforms = make_transforms(model.plan.config, training=False)
        self.needed = needed_inputs(model)
        self.given = _given(model, self.needed)  # inputs of the dataset, before the transforms
        self.left_out: tuple[str, ...] = ()  # features of the last scan that the model does not know

    @property
    def lidar(self) -> bool:
        """Whether the model needs scans, and not pictures alone."""
        return self.given is not self.data or any(self.data.inputs[name].kind is not Image for name in self.needed)

    def read(self, source: Source, sequence: str = "", index: int = 0) -> Frame:
        """The frame of one source. DataError where a file is broken or is not what the model needs."""
        picture = read_image(source.image) if source.image else None
        cameras = _cameras(source, picture)
        path, images = str(source.path), {kitti.IMAGE: str(source.image)} if source.image else {}
        meta = FrameMeta(source.id, sequence or source.id, index, index * PERIOD, cameras, path, images)
        inputs: dict[str, Any] = {}
        for name, spec in self.given.inputs.items():
            if spec.kind is Points and self.lidar:
                inputs[name] = self._points(source, spec)
            elif self.given is self.data and spec.kind is Image and (picture is not None or name in self.needed):
                inputs[name] = _image(source, spec, picture, cameras)
        frame = Frame(inputs, Targets(), meta)
        for change in self.transforms:
            frame = change(frame, np.random.default_rng(0))
        self._check_inputs(source, frame)
        return frame

    def _points(self, source: Source, spec: Spec) -> Points:
        scan = read_points(source.path, self.columns, self.repair)
        if scan.features.shape[1] < spec.channels:
            raise DataError(
                f"{source.path}: has {scan.features.shape[1]} features per point ({', '.join(scan.names) or 'none'}), "
                f"the model learned from {spec.channels}"
            )
        self.left_out = scan.names[spec.channels :]
        features = torch.tensor(scan.features[:, : spec.channels])
        if spec.channels:
            features[:, 0] /= self.intensity_max
            _check_intensity(source.path, features[:, 0])
        time = torch.zeros(len(features)) if self.data.sweeps > 1 else None
        return Points.from_scan(torch.tensor(scan.xyz), features, time)

    def _check_inputs(self, source: Source, frame: Frame) -> None:
        missing = [name for name in self.needed if name not in frame.inputs]
        if missing:
            kinds = ", ".join(f"{name} ({self.data.inputs[name].kind.__name__})" for name in missing)
            raise DataError(f"{source.path}: the model also needs {kinds}, which files alone do not give")


def _given(model: PerceptionModel, needed: set[str]) -> DataSpec:
    """The data spec that files are read for: after the transforms, which usually add inputs to those of the dataset.

    The dataset's own where transforms make what is needed of scans that they do not keep, such as panoramas.
    """
    data, config = model.plan.data, model.plan.config
    if any(spec.kind is Points for spec in data.inputs.values()) or not config.get("transform"):
        return data
    before = make_dataset(config, config.get("splits", {}).get("train", "train")).spec
    scans = any(spec.kind is Points for spec in before.inputs.values())
    return before if scans and not needed <= set(before.inputs) else data


def needed_inputs(model: PerceptionModel) -> set[str]:
    """Names of the data inputs that the parts of the model read at inference."""
    slots = ("backbone", "neck", "head", "postprocessor", "filter", "tracker", "retriever")
    refs = [
        ref
        for slot in slots
        for step in model.plan.of(slot)
        for p in step.parameters
        for ref in step.takes[p.name]
        if not p.optional
    ]
    return {ref.producer.removeprefix("data.") for ref in refs if ref.producer.startswith("data.")}


def _check_intensity(path: Path, values: torch.Tensor) -> None:
    low, high = float(values.min()), float(values.max())
    if not (low >= 0 and high <= 1):  # of NaN neither is true
        guess = 255 if high <= 255 else 65535
        raise DataError(
            f"{path}: intensity is {low:g}..{high:g}, models learn from 0..1.\n"
            f"  fix: --intensity-max {guess} divides it (or --columns N, if the file has not the usual columns)"
        )


def _cameras(source: Source, picture: draw.Picture | None) -> dict[str, Camera]:
    if source.calibration is None:
        return {}
    width, height = (picture.shape[1], picture.shape[0]) if picture is not None else (1242, 375)
    return kitti.read_calibration(source.calibration).cameras(width, height)


def _image(source: Source, spec: Spec, picture: draw.Picture | None, cameras: dict[str, Camera]) -> Image:
    """The picture as an input, at the size that the model learned from: smaller ones get a black border."""
    if picture is None:
        raise DataError(
            f"{source.path}: the model needs a picture of the camera too\n"
            "  fix: image_2/NAME.png beside velodyne/NAME.bin, or lidarfw predict --image FILE"
        )
    height, width = picture.shape[:2]
    learned = spec.geometry if isinstance(spec.geometry, Camera) else None
    size = (learned.width, learned.height) if learned else (width, height)
    camera = cameras.get(kitti.IMAGE) or (learned if size == (width, height) else None)
    if camera is None:
        raise DataError(
            f"{source.path}: the calibration of the camera is not known\n  fix: --calib FILE (KITTI's form)"
        )
    if width > size[0] or height > size[1]:
        raise DataError(
            f"{source.image}: is {width} x {height} pixels, the model learned from at most {size[0]} x {size[1]}"
        )
    canvas = torch.zeros(1, 3, size[1], size[0])
    canvas[0, :, :height, :width] = torch.tensor(picture.transpose(2, 0, 1)) / 255
    return Image(canvas, (camera.cropped(0, 0, *size),))


class SplitFrames(Sequence[Frame]):
    """The frames of a split of the dataset that a model learned from, with their truth, after its transforms."""

    def __init__(self, model: PerceptionModel, split: str) -> None:
        config = model.plan.config
        if not config.get("dataset"):
            raise ConfigError("the checkpoint names no dataset, so it has no splits\n  fix: give scans instead")
        self.dataset, self.transforms = evaluation_data(config, config.get("splits", {}).get(split, split))

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        frame = self.dataset[range(len(self))[index]]
        for change in self.transforms:
            frame = change(frame, np.random.default_rng(0))
        return frame


# Through the model


def predict(
    model: PerceptionModel, reader: FrameReader, sources: Iterable[Source], stream: bool = False
) -> Iterator[FrameResult]:
    """Results in order of the sources, on the CPU.

    With `stream` the sources are one sequence, `PERIOD` apart: filters keep their state and the tracker follows
    objects; without, every one stands for itself.
    """
    return predict_frames(model, read_frames(reader, sources, stream), stream)


def read_frames(reader: FrameReader, sources: Iterable[Source], stream: bool = False) -> Iterator[Frame]:
    """The frames of the sources; with `stream` they are one sequence."""
    for index, source in enumerate(sources):
        yield reader.read(source, "sequence", index) if stream else reader.read(source)


def predict_frames(model: PerceptionModel, frames: Iterable[Frame], stream: bool = False) -> Iterator[FrameResult]:
    """Results in order of the frames, on the CPU; with `stream` frames of one sequence follow each other."""
    running = model.stream()
    for frame in frames:
        for result in [*running.step(frame), *([] if stream else running.flush())]:
            yield _on_cpu(result)
    for result in running.flush():
        yield _on_cpu(result)


def _on_cpu(result: FrameResult) -> FrameResult:
    predictions = {name: value.to("cpu") for name, value in result.predictions.items()}
    inputs = {name: value.to("cpu") for name, value in result.inputs.items()}
    tracks = None if result.tracks is None else result.tracks.to("cpu")
    return dataclasses.replace(result, predictions=predictions, inputs=inputs, tracks=tracks)


def keep_scores(result: FrameResult, score: float) -> FrameResult:
    """The result without boxes and tracks below a score."""
    kept = {n: v[v.score >= score] if isinstance(v, Boxes) else v for n, v in result.predictions.items()}
    tracks = result.tracks
    if tracks is not None:
        chosen = tracks.boxes.score >= score
        moving = None if tracks.moving is None else tracks.moving[chosen]
        tracks = tracks.replace(boxes=tracks.boxes[chosen], id=tracks.id[chosen], moving=moving)
    return dataclasses.replace(result, predictions=kept, tracks=tracks)


# To files


def save(result: FrameResult, folder: Path, form: str, classes: Sequence[str]) -> list[Path]:
    """Write one result as `form` (json, npz, kitti, label); the files, named by the frame."""
    if form == "json":
        path = folder / f"{result.meta.id}.json"
        write_text(path, _json(to_plain(result, classes)))
        return [path]
    if form == "npz":
        path = folder / f"{result.meta.id}.npz"
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, allow_pickle=False, **_arrays(result, classes))
        return [path]
    if form == "label":
        from lidarfw.drive_prediction import save_labels

        return [save_labels(result, folder, classes)]
    return _save_kitti(result, folder, classes)


def _json(plain: dict[str, Any]) -> str:
    """Indented, with each list of numbers on a line of its own."""
    text = json.dumps(plain, indent=1)
    return re.sub(r"\[\s+([^][{}\"]*?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text) + "\n"


def _save_kitti(result: FrameResult, folder: Path, classes: Sequence[str]) -> list[Path]:
    boxes = {name: value for name, value in result.predictions.items() if isinstance(value, Boxes)}
    if not boxes:
        there = ", ".join(f"{n} ({type(v).__name__})" for n, v in result.predictions.items()) or "nothing"
        raise DataError(f"KITTI text holds boxes, and this model gives {there}\n  fix: --format json")
    paths = []
    for name, value in boxes.items():
        path = (folder / name if len(boxes) > 1 else folder) / f"{result.meta.id}.txt"
        kitti.write_results(path, kitti.labels_from_boxes(value, classes, result.meta.cameras))
        paths.append(path)
    return paths


def to_plain(result: FrameResult, classes: Sequence[str]) -> dict[str, Any]:
    """A result as numbers, strings, lists and dicts. Metres and radians in the sensor frame (x ahead, y left, z up)."""
    plain: dict[str, Any] = {"id": result.meta.id, "path": result.meta.path, "classes": list(classes)}
    plain["predictions"] = {
        name: {"kind": type(value).__name__, **_fields(value, classes)} for name, value in result.predictions.items()
    }
    if result.tracks is not None:
        rows = _rows(result.tracks.boxes, classes)
        plain["tracks"] = [{"id": number, **row} for number, row in zip(result.tracks.id.tolist(), rows, strict=True)]
    return plain


def _fields(value: Any, classes: Sequence[str]) -> dict[str, Any]:
    if isinstance(value, Boxes):
        return {"boxes": _rows(value, classes)}
    if isinstance(value, PointLabels):
        return {"label": value.label.tolist()}
    return {name: _numbers(tensor) for name, tensor in _tensors(value).items()}


def _numbers(tensor: torch.Tensor) -> Any:
    """Nested lists, without the digits that float32 does not have."""
    return tensor.double().round(decimals=5).tolist() if tensor.is_floating_point() else tensor.tolist()


def _rows(boxes: Boxes, classes: Sequence[str]) -> list[dict[str, Any]]:
    """One dict per box: class, score, center, size, yaw, and what else the head predicts."""
    columns = {name: _numbers(tensor) for name, tensor in _tensors(boxes).items() if name not in ("batch", "label")}
    names = [classes[label] if 0 <= label < len(classes) else str(label) for label in boxes.label.tolist()]
    order = ["score", "center", "size", "yaw", *(n for n in columns if n not in ("score", "center", "size", "yaw"))]
    return [{"class": name, **{key: columns[key][i] for key in order}} for i, name in enumerate(names)]


def _tensors(record: Any) -> dict[str, torch.Tensor]:
    found = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return {name: value for name, value in found.items() if isinstance(value, torch.Tensor)}


def _arrays(result: FrameResult, classes: Sequence[str]) -> dict[str, np.ndarray]:
    """Every tensor of the predictions as PRODUCER.FIELD ("head.center.yaw"), those of the tracks as tracks.FIELD."""
    arrays = {
        f"{name}.{key}": tensor.numpy()
        for name, value in result.predictions.items()
        for key, tensor in _tensors(value).items()
    }
    if result.tracks is not None:
        arrays |= {f"tracks.{key}": tensor.numpy() for key, tensor in _tensors(result.tracks.boxes).items()}
        arrays |= {f"tracks.{key}": tensor.numpy() for key, tensor in _tensors(result.tracks).items()}
    return {**arrays, "classes": np.array(list(classes), dtype=np.str_)}


def save_pictures(
    result: FrameResult, folder: Path, classes: Sequence[str], extent: draw.Extent | None = None
) -> list[Path]:
    """ID_bev.png with the scan from above, ID_range.png of labels in a range image, and ID_image.png where picture and
    calibration are known."""
    pictures = pictures_of(result, classes, extent)
    paths = [folder / f"{result.meta.id}_{name}.png" for name in pictures]
    for path, picture in zip(paths, pictures.values(), strict=True):
        draw.write_png(path, picture)
    return paths


def extent_of(model: PerceptionModel) -> draw.Extent | None:
    """The ground that the model looks at: that of its first grid; None where it has none."""
    for step in [*model.plan.of("backbone"), *model.plan.of("neck")]:
        provided = model.component(step).provides
        for spec in _flat(provided):
            if isinstance(spec.geometry, Grid):
                (x0, y0, _), (x1, y1, _) = spec.geometry.lower, spec.geometry.upper
                return x0, x1, y0, y1
    return None


def _flat(provided: Any) -> list[Spec]:
    return [s for part in provided for s in _flat(part)] if isinstance(provided, (list, tuple)) else [provided]


def pictures_of(
    result: FrameResult, classes: Sequence[str], extent: draw.Extent | None = None
) -> dict[str, draw.Picture]:
    """Pictures of a result by name: bev (of `extent`, by default of all points), range (labels in the range image),
    image. Truth is drawn where known."""
    found = result.tracks or _all_boxes(result)
    truth = result.targets.boxes if result.targets else None
    pictures = {}
    scan = next((value for value in result.inputs.values() if isinstance(value, Points)), None)
    if scan is not None:
        labels = next((value for value in result.predictions.values() if isinstance(value, PointLabels)), None)
        title = result.meta.id
        pictures["bev"] = draw.birds_eye(scan, found, truth, classes, labels=labels, extent=extent, title=title)
        image = next((value for value in result.inputs.values() if isinstance(value, RangeImage)), None)
        if labels is not None and image is not None:
            pictures["range"] = draw.range_labels(image, scan, labels, classes)
    camera = result.meta.cameras.get(kitti.IMAGE)
    picture = _picture_of(result)
    if camera is not None and picture is not None and found is not None:
        pictures["image"] = draw.camera_view(picture, camera, found, truth, classes)
    return pictures


class Trajectory:
    """The poses of many results, for one picture on the map.

    `background` (P, 3) are points of the map; without them a few points of every scan stand in, put where the scan's
    pose says.
    """

    def __init__(self, background: torch.Tensor | None = None) -> None:
        self.background = background
        self.found: list[Poses] = []
        self.truth: list[torch.Tensor] = []
        self._scans: list[torch.Tensor] = []

    def __len__(self) -> int:
        return len(self.found)

    def add(self, result: FrameResult, truth: torch.Tensor | None = None) -> None:
        """Take in a result that has a pose; `truth` (4, 4) where the result itself does not know it."""
        poses = next((value for value in result.predictions.values() if isinstance(value, Poses)), None)
        if poses is None:
            return
        self.found.append(poses)
        known = result.targets.poses if result.targets is not None else None
        truth = known.matrix[0] if known is not None and bool(known.ok[0]) else truth
        self.truth += [] if truth is None else [truth]
        scan = next((value for value in result.inputs.values() if isinstance(value, Points)), None)
        if self.background is None and scan is not None and bool(poses.ok[0]):
            thinned = scan.xyz[:: max(len(scan) // _SHOWN, 1)]
            self._scans.append(transform(poses.matrix[0].to(thinned.dtype), thinned))

    def errors(self) -> torch.Tensor | None:
        """(N, 2) metres and degrees, inf where no pose was found; None unless the truth of every frame is known."""
        if len(self.truth) != len(self.found) or not self.found:
            return None
        from lidarfw.components.metrics.pose_error import pose_errors

        found = self._poses()
        errors = pose_errors(found.matrix, torch.stack(self.truth))
        return torch.where(found.ok[:, None], errors, torch.inf)

    def summary(self) -> str:
        """Median errors in a line, or how many poses were found."""
        errors, found = self.errors(), self._poses()
        text = f"{int(found.ok.sum())} of {len(self)} poses found"
        if errors is None:
            return text
        metres, degrees = errors.sort(0).values[(len(errors) - 1) // 2].tolist()
        return f"{text}, median error {metres:.2f} m, {degrees:.2f} degrees"

    def picture(self) -> draw.Picture:
        """All poses on the map, coloured by their error where the truth is known."""
        background = self.background
        if background is None and self._scans:
            background = torch.cat(self._scans)
        truth = torch.stack(self.truth) if self.errors() is not None else None
        return draw.trajectory(self._poses(), truth, background, self.summary())

    def _poses(self) -> Poses:
        return Poses(*(torch.cat([getattr(p, n) for p in self.found]) for n in ("matrix", "ok", "confidence")))


def read_poses(path: Path, count: int) -> torch.Tensor:
    """(N, 4, 4) poses of a file with the 12 numbers of a 3 x 4 matrix in each line (KITTI's form), one per scan."""
    table = read_table(path, 12)
    if len(table) != count:
        raise DataError(f"{path}: has {len(table)} poses for {count} scans; one line per scan is needed")
    matrix = torch.eye(4, dtype=torch.float64).repeat(count, 1, 1)
    matrix[:, :3] = torch.from_numpy(table).view(-1, 3, 4)
    return matrix


def _picture_of(result: FrameResult) -> draw.Picture | None:
    if kitti.IMAGE in result.meta.images:
        return read_image(result.meta.images[kitti.IMAGE])
    image = next((value for value in result.inputs.values() if isinstance(value, Image)), None)
    return None if image is None else (image.features[0].permute(1, 2, 0).clamp(0, 1) * 255).byte().numpy()


def _all_boxes(result: FrameResult) -> Boxes | None:
    boxes = [value for value in result.predictions.values() if isinstance(value, Boxes)]
    return Boxes.cat(boxes) if boxes else None
