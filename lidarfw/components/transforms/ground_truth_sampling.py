"""Ground-truth sampling: objects of other frames are put into the scene, so that rare classes are seen more often.

Source: Yan et al., "SECOND: Sparsely Embedded Convolutional Detection", Sensors 2018, section 3.2.5; the default
counts are those of Lang et al., "PointPillars", CVPR 2019, section 3.3.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from lidarfw._lazy import LazyModule
from lidarfw.components.transforms import object_database
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces.data import Dataset, Transform
from lidarfw.types import Boxes, DataSpec, Frame, Image, PointLabels, Points

if TYPE_CHECKING:
    import torch
    from torch import Tensor
else:
    torch = LazyModule("torch")


class GroundTruthSampling(Transform):
    """Fill the scene up with objects from a database, where they collide with nothing.

    Of each class so many objects are drawn that `counts` of it would stand in the scene; those whose bird's-eye-view
    rectangle meets a labelled or neutral object, or one drawn before, are dropped. The scene's points inside
    a pasted box go. Comes before the augmentations that move the scene. `lidarfw prepare` builds the database.
    """

    train_only = True

    def __init__(
        self,
        *,
        database: str = "",
        counts: dict[str, int] = {"Car": 15, "Pedestrian": 0, "Cyclist": 8},  # noqa: B006
        min_points: int = 5,
        road_plane: bool = False,
    ) -> None:
        """Options.

        database: folder of the database. counts: objects of each class in the filled scene. min_points: objects with
        fewer points are never drawn. road_plane: put the objects on the ground that the dataset knows for the frame.
        """
        if any(count < 0 for count in counts.values()):
            raise ConfigError(f"ground_truth_sampling.counts: expected numbers of 0 or more, found {counts}")
        self.database, self.counts, self.min_points, self.road_plane = database, counts, min_points, road_plane
        self._objects: object_database.ObjectDatabase | None = None
        self._pools: dict[str, np.ndarray] = {}
        self._dataset: Dataset | None = None

    def spec(self, data: DataSpec) -> DataSpec:
        """Unchanged; ConfigError where the data cannot be pasted into."""
        unknown = [name for name in self.counts if name not in data.classes]
        pictures = [name for name, spec in data.inputs.items() if spec.kind is Image]
        if Boxes not in data.targets or "points" not in data.inputs:
            raise ConfigError("ground_truth_sampling needs a dataset with the input points and labelled boxes")
        if pictures:
            raise ConfigError(
                f"ground_truth_sampling pastes points, but the input '{pictures[0]}' would not show the objects.\n"
                f"  fix: ~transform.ground_truth_sampling, or leave the picture out of the dataset"
            )
        if unknown:
            raise ConfigError(
                f"ground_truth_sampling.counts names the class '{unknown[0]}'.\n"
                f"  classes of the data: {', '.join(data.classes)}"
            )
        return data

    def prepare(self, dataset: Dataset, workers: int = 1) -> None:
        """Build the database from the labelled frames of `dataset`."""
        object_database.build(dataset, self._folder(), workers)

    def attach(self, dataset: Dataset) -> None:
        """Open the database and check that it is one of this dataset and split."""
        found = object_database.ObjectDatabase.load(self._folder())
        if found.split != dataset.split:
            raise DataError(
                f"the database {self.database} was cut out of the split '{found.split}', but frames of the split "
                f"'{dataset.split}' are to be filled: objects of one must not be seen in the other.\n"
                f"  fix: lidarfw prepare with the same splits.train, into a folder of its own"
            )
        missing = [name for name in self.counts if name not in found.classes]
        if missing:
            raise DataError(
                f"the database {self.database} has the classes {', '.join(found.classes)}, not {missing[0]}"
            )
        if self.road_plane and not hasattr(dataset, "road_plane"):
            raise ConfigError(f"ground_truth_sampling.road_plane: {type(dataset).__name__} knows no ground planes")
        self._objects, self._dataset = found, dataset
        self._pools = {name: self._pool(found, name) for name in self.counts}

    def _folder(self) -> str:
        if not self.database:
            raise ConfigError(
                "ground_truth_sampling.database is not set.\n  fix: transform.ground_truth_sampling.database=FOLDER"
            )
        return self.database

    def _pool(self, found: object_database.ObjectDatabase, name: str) -> np.ndarray:
        """Objects of a class with enough points."""
        rows: np.ndarray = found.boxes.label.numpy() == found.classes.index(name)
        return np.flatnonzero(rows & (np.diff(found.starts) >= self.min_points))

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame, filled up."""
        if self._objects is None or self._dataset is None:
            raise ConfigError("ground_truth_sampling was not told its dataset: call attach(dataset) first")
        boxes, ignored = frame.targets.boxes, frame.targets.ignored
        if boxes is None:
            return frame
        drawn = self._draw(boxes, self._dataset.spec.classes, rng)
        pasted = _relabel(self._objects, drawn, self._dataset.spec.classes)
        obstacles = boxes.tensor if ignored is None else torch.cat([boxes.tensor, ignored.tensor])
        fits = _collision_free(pasted.tensor, obstacles)
        if not len(fits):
            return frame
        pasted, drawn = pasted[fits], drawn[fits.numpy()]
        points, owner = self._objects.points_of(drawn)
        if self.road_plane:
            lift = _to_ground(pasted, cast(Any, self._dataset).road_plane(frame.meta.id))
            pasted.center[:, 2] += lift
            points.xyz[:, 2] += lift[owner]
        return _paste(frame, boxes, pasted, points)

    def _draw(self, boxes: Boxes, names: tuple[str, ...], rng: np.random.Generator) -> np.ndarray:
        """Rows of the database, class by class."""
        drawn = [np.zeros(0, np.int64)]
        for name, count in self.counts.items():
            pool, label = self._pools[name], names.index(name)
            wanted = count - int((boxes.label == label).sum())
            drawn.append(rng.choice(pool, min(max(wanted, 0), len(pool)), replace=False))
        return np.concatenate(drawn)


