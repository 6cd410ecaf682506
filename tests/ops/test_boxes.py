"""Rotated boxes against shapely and naive loops."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
import shapely
import torch
from hypothesis import given, settings
from torch import Tensor

from lidarfw.ops import (
    box_corners,
    giou_3d,
    iou_3d,
    iou_bev,
    nearest_bev_iou,
    nms_circle,
    nms_rotated,
    paired_giou_3d,
    paired_iou_3d,
    paired_iou_bev,
    points_in_boxes,
    points_in_boxes_mask,
)


def random_boxes(count: int, seed: int, spread: float = 8.0) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    scale = torch.tensor([spread, spread, 2, 4, 2, 1.5, 4 * math.pi], dtype=torch.float64)
    lowest = torch.tensor([0, 0, -1, 0.3, 0.2, 0.5, -2 * math.pi], dtype=torch.float64)
    return torch.rand(count, 7, generator=random, dtype=torch.float64) * scale + lowest


def polygons(boxes: Tensor) -> np.ndarray:
    return np.array([shapely.Polygon(c) for c in box_corners(boxes)[:, :4, :2].numpy()])


def shapely_overlaps(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """BEV IoU, 3D IoU and 3D GIoU (N, M)."""
    left, right = polygons(a)[:, None], polygons(b)[None]
    area = torch.from_numpy(shapely.area(shapely.intersection(left, right)))
    hull = torch.from_numpy(shapely.area(shapely.convex_hull(shapely.union(left, right))))
    bev = area / (a[:, 3:5].prod(1)[:, None] + b[:, 3:5].prod(1) - area)
    low_a, high_a, low_b, high_b = (x[:, 2] + s * x[:, 5] / 2 for x in (a, b) for s in (-1, 1))
    height = (torch.minimum(high_a[:, None], high_b) - torch.maximum(low_a[:, None], low_b)).clamp(min=0)
    union = a[:, 3:6].prod(1)[:, None] + b[:, 3:6].prod(1) - area * height
    enclosing = hull * (torch.maximum(high_a[:, None], high_b) - torch.minimum(low_a[:, None], low_b))
    volume = area * height / union
    return bev, volume, volume - (enclosing - union) / enclosing


def test_corners_of_a_turned_box() -> None:
    corners = box_corners(torch.tensor([[1.0, 2.0, 3.0, 4.0, 2.0, 1.0, math.pi / 2]]))[0]
    expected = [[0, 4], [0, 0], [2, 0], [2, 4]]
    torch.testing.assert_close(corners[:4, :2], torch.tensor(expected, dtype=torch.float32))
    assert corners[:4, 2].tolist() == [2.5] * 4
    assert corners[4:, 2].tolist() == [3.5] * 4


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 30), st.integers(0, 30), st.integers(0, 10**6), st.sampled_from([0.5, 5.0, 40.0]))
def test_overlaps_equal_shapely(count_a: int, count_b: int, seed: int, spread: float) -> None:
    a, b = random_boxes(count_a, seed, spread), random_boxes(count_b, seed + 1, spread)
    expected = shapely_overlaps(a, b) if count_a and count_b else (torch.zeros(count_a, count_b).double(),) * 3
    for ours, exact in zip((iou_bev(a, b), iou_3d(a, b), giou_3d(a, b)), expected, strict=True):
        torch.testing.assert_close(ours, exact, rtol=0, atol=1e-7)
    for ours, exact in zip((f(a.float(), b.float()) for f in (iou_bev, iou_3d, giou_3d)), expected, strict=True):
        torch.testing.assert_close(ours.double(), exact, rtol=0, atol=1e-3)


SQUARE = [0.0, 0, 0, 2, 2, 2, 0]
SPECIAL = {
    "identical": (SQUARE, SQUARE, 1.0),
    "turned by a right angle": (SQUARE, [0, 0, 0, 2, 2, 2, math.pi / 2], 1.0),
    "turned about": ([0.0, 0, 0, 4, 2, 2, 0.3], [0, 0, 0, 4, 2, 2, 0.3 + math.pi], 1.0),
    "inside, sharing an edge": (SQUARE, [0.5, 0, 0, 1, 1, 2, 0], 0.25),
    "inside, sharing a corner": (SQUARE, [0.5, 0.5, 0, 1, 1, 2, 0], 0.25),
    "well inside": (SQUARE, [0.1, 0.1, 0, 0.5, 0.5, 2, 0.7], 0.0625),
    "half": (SQUARE, [1, 0, 0, 2, 2, 2, 0], 1 / 3),
    "touching": (SQUARE, [2, 0, 0, 2, 2, 2, 0], 0.0),
    "touching at a corner": (SQUARE, [2, 2, 0, 2, 2, 2, 0], 0.0),
    "octagon": (SQUARE, [0, 0, 0, 2, 2, 2, math.pi / 4], (8 * math.sqrt(2) - 8) / (16 - 8 * math.sqrt(2))),
    "cross": ([0.0, 0, 0, 4, 1, 2, 0], [0, 0, 0, 4, 1, 2, math.pi / 2], 1 / 7),
    "above": (SQUARE, [0, 0, 2, 2, 2, 2, 0], 0.0),
    "no size": ([0.0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0, 0], 0.0),
}


@pytest.mark.parametrize(("a", "b", "expected"), SPECIAL.values(), ids=SPECIAL.keys())
@pytest.mark.parametrize("offset", [0.0, 70.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_special_positions(a, b, expected: float, offset: float, dtype: torch.dtype) -> None:
    shift = torch.tensor([offset, -offset, 0, 0, 0, 0, 0], dtype=dtype)
    a, b = (torch.tensor([x], dtype=dtype) + shift for x in (a, b))
    tolerance = 1e-7 if dtype == torch.float64 else 1e-4
    for value in (iou_3d(a, b), iou_3d(b, a), paired_iou_3d(a, b)):
        assert value.item() == pytest.approx(expected, abs=tolerance)


def test_overlap_does_not_change_with_the_frame() -> None:
    a, b = random_boxes(20, 0, 5), random_boxes(20, 1, 5)
    angle, move = 0.7, torch.tensor([12.0, -30.0, 1.0], dtype=torch.float64)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    moved = [torch.cat([x[:, :3] @ turn.double().T + move, x[:, 3:6], x[:, 6:] + angle], 1) for x in (a, b)]
    torch.testing.assert_close(iou_3d(*moved), iou_3d(a, b), rtol=0, atol=1e-6)
    torch.testing.assert_close(giou_3d(*moved), giou_3d(a, b), rtol=0, atol=1e-6)


def test_paired_is_the_diagonal_and_differentiable() -> None:
    a, b = random_boxes(15, 3, 2), random_boxes(15, 4, 2)
    torch.testing.assert_close(paired_iou_bev(a, b), iou_bev(a, b).diagonal())
    torch.testing.assert_close(paired_iou_3d(a, b), iou_3d(a, b).diagonal())
    torch.testing.assert_close(paired_giou_3d(a, b), giou_3d(a, b).diagonal())
    a.requires_grad_()
    for function in (paired_iou_bev, paired_iou_3d, paired_giou_3d):
        assert torch.autograd.gradcheck(function, (a, b.requires_grad_()))


def test_losses_on_equal_distant_and_degenerate_pairs_have_finite_gradients() -> None:
    a = torch.tensor([SQUARE, SQUARE, [0.0, 0, 0, 0, 0, 0, 0]], requires_grad=True)
    b = torch.tensor([SQUARE, [50.0, 0, 0, 1, 1, 1, 0], [0, 0, 0, 0, 0, 0, 0]])
    for function in (paired_iou_3d, paired_giou_3d):
        (gradient,) = torch.autograd.grad(function(a, b).sum(), a)
        assert gradient.isfinite().all()
    distant = torch.autograd.grad(paired_giou_3d(a, b)[1], a)[0]
    assert distant[1, 0] > 0  # GIoU pulls a box towards a distant target


def test_gradient_ascent_on_the_overlap_finds_the_target() -> None:
    target = torch.tensor([[3.0, 1.0, 0.0, 4.0, 1.8, 1.5, 0.4]])
    box = torch.tensor([[0.0, -1.0, 0.5, 3.0, 2.5, 1.0, 0.0]], requires_grad=True)
    optimizer = torch.optim.Adam([box], 0.03)
    for _ in range(300):
        optimizer.zero_grad()
        (1 - paired_giou_3d(box, target)).sum().backward()
        optimizer.step()
    assert iou_3d(box.detach(), target).item() > 0.9


def test_nearest_bev_rounds_the_heading() -> None:
    a = torch.tensor(
        [[0, 0, 0, 4, 2, 1, 0.3], [0, 0, 0, 4, 2, 1, 1.3], [0, 0, 0, 4, 2, 1, -3.1], [0, 0, 5, 4, 2, 1, 0.0]]
    )
    values = nearest_bev_iou(a, a[:1])[:, 0]
    torch.testing.assert_close(values, torch.tensor([1, 4 / 12, 1, 1]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 200), st.integers(0, 12), st.integers(0, 10**6), st.booleans())
def test_points_in_boxes_equal_a_loop(points: int, boxes: int, seed: int, batched: bool) -> None:
    random = torch.Generator().manual_seed(seed)
    xyz = torch.rand(points, 3, generator=random, dtype=torch.float64) * torch.tensor([9.0, 9, 4]) - torch.tensor(
        [0.5, 0.5, 2]
    )
    boxes_ = random_boxes(boxes, seed)
    batches = [torch.randint(2, (n,), generator=random) if batched else None for n in (points, boxes)]
    mask = points_in_boxes_mask(xyz, boxes_, *batches)
    for column in range(boxes):
        outline = polygons(boxes_[column : column + 1])[0]
        inside = torch.from_numpy(shapely.intersects_xy(outline, xyz[:, 0].numpy(), xyz[:, 1].numpy()))
        inside &= (xyz[:, 2] - boxes_[column, 2]).abs() <= boxes_[column, 5] / 2
        if batched:
            inside &= batches[0] == batches[1][column]
        assert torch.equal(mask[:, column], inside)
    first = [row.nonzero()[0].item() if row.any() else -1 for row in mask]
    assert points_in_boxes(xyz, boxes_, *batches).tolist() == first


def test_points_on_the_surface_are_inside() -> None:
    xyz = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1], [1.001, 0, 0]])
    assert points_in_boxes(xyz, torch.tensor([SQUARE])).tolist() == [0, 0, 0, 0, -1]


def greedy(suppresses, scores: Tensor) -> list[int]:
    kept: list[int] = []
    for row in torch.argsort(scores, descending=True, stable=True).tolist():
        if not any(suppresses(other, row) for other in kept):
            kept.append(row)
    return kept


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 60), st.integers(0, 10**6), st.sampled_from([1.0, 8.0, 30.0]), st.sampled_from([0.01, 0.1, 0.5]))
def test_nms_equals_greedy(count: int, seed: int, spread: float, threshold: float) -> None:
    boxes = random_boxes(count, seed, spread)
    random = torch.Generator().manual_seed(seed)
    scores, groups = torch.rand(count, generator=random), torch.randint(3, (count,), generator=random)
    scores = (scores * 10).round() / 10  # ties
    iou = iou_bev(boxes, boxes)
    assert nms_rotated(boxes, scores, threshold).tolist() == greedy(lambda i, j: iou[i, j] > threshold, scores)
    expected = greedy(lambda i, j: iou[i, j] > threshold and groups[i] == groups[j], scores)
    assert nms_rotated(boxes, scores, threshold, groups).tolist() == expected
    apart, radius = torch.cdist(boxes[:, :2], boxes[:, :2]), boxes[:, 3]
    assert nms_circle(boxes[:, :2], scores, 1.5).tolist() == greedy(lambda i, j: apart[i, j] <= 1.5, scores)
    expected = greedy(lambda i, j: apart[i, j] <= radius[i] and groups[i] == groups[j], scores)
    assert nms_circle(boxes[:, :2], scores, radius, groups).tolist() == expected


def test_nms_over_several_blocks_equals_greedy() -> None:
    boxes, scores = random_boxes(900, 0, 60), torch.rand(900, generator=torch.Generator().manual_seed(2))
    iou = iou_bev(boxes, boxes)
    kept = nms_rotated(boxes, scores, 0.1)
    assert kept.tolist() == greedy(lambda i, j: iou[i, j] > 0.1, scores)
    assert 256 < len(kept) < 900


def test_a_long_chain_of_suppression() -> None:
    boxes = torch.zeros(300, 7)
    boxes[:, 0], boxes[:, 3:6] = torch.arange(300) * 0.5, 1.0  # each overlaps its neighbour only, IoU 1/3
    kept = nms_rotated(boxes, torch.arange(300, 0, -1).float(), 0.2)
    assert kept.tolist() == list(range(0, 300, 2))


def test_suppression_by_volume_keeps_boxes_above_each_other() -> None:
    boxes = torch.tensor([[0.0, 0, 0, 4, 2, 2, 0.3], [0.0, 0, 1.5, 4, 2, 2, 0.3]])
    scores = torch.tensor([0.9, 0.8])
    assert nms_rotated(boxes, scores, 0.5).tolist() == [0]
    assert nms_rotated(boxes, scores, 0.5, volume=True).tolist() == [0, 1]
