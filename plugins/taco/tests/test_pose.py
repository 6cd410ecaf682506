"""From pairs to poses: outliers, failures, what the detections and the stream add."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lidarfw.components.metrics.pose_error import pose_errors
from lidarfw.errors import ConfigError, DataError
from lidarfw.ops import kabsch, transform
from lidarfw.types import Boxes, FrameMeta, FrameResult, Points, Poses, SceneCoords, Spec
from scipy.spatial.transform import Rotation
from torch import Tensor

from lidarfw_taco.filters.inlier_gate import InlierGate
from lidarfw_taco.filters.pose_smoother import PoseSmoother
from lidarfw_taco.postprocessors.dynamic_correspondence import DynamicCorrespondence
from lidarfw_taco.postprocessors.pose_ransac import PoseRansac

COORDS, POINTS, POSES = Spec(SceneCoords), Spec(Points, channels=1), Spec(Poses)
NO_POINTS = Points.from_scan(torch.zeros(0, 3), torch.zeros(0, 1))


def pose(seed: int, distance: float = 100.0) -> Tensor:
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("zyx", [rng.uniform(-3, 3), *rng.normal(0, 0.03, 2)]).as_matrix()
    matrix[:3, 3] = rng.uniform(-distance, distance, 3)
    return torch.from_numpy(matrix).float()


def scene(seed: int, outliers: float, count: int = 1000, noise: float = 0.4) -> tuple[SceneCoords, Tensor]:
    """Pairs as a scene-coordinate network gives them: noise in metres per axis, outliers 15 m off."""
    rng, truth = np.random.default_rng(seed + 1000), pose(seed)
    source = torch.from_numpy(rng.uniform([-50, -50, -2], [50, 50, 6], (count, 3))).float()
    off = rng.normal(0, noise, (count, 3))
    off[: int(outliers * count)] = rng.normal(0, 15, (int(outliers * count), 3))
    world = transform(truth, source) + torch.from_numpy(off).float()
    return SceneCoords(source, world, torch.ones(count), torch.zeros(count, dtype=torch.long)), truth


def solve(pairs: SceneCoords, **options: float) -> Poses:
    return PoseRansac(COORDS, POINTS, **options)(pairs, NO_POINTS)  # type: ignore[arg-type]


# the solver


@pytest.mark.parametrize("outliers", [0.3, 0.5, 0.7, 0.85])
def test_errors_among_outliers(outliers: float) -> None:
    scenes = [scene(seed, outliers) for seed in range(10)]
    found = solve(SceneCoords.cat([pairs for pairs, _ in scenes], as_batch=True))
    errors = pose_errors(found.matrix, torch.stack([truth for _, truth in scenes]))
    assert found.ok.all()
    metres, degrees = errors.median(0).values.tolist()
    assert metres < 0.1
    assert degrees < 0.15
    assert errors[:, 0].max() < 0.3


def test_known_turn() -> None:
    source = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    world = torch.tensor([[10.0, -5, 1], [10, -4, 1], [8, -5, 1], [10, -5, 4]])
    expected = torch.tensor([[0.0, -1, 0, 10], [1, 0, 0, -5], [0, 0, 1, 1], [0, 0, 0, 1]])
    torch.testing.assert_close(kabsch(source, world), expected, atol=1e-5, rtol=0)


def test_a_mirrored_copy_is_no_rotation() -> None:
    source = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 0.1]])
    turn = kabsch(source, source * torch.tensor([1.0, 1, -1]))[:3, :3]
    assert torch.linalg.det(turn).item() == pytest.approx(1)
    torch.testing.assert_close(turn, torch.eye(3), atol=1e-5, rtol=0)


def test_far_maps_lose_no_digits() -> None:
    pairs, truth = scene(0, 0.3)
    far = torch.tensor([4000.0, -9000.0, 100.0])
    moved = truth.clone()
    moved[:3, 3] += far
    errors = pose_errors(solve(pairs.replace(world=pairs.world + far)).matrix, moved[None])
    assert errors[0, 0] < 0.1


def test_failures_are_marked_and_finite() -> None:
    good, _ = scene(0, 0.3)
    line = torch.linspace(-30, 30, 50)[:, None] * torch.tensor([1.0, 2.0, 0.1])
    ones, zeros = torch.ones(50), torch.zeros(50, dtype=torch.long)
    collinear = SceneCoords(line, line + 5, ones, zeros)
    rng = torch.Generator().manual_seed(0)
    noise = SceneCoords(
        torch.randn(300, 3, generator=rng) * 30, torch.randn(300, 3, generator=rng) * 3000, torch.ones(300),
        torch.zeros(300, dtype=torch.long),
    )  # fmt: skip
    batch = SceneCoords.cat([good, good[:0], good[:1], good[:2], collinear, noise], as_batch=True)
    found = solve(batch)
    assert found.ok.tolist() == [True, False, False, False, False, False]
    assert found.matrix.isfinite().all()
    torch.testing.assert_close(found.matrix[1:4], torch.eye(4).expand(3, 4, 4))
    torch.testing.assert_close(found.matrix[5], kabsch(noise.source, noise.world), atol=1e-2, rtol=1e-4)


def test_batch_mates_and_their_order_do_not_matter() -> None:
    scenes = [scene(seed, 0.7, 200)[0] for seed in range(3)]
    alone = [solve(pairs).matrix[0] for pairs in scenes]
    batch = solve(SceneCoords.cat(scenes[::-1], as_batch=True)).matrix
    assert all(torch.equal(one, other) for one, other in zip(alone, batch.flip(0), strict=True))


# what detections add


def test_pairs_on_detected_objects_lose_their_weight() -> None:
    pairs, _ = scene(0, 0.0, 100)
    box = torch.tensor([[*pairs.source[7].tolist(), 4.0, 2.0, 1.5, 0.3]])
    boxes = Boxes.from_tensor(box.repeat(2, 1), torch.tensor([0, 0]), torch.tensor([0.9, 0.1]))
    boxes.center[1] = pairs.source[50]
    cleaned = DynamicCorrespondence(COORDS, Spec(Boxes))(pairs, boxes)
    assert cleaned.weight[7] == 0
    assert cleaned.weight[50] == 1, "the box there is too uncertain"
    assert cleaned.weight.sum() > 95


def test_cleaning_helps_where_a_truck_fills_the_view() -> None:
    """60 % of the pairs lie on one moving truck and agree on a wrong pose: without it, the right one is found."""
    truth = pose(1)
    rng = np.random.default_rng(5)
    wall = torch.from_numpy(rng.uniform([-40, -40, -2], [40, 40, 5], (200, 3))).float()
    truck = torch.from_numpy(rng.uniform([5, -2, -1], [17, 1, 2], (300, 3))).float()
    moved = transform(truth, truck) + torch.tensor([8.0, 3.0, 0.0])
    source, world = torch.cat([wall, truck]), torch.cat([transform(truth, wall), moved])
    pairs = SceneCoords(source, world, torch.ones(500), torch.zeros(500, dtype=torch.long))
    box = Boxes.from_tensor(torch.tensor([[11.0, -0.5, 0.5, 12.2, 3.2, 3.2, 0.0]]), torch.tensor([0]))
    cleaned = DynamicCorrespondence(COORDS, Spec(Boxes))(pairs, box)
    assert pose_errors(solve(pairs).matrix, truth[None])[0, 0] > 1
    assert pose_errors(solve(cleaned).matrix, truth[None])[0, 0] < 0.05


# the stream


def result(matrix: Tensor, time: float, ok: bool = True, confidence: float = 0.5) -> FrameResult:
    poses = Poses(matrix[None].float(), torch.tensor([ok]), torch.tensor([confidence]))
    return FrameResult(FrameMeta(str(time), time=time), {"p": poses})


def smoothed(results: list[FrameResult], **options: float) -> list[Poses]:
    part = PoseSmoother(POSES, **options)  # type: ignore[arg-type]
    state = part.start()
    return [done.of(Poses) for r in results for done in part.step(state, r, r.of(Poses))]


def drive(count: int = 60) -> list[Tensor]:
    """10 m/s round a bend of 50 m, ten frames a second."""
    poses = []
    for number in range(count):
        angle = number * 0.1 * 10 / 50
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] = torch.from_numpy(Rotation.from_euler("z", angle).as_matrix())
        matrix[0, 3], matrix[1, 3] = 50 * math.sin(angle), 50 * (1 - math.cos(angle))
        poses.append(matrix)
    return poses


def share_of_noise_left(noise: float, acceleration: float, period: float = 0.1) -> float:
    """Of white noise, by a constant-velocity Kalman filter in its steady state (Bar-Shalom et al., 2001, 6.5.3).

    The filter has the gains alpha and beta of its tracking index; on a motion without accelerations its error is what
    these let through of the noise.
    """
    index = acceleration * period**2 / noise
    root = (4 + index - math.sqrt(8 * index + index**2)) / 4
    alpha, beta = 1 - root**2, 2 * (1 + root**2) - 4 * root
    return math.sqrt((2 * alpha**2 + beta * (2 - 3 * alpha)) / (alpha * (4 - 2 * alpha - beta)))


def test_smoothing_leaves_as_much_noise_as_its_options_say() -> None:
    truth, rng = drive(600), np.random.default_rng(0)
    noisy = [matrix.clone() for matrix in truth]
    for matrix in noisy:
        matrix[:3, 3] += torch.from_numpy(rng.normal(0, 0.4, 3))
        matrix[:3, :3] = torch.from_numpy(Rotation.from_rotvec(rng.normal(0, 0.02, 3)).as_matrix()) @ matrix[:3, :3]
    results = [result(matrix, 0.1 * i, confidence=1.0) for i, matrix in enumerate(noisy)]
    out = smoothed(results, place_error=0.4, angle_error=0.02)
    expected = torch.stack(truth)
    before = pose_errors(torch.stack(noisy), expected)[20:].mean(0)
    after = pose_errors(torch.cat([p.matrix for p in out]), expected)[20:].mean(0)
    assert after[0] / before[0] == pytest.approx(share_of_noise_left(0.4, 3.0), rel=0.1)  # 0.50
    assert after[1] / before[1] == pytest.approx(share_of_noise_left(0.02, 0.5), rel=0.1)  # 0.64


def test_a_jump_is_not_believed_and_gaps_are_bridged() -> None:
    truth = drive()
    results = [result(matrix, 0.1 * i) for i, matrix in enumerate(truth)]
    far = truth[30].clone()
    far[0, 3] += 40
    results[30], results[31] = result(far, 3.0), result(torch.eye(4), 3.1, ok=False)
    out = smoothed(results)
    errors = pose_errors(torch.cat([p.matrix for p in out]), torch.stack(truth))
    assert errors[30:34, 0].max() < 0.3
    assert all(bool(p.ok[0]) for p in out)


def test_after_a_long_gap_the_filter_starts_anew() -> None:
    truth = drive(40)
    lost = [result(torch.eye(4), 0.1 * i, ok=False) for i in range(10, 30)]
    results = [result(m, 0.1 * i) for i, m in enumerate(truth)]
    out = smoothed([*results[:10], *lost, *results[30:]], max_missed=5)
    assert [bool(p.ok[0]) for p in out] == [True] * 15 + [False] * 15 + [True] * 10
    torch.testing.assert_close(out[30].matrix[0].double(), truth[30], atol=1e-4, rtol=0)


def test_gate_by_confidence() -> None:
    gate = InlierGate(POSES, confidence=0.1)
    for confidence, ok in ((0.2, True), (0.05, False)):
        frame = result(torch.eye(4), 0.0, confidence=confidence)
        assert bool(gate.step(None, frame, frame.of(Poses))[0].of(Poses).ok[0]) is ok


# the map


def room(rng: np.random.Generator, count: int = 6000) -> np.ndarray:
    """Points on floor and walls."""
    xyz = rng.uniform([-15, -10, 0], [15, 10, 4], (count, 3))
    side = rng.integers(0, 4, count)
    xyz[side == 0, 2] = 0
    xyz[side == 1, 0] = 15
    xyz[side == 2, 1] = -10
    xyz[side == 3, 0] = -15
    return xyz


def test_refinement_on_a_map(tmp_path: Path) -> None:
    pytest.importorskip("small_gicp")
    rng, truth = np.random.default_rng(0), pose(3, 20.0)
    local = room(rng)
    world = transform(truth.double(), torch.from_numpy(room(rng))).numpy()
    np.save(tmp_path / "map.npy", np.column_stack([world, np.zeros(len(world))]).astype(np.float32))
    pairs, _ = scene(0, 0.5, 100, noise=0.0)
    pairs = pairs.replace(world=transform(truth, pairs.source) + torch.tensor([0.4, -0.3, 0.1]))
    points = Points.from_scan(torch.from_numpy(local).float(), torch.zeros(len(local), 1))
    part = PoseRansac(COORDS, POINTS, map=str(tmp_path / "map.npy"))
    assert pose_errors(solve(pairs).matrix, truth[None])[0, 0] > 0.4
    refined = part(pairs, points)
    assert pose_errors(refined.matrix, truth[None])[0, 0] < 0.05
    assert torch.equal(part(pairs, NO_POINTS).matrix, solve(pairs).matrix), "no scan, nothing to refine with"


def test_refinement_without_its_package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    np.save(tmp_path / "map.npy", np.zeros((50, 4), np.float32))
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    pairs, _ = scene(0, 0.3)
    with pytest.raises(ConfigError, match=r"pip install 'lidarfw-taco\[refine\]'"):
        PoseRansac(COORDS, POINTS, map=str(tmp_path / "map.npy"))(pairs, NO_POINTS)


def test_refinement_without_its_map(tmp_path: Path) -> None:
    pytest.importorskip("small_gicp")
    pairs, _ = scene(0, 0.3)
    with pytest.raises(DataError, match=r"map\.npy"):
        PoseRansac(COORDS, POINTS, map=str(tmp_path / "map.npy"))(pairs, NO_POINTS)


def test_state_of_the_smoother_is_plain() -> None:
    assert all(isinstance(value, (Tensor, bool, int, float)) for value in vars(PoseSmoother(POSES).start()).values())
    assert dataclasses.is_dataclass(PoseSmoother(POSES).start())
