"""Metric `pose_error`."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from lidarfw.components.metrics.pose_error import PoseError, pose_errors
from lidarfw.errors import ConfigError
from lidarfw.types import Poses, Spec, Targets

pytestmark = pytest.mark.filterwarnings("ignore:The ``compute`` method of metric PoseError was called before")
SPEC = Spec(Poses)
USUAL = ("success_0.25m_2deg", "success_0.5m_5deg", "success_5m_10deg")


def poses_of(*rows: tuple[float, float], ok: list[bool] | None = None) -> Poses:
    """Poses that lie so far along x and are turned by so many degrees about z."""
    matrix = torch.eye(4).repeat(len(rows), 1, 1)
    for place, (metres, degrees) in enumerate(rows):
        cosine, sine = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
        matrix[place, :2, :2] = torch.tensor([[cosine, -sine], [sine, cosine]])
        matrix[place, 0, 3] = metres
    good = torch.ones(len(rows), dtype=torch.bool) if ok is None else torch.tensor(ok)
    return Poses(matrix, good, good.float())


def figures(*frames: tuple[Poses, Poses | None], **options: object) -> dict[str, float]:
    metric = PoseError(SPEC, **options)
    for found, truth in frames:
        metric.update(found, Targets(poses=truth))
    return metric.compute()


def test_golden() -> None:
    truth = poses_of(*[(10, 90)] * 4)
    found = figures((poses_of((10.2, 91), (10.4, 86), (13, 90), (10, 110)), truth))
    assert found == pytest.approx(
        {
            "position_mean": 0.9, "position_median": 0.3, "orientation_mean": 6.25, "orientation_median": 2.5,
            "success_0.25m_2deg": 1 / 4, "success_0.5m_5deg": 2 / 4, "success_5m_10deg": 3 / 4, "success": 0.5,
            "failures": 0, "frames": 4,
        },
        abs=1e-5,
    )  # fmt: skip


def test_failures_are_misses_but_in_no_mean() -> None:
    truth = poses_of((0, 0), (0, 0), (0, 0))
    broken = poses_of((0.1, 1), (1000, 0), (0, 0), ok=[True, False, True])
    broken.matrix[2, 0, 3] = torch.nan
    found = figures((broken, truth))
    assert (found["failures"], found["frames"]) == pytest.approx((2 / 3, 3))
    assert (found["position_mean"], found["orientation_median"]) == pytest.approx((0.1, 1), abs=1e-5)
    assert [found[name] for name in USUAL] == pytest.approx([1 / 3] * 3)


def test_frames_without_a_true_pose_do_not_count() -> None:
    found = figures((poses_of((0, 0), (9, 0)), poses_of((0, 0), (0, 0), ok=[True, False])), (poses_of((5, 0)), None))
    assert (found["frames"], found["success"], found["position_mean"]) == (1, 1, 0)


def test_nothing_is_finite() -> None:
    for frames in ([], [(poses_of(), poses_of())], [(poses_of((1, 1)), None)]):
        assert set(figures(*frames).values()) == {0.0}
    lost = figures((poses_of((0, 0), ok=[False]), poses_of((0, 0))))
    assert (lost["failures"], lost["success"], lost["position_median"]) == (1, 0, 0)


def test_angles_against_scipy() -> None:
    one, two = Rotation.random(100, random_state=0), Rotation.random(100, random_state=1)
    small = two * Rotation.from_rotvec([[1e-7, 0, 0]] * 100)
    for a, b in ((one, two), (small, two)):
        poses = torch.eye(4, dtype=torch.float64).repeat(2, 100, 1, 1)
        poses[:, :, :3, :3] = torch.tensor([a.as_matrix().tolist(), b.as_matrix().tolist()], dtype=torch.float64)
        expected = torch.tensor((a.inv() * b).magnitude()).rad2deg()
        assert torch.allclose(pose_errors(poses[0], poses[1])[:, 1], expected, rtol=1e-6, atol=1e-12)
    half = poses_of((0, 0), (0, 180))
    assert pose_errors(half.matrix[:1], half.matrix[1:])[0].tolist() == pytest.approx([0, 180])


def test_thresholds_are_options() -> None:
    found = figures((poses_of((1.5, 0)), poses_of((0, 0))), thresholds=[[2, 5], [1, 5]])
    assert (found["success_2m_5deg"], found["success_1m_5deg"], found["success"]) == (1, 0, 0.5)
    for wrong in ([], [[1]], [[0, 5]]):
        with pytest.raises(ConfigError, match="pairs of metres and degrees"):
            PoseError(SPEC, thresholds=wrong)


def test_batches_frames_and_reset() -> None:
    rows, metric = [(0.1, 1.0), (0.4, 3.0), (2.0, 20.0)], PoseError(SPEC)
    whole = figures((poses_of(*rows), poses_of(*[(0, 0)] * 3)))
    for _ in range(2):
        for row in rows:
            metric.update(poses_of(row), Targets(poses=poses_of((0, 0))))
        assert metric.compute() == pytest.approx(whole)
        metric.reset()
    assert metric.compute()["frames"] == 0
