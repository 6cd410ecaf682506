"""Interfaces of the data side: Dataset and Transform. Importing them does not import torch."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from typing_extensions import Self

from lidarfw.types import DataSpec, Frame, FrameMeta

if TYPE_CHECKING:
    import numpy as np


class Dataset(ABC):
    """Frames of one split.

    `__init__` takes keyword-only options, `split` among them, and must not touch the disk: `spec`
    is asked before any file is there. `prepare` may download, generate or index.
    """

    example: ClassVar[dict[str, Any]] = {}  # options for the conformance kit
    spec: DataSpec
    split: str  # train, val, test, or what the dataset names
    _given: tuple[tuple[Any, ...], dict[str, Any]]

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Note the options, whatever `__init__` makes of them."""
        dataset = super().__new__(cls)
        dataset._given = args, options
        return dataset

    def given_options(self) -> dict[str, Any]:
        """The options it was made with, by name, defaults included: they tell it from others of its class."""
        args, options = self._given
        bound = inspect.signature(type(self).__init__).bind(self, *args, **options)
        bound.apply_defaults()
        return dict(list(bound.arguments.items())[1:])

    def prepare(self, workers: int = 0) -> None:
        """Make the files ready; called once, on one process, before the first frame is read.

        It may start so many `workers`, with 0 as many as its own options say.
        """

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, index: int) -> Frame: ...

    def meta(self, index: int) -> FrameMeta:
        """Sequence, index and id of a frame without reading its sensor data, for samplers."""
        return FrameMeta(id=str(index), sequence="", index=index)

    def sequences(self) -> list[Sequence[int]]:
        """Frame numbers of each sequence in order of time. Default: all frames are one sequence."""
        return [range(len(self))]

    def positions(self) -> np.ndarray | None:
        """Where each frame was taken, (N, 3) metres in the map, without reading sensor data; None where not known."""
        return None


class Transform(ABC):
    """Changes a frame on a CPU worker: augmentation, or another representation of the data.

    `__init__` takes keyword-only options. A transform that also needs the dataset (ground-truth
    sampling, say) gets it by `attach`.
    """

    example: ClassVar[dict[str, Any]] = {}  # options for the conformance kit
    train_only: bool = False  # augmentations are left out in evaluation and prediction
    follows: ClassVar[tuple[str, ...]] = ()  # transforms that must come before it; it may then count on past scans

    @abstractmethod
    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The changed frame. All randomness comes from `rng`, which depends on (seed, epoch, index) alone."""

    def spec(self, data: DataSpec) -> DataSpec:
        """The data spec after this transform. Default: unchanged."""
        return data

    def prepare(self, dataset: Dataset, workers: int = 1) -> None:
        """Write what the transform needs of the whole dataset, unless it stands already.

        Called on one process before training, and by `lidarfw prepare`, with as many `workers` as it may start.
        """

    def attach(self, dataset: Dataset) -> None:
        """Told once which dataset the frames come from, after `prepare` and before the first call."""
