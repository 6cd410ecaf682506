"""The tiny detector, registered for every test of this folder."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

import training_parts
import training_runs

from lidarfw import registry
from lidarfw.training import train


@pytest.fixture(autouse=True)
def toy_components() -> Iterator[None]:
    with registry.use(**training_parts.SLOTS):
        yield


@pytest.fixture
def run() -> Callable[..., dict[str, float]]:
    """`run(folder, *overrides)` trains the tiny detector and gives its figures."""
    return lambda folder, *overrides: train(training_runs.settings(folder, *overrides))
