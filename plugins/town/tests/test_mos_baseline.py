"""tools/mos_baseline.py: moving points by residual and threshold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarfw_town.generate import Job, generate

tool = pytest.importorskip("mos_baseline", reason="the tools are in the repository only")


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> str:
    root = str(tmp_path_factory.mktemp("mos"))
    generate(Job("semantic_kitti", root, seed=5, frames=4, sensor="small", picture_width=0, stride=2), quiet=True)
    return root


def test_tally_golden() -> None:
    """Five points, two past scans; the third point moves and both see it, the fourth moves and one does."""
    whole = tool.Tally(2)
    residual = np.array([[0.0, 0.3, 0.5, 0.5, 0.0], [0.0, 0.0, 0.4, 0.0, 0.6]], np.float32)
    label = np.array([0, 0, 1, 1, -1])
    whole.add(residual, label, np.array([False, True, True, True, True]))
    threshold = int(np.searchsorted(tool.EDGES, 0.2))
    assert whole.figures(1, threshold) == tool.Figures(2 / 3, 2 / 3, 1.0)
    assert whole.figures(2, threshold) == tool.Figures(0.5, 1.0, 0.5)
    assert whole.all_movable == tool.Figures(2 / 3, 2 / 3, 1.0)
    agreeing, best = whole.best()
    assert (agreeing, whole.figures(agreeing, best).iou) == (1, 1.0)  # a threshold between 0.3 and 0.5


def test_nothing_counted_is_finite() -> None:
    assert tool.Tally(1).figures(1, 10) == tool.Figures(0, 0, 0)
    assert tool.Tally(1).all_movable == tool.Figures(0, 0, 0)


def scan(shift: float) -> tuple[np.ndarray, np.ndarray]:
    """A wall 20 m ahead, and before it a post 10 m ahead, `shift` metres to the left; points and label ids."""
    azimuth, elevation = (
        grid.ravel() for grid in np.meshgrid(np.linspace(-0.6, 0.6, 400), np.linspace(-0.15, 0.03, 24))
    )
    post = np.abs(10 * np.tan(azimuth) - shift) < 0.5
    ahead = np.where(post, 10.0, 20.0)
    points = np.stack([ahead, ahead * np.tan(azimuth), ahead * np.tan(elevation) / np.cos(azimuth), 0 * ahead], 1)
    return points.astype("<f4"), np.where(post, 254, 50).astype("<u4")


def test_a_person_before_a_wall_is_found(tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "00"
    for name in ("velodyne", "labels"):
        (folder / name).mkdir(parents=True)
    for number in range(4):
        points, ids = scan(1.2 * number)
        points.tofile(folder / "velodyne" / f"{number:06d}.bin")
        ids.tofile(folder / "labels" / f"{number:06d}.label")
    pose = "1 0 0 0 0 1 0 0 0 0 1 0"
    (folder / "poses.txt").write_text(f"{pose}\n" * 4)
    (folder / "calib.txt").write_text(f"P0: {pose}\nTr: {pose}\n")
    (folder / "times.txt").write_text("".join(f"{0.1 * n}\n" for n in range(4)))
    counted = tool.tally(str(tmp_path), 2)
    agreeing, threshold = counted.best()
    assert counted.scans == 2
    assert counted.figures(agreeing, threshold).iou > 0.95
    assert tool.EDGES[threshold] < 1.0  # the wall is twice as far
    assert counted.all_movable == tool.Figures(1.0, 1.0, 1.0)


def test_the_town_gives_figures(town: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main(["--tune", town, "--test", town, "--past", "2"]) == 0
    rule, _, first, second = capsys.readouterr().out.splitlines()
    assert "of 2 past scans" in rule
    assert first == second
    assert float(first.split("|")[3]) > 0
    assert first.split("|")[-2].split()[-1] == "1.000"  # all that moves is movable


def test_too_short_sequences_are_an_error(town: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert tool.main(["--tune", town, "--test", town, "--past", "9"]) == 2
    assert "no sequence has more than 9 scans" in capsys.readouterr().err
