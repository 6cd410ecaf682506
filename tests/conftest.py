"""Fixtures of the repository's own tests; those that plugins use too stand in `lidarfw.testing.pytest_plugin`."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from lidarfw import registry
from lidarfw.interfaces import Dataset, Transform
from lidarfw.types import Frame

collect_ignore = ["fixtures"]  # other people's projects: their tests run where they are installed
ROOT = Path(__file__).resolve().parents[1]
UNPACK = ROOT.parent / "shared" / "data" / "unpack.py"
VARIABLE = "LIDARFW_REAL_DATA"


@pytest.fixture(scope="session")
def real_data_root(tmp_path_factory: pytest.TempPathFactory) -> Path | None:
    """Folder of real data in the official layouts, or None where this machine has none."""
    if os.environ.get(VARIABLE):
        return Path(os.environ[VARIABLE])
    if not UNPACK.is_file():
        return None
    folder = tmp_path_factory.mktemp("real_data")
    subprocess.run([sys.executable, str(UNPACK), str(folder)], check=True, capture_output=True)
    return folder


@pytest.fixture
def real_data(real_data_root: Path | None) -> Callable[[str], Path]:
    """`real_data("kitti_object/training")` is that path of the real data; the test is skipped where it is absent."""

    def find(relative_path: str) -> Path:
        if real_data_root is None:
            pytest.skip(f"no real data here: set {VARIABLE} to a folder with the official layouts")
        path = real_data_root / relative_path
        if not path.exists():
            pytest.skip(f"the real data in {real_data_root} has no {relative_path}")
        return path

    return find


class Told(Transform):
    """Changes nothing, but refuses frames unless it was prepared for their dataset, and then attached to it."""

    def __init__(self) -> None:
        self.calls: list[object] = []

    def prepare(self, dataset: Dataset, workers: int = 1) -> None:
        self.calls.append(dataset)

    def attach(self, dataset: Dataset) -> None:
        self.calls.append(dataset)

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        assert len(self.calls) == 2
        assert self.calls[0] is self.calls[1]
        return frame


@pytest.fixture
def told() -> Iterator[list[str]]:
    """Overrides that add the transform `Told`."""
    with registry.use(transform={"told": Told}):
        yield ["+transform.told.type=told"]
