"""tools/town_transfer.py: curves of recall and precision of checkpoints on frames in KITTI's layout."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import Boxes, FrameMeta, FrameResult, Targets

tool = pytest.importorskip("town_transfer", reason="the tools are in the repository only")
pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method")


def boxes(x: list[float], score: list[float] | None = None) -> Boxes:
    tensor = torch.tensor([[v, 0, 0, 4, 2, 1.5, 0] for v in x])
    return Boxes.from_tensor(
        tensor, torch.zeros(len(x), dtype=torch.long), None if score is None else torch.tensor(score)
    )


def test_curves_golden_and_figure(tmp_path: Path) -> None:
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


def test_results_without_boxes_are_an_error() -> None:
    with pytest.raises(ConfigError, match="a detector and labelled frames"):
        tool.measure([FrameResult(FrameMeta("a", "a"), {}, targets=Targets(boxes([1])))], ("Car",))