def _relabel(objects: object_database.ObjectDatabase, drawn: np.ndarray, names: tuple[str, ...]) -> Boxes:
    """The drawn objects, with the labels of the dataset."""
    boxes = objects.boxes[torch.from_numpy(drawn)]
    known = torch.tensor([names.index(name) if name in names else -1 for name in objects.classes])
    return boxes.replace(label=known[boxes.label])


def _to_ground(boxes: Boxes, plane: np.ndarray) -> Tensor:
    """(M,) metres that take the boxes' undersides to the plane a x + b y + c z + d = 0."""
    a, b, c, d = plane.tolist()
    ground = -(a * boxes.center[:, 0] + b * boxes.center[:, 1] + d) / c
    lift: Tensor = ground - boxes.center[:, 2] + boxes.size[:, 2] / 2
    return lift


def _paste(frame: Frame, boxes: Boxes, pasted: Boxes, points: Points) -> Frame:
    from lidarfw.ops import points_in_boxes

    scene, labels = frame.inputs["points"], frame.targets.points
    free = points_in_boxes(scene.xyz, pasted.tensor) < 0
    return frame.replace(
        inputs={**frame.inputs, "points": Points.cat([scene[free], points])},
        targets=frame.targets.replace(
            boxes=Boxes.cat([boxes, pasted]), points=None if labels is None else _extend(labels[free], len(points))
        ),
    )


def _extend(labels: PointLabels, count: int) -> PointLabels:
    """With `count` unlabelled points at the end: pasted objects are cut out by their boxes, not point by point."""
    unlabelled = PointLabels(
        labels.probability.new_zeros(count, labels.probability.shape[1]),
        labels.batch.new_zeros(count),
        instance=None if labels.instance is None else labels.instance.new_zeros(count),
    )
    return PointLabels.cat([labels, unlabelled])


def _collision_free(boxes: Tensor, obstacles: Tensor) -> Tensor:
    """Rows (K,) of the boxes (M, 7) that meet no obstacle and no earlier box that stays, ascending."""
    from lidarfw.ops import iou_bev, nms_rotated

    free = (iou_bev(boxes, obstacles) == 0).all(1).nonzero()[:, 0]
    kept = nms_rotated(boxes[free], -torch.arange(len(free), dtype=torch.float32), 0.0)
    return free[kept].sort().values
