"""tools/town_transfer.py: curves of recall and precision of checkpoints on frames in KITTI's layout."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, FrameMeta, FrameResult, Targets

TOOL = Path(__file__).parents[3] / "tools" / "town_transfer.py"
pytestmark = [
    pytest.mark.skipif(not TOOL.is_file(), reason="the tools are in the repository only"),
    pytest.mark.filterwarnings("ignore:The ``compute`` method"),
]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("town_transfer", TOOL)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["town_transfer"] = module
    spec.loader.exec_module(module)
    return module


def boxes(x: list[float], score: list[float] | None = None) -> Boxes:
    tensor = torch.tensor([[v, 0, 0, 4, 2, 1.5, 0] for v in x])
    return Boxes.from_tensor(
        tensor, torch.zeros(len(x), dtype=torch.long), None if score is None else torch.tensor(score)
    )


def test_curves_golden_and_figure(tool: ModuleType, tmp_path: Path) -> None:
    """Cars at 8, 18 and 28 m: two are found, with scores 0.75 and 0.45, and one detection of 0.65 is wrong."""
    truth, found = boxes([8, 18, 28]), boxes([8, 18, 23], [0.75, 0.45, 0.65])
    result = FrameResult(FrameMeta("a", "a"), {"head": found}, targets=Targets(truth))
    curves = tool.measure([result], ("Car",))
    at = dict(zip(tool.SCORES, zip(curves.recall, curves.precision)))
    assert curves.cars == 3
    assert at[0.3] == (pytest.approx(2 / 3), pytest.approx(2 / 3))
    assert at[0.5] == (pytest.approx(1 / 3), pytest.approx(1 / 2))
    assert at[0.7] == (pytest.approx(1 / 3), 1)
    assert dict(zip(tool.RANGES, curves.by_range))[20] == 1
    tool.draw(tmp_path / "figure.png", {"one": curves})
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")


def test_results_without_boxes_are_an_error(tool: ModuleType) -> None:
    with pytest.raises(ConfigError, match="a detector and labelled frames"):
        tool.measure([FrameResult(FrameMeta("a", "a"), {}, targets=Targets(boxes([1])))], ("Car",))
