"""What a feature looks like before it exists: specs flow through the assembly instead of numbers in configs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from lidarfw.types.features import BEV, Image, Points, RangeImage, Voxels
from lidarfw.types.geometry import Camera, Grid, RangeView
from lidarfw.types.predictions import Boxes, Descriptors, Matches, PointLabels, Poses, SceneCoords, Tracks

FEATURES: tuple[type, ...] = (Points, Voxels, BEV, RangeImage, Image)
PREDICTIONS: tuple[type, ...] = (Boxes, PointLabels, SceneCoords, Poses, Descriptors, Tracks, Matches)
VOCABULARY: dict[str, type] = {kind.__name__: kind for kind in (*FEATURES, *PREDICTIONS)}
_GEOMETRIES: dict[str, Any] = {kind.__name__: kind for kind in (Grid, RangeView, Camera)}


@dataclass(frozen=True)
class Spec:
    """Shape of one feature or prediction.

    `stride` is horizontal, in cells of the geometry; `depth` is the number of z cells of Voxels.
    """

    kind: type
    channels: int = 0
    stride: int = 1
    geometry: Grid | RangeView | Camera | None = None
    classes: tuple[str, ...] = ()
    depth: int = 1

    @property
    def grid(self) -> Grid:
        """The geometry, where it must be a Grid (Voxels and BEV)."""
        if not isinstance(self.geometry, Grid):
            raise TypeError(f"{self} has no Grid")
        return self.geometry

    def __str__(self) -> str:
        parts = [self.kind.__name__]
        parts += [f"{self.channels}ch"] if self.channels else []
        parts += [f"stride {self.stride}"] if self.stride > 1 else []
        parts += [f"{len(self.classes)} classes"] if self.classes else []
        return " ".join(parts)

    def to_plain(self) -> dict[str, Any]:
        """The spec as strings and numbers, for a checkpoint."""
        plain: dict[str, Any] = {"kind": self.kind.__name__, "channels": self.channels, "stride": self.stride}
        plain |= {"classes": list(self.classes), "depth": self.depth, "geometry": None}
        if self.geometry is not None:
            plain["geometry"] = {"type": type(self.geometry).__name__, **asdict(self.geometry)}
        return plain

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Spec:
        """Inverse of `to_plain`."""
        fields = dict(plain)
        fields["kind"] = VOCABULARY[fields["kind"]]
        fields["classes"] = tuple(fields["classes"])
        if fields["geometry"] is not None:
            values = {k: _tuples(v) for k, v in fields["geometry"].items() if k != "type"}
            fields["geometry"] = _GEOMETRIES[fields["geometry"]["type"]](**values)
        return cls(**fields)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, (list, tuple)) else value


@dataclass(frozen=True)
class DataSpec:
    """What a dataset offers; it is stored in checkpoints, so a model is rebuilt without its dataset."""

    inputs: dict[str, Spec] = field(default_factory=dict)  # by name: points, image, range, pose, ...
    targets: frozenset[type] = frozenset()  # kinds that are labelled: Boxes, PointLabels, ...
    classes: tuple[str, ...] = ()
    sweeps: int = 1  # scans per frame, the past ones included

    def to_plain(self) -> dict[str, Any]:
        """The data spec as strings and numbers, for a checkpoint."""
        return {
            "inputs": {name: spec.to_plain() for name, spec in self.inputs.items()},
            "targets": sorted(kind.__name__ for kind in self.targets),
            "classes": list(self.classes),
            "sweeps": self.sweeps,
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> DataSpec:
        """Inverse of `to_plain`."""
        inputs = {name: Spec.from_plain(spec) for name, spec in plain["inputs"].items()}
        targets = frozenset(VOCABULARY[name] for name in plain["targets"])
        return cls(inputs, targets, tuple(plain["classes"]), plain["sweeps"])


@dataclass(frozen=True)
class Stride:
    """Constraint of a forward parameter: `Annotated[BEV, Stride(8)]`."""

    value: int


@dataclass(frozen=True)
class Sweeps:
    """Constraint of a forward parameter: at least so many scans, `Annotated[Points, Sweeps(8)]`."""

    value: int


@dataclass(frozen=True)
class Tap:
    """The map that the regressors of the head predicting `kind` read: `Annotated[BEV, Tap(Boxes)]`."""

    kind: type
