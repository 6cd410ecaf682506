"""What the layouts share: where a frame belongs, how its files are written, and the ego motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from lidarfw.errors import ConfigError
from lidarfw.files import atomic_path

from lidarfw_town.drive import NEAREST, Drive, TownFrame
from lidarfw_town.mesh import Array

FEWEST = 3  # points below which an object is not labelled
TO_NED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])  # east, north, up -> north, east, down


@dataclass(frozen=True)
class Place:
    """Where a frame belongs: number of the drive and of the frame within it, and its number in the whole set."""

    drive: int
    index: int
    number: int


class Layout:
    """How frames become files. `write` may run in any order and process; `finish` once, when all frames stand.

    `drives` names the drives of each split as the dataset does; `stride` is the number of 0.1 s steps from one frame
    to the next, `length` the most frames of one drive, `compensated` whether ego motion is taken out of the scans.
    With `one_town`, all drives of all splits are traversals of one circuit in one town; without, each has its own town.
    `width` is that of the pictures in pixels, 0 for none.
    """

    drives: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    stride = 1
    length = 200
    compensated = True
    one_town = False

    def __init__(self, root: Path, width: int, split: str = "train") -> None:
        self.root, self.width, self.split = root, width, split

    def name(self, drive: int) -> str:
        """The name of a drive."""
        return self.drives[self.split][drive]

    @classmethod
    def check(cls, split: str, count: int) -> None:
        """ConfigError unless the split can have so many drives; a layout that names none has any."""
        if not cls.drives:
            return
        if split not in cls.drives:
            raise ConfigError(f"split: expected one of {', '.join(cls.drives)}, found {split!r}")
        most = len(cls.drives[split])
        if count > most:
            raise ConfigError(
                f"the split {split} of this layout has {most} drives at most, found {count}.\n"
                f"  fix: fewer frames, or longer drives (length)"
            )

    @classmethod
    def traversal(cls, split: str, drive: int) -> int:
        """The number of a drive among those of all splits."""
        before = list(cls.drives)[: list(cls.drives).index(split)]
        return drive + sum(len(cls.drives[name]) for name in before)

    def write(self, frame: TownFrame, drive: Drive, place: Place) -> dict[str, Any]:
        """Write the files of a frame; what `finish` will need of it, as plain values."""
        raise NotImplementedError

    def finish(self, parts: Sequence[Sequence[dict[str, Any]]]) -> None:
        """Write the files of whole drives, from what `write` gave for their frames, drive by drive."""


def write_array(path: Path, values: Array | np.ndarray, kind: npt.DTypeLike = "<f4") -> None:
    """Values as little-endian numbers, row by row."""
    with atomic_path(path) as temporary:
        np.asarray(values).astype(kind).tofile(temporary)


def write_picture(path: Path, picture: np.ndarray) -> None:
    """A picture (H, W, 3) of bytes, or (H, W) of bytes or 16-bit numbers."""
    from PIL import Image

    with atomic_path(path) as temporary:
        Image.fromarray(picture).save(temporary, compress_level=3)


def numbers(matrix: Array | Sequence[float]) -> str:
    """Numbers in a line, row by row."""
    return " ".join(f"{value:.12e}" for value in np.asarray(matrix).ravel())


def square(matrix: Array) -> Array:
    """A transform (3, 4) as (4, 4)."""
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])


def angles(pose: Array) -> list[float]:
    """Roll, pitch, yaw in radians of a transform (4, 4): Rz(yaw) Ry(pitch) Rx(roll)."""
    from scipy.spatial.transform import Rotation

    yaw, pitch, roll = Rotation.from_matrix(pose[:3, :3]).as_euler("ZYX").tolist()
    return [roll, pitch, yaw]


def rings(frame: TownFrame) -> np.ndarray:
    """The beam (N,) of every point, the lowest one 0."""
    return np.asarray(len(frame.grid) - 1 - np.nonzero(frame.grid > NEAREST)[0])


def box_lines(frame: TownFrame, names: Mapping[str, str]) -> str:
    """Lines of class x y z l w h yaw track, of the objects that the scan shows; `names` by kind of body."""
    seen = [thing for thing in frame.objects if thing.points >= FEWEST and thing.kind in names]
    rows = ((names[t.kind], " ".join(f"{value:.4f}" for value in t.box), t.id) for t in seen)
    return "".join(f"{name} {box} {number}\n" for name, box, number in rows)
