"""Inputs at the edge of what can happen: finite losses and gradients, no exception."""

from __future__ import annotations

import pytest
import torch
from lidarfw.types import BEV, Boxes, DataSpec, Grid, Spec, Targets, Voxels
from torch import Tensor

from lidarfw_msrm.heads.msrm import MSRMHead
from lidarfw_msrm.losses.msrm import MSRMLoss
from lidarfw_msrm.postprocessors.box_voting import BoxVoting

CLASSES = ("Car", "Pedestrian", "Cyclist")
GRID = Grid((0.0, -8.0, -3.0), (16.0, 8.0, 1.0), (0.5, 0.5, 0.5))
LEVELS = [Spec(Voxels, 4, stride, GRID, depth=GRID.shape(stride)[0]) for stride in (1, 2)]
CAR = [8.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.3]


def head(stages: int = 3) -> MSRMHead:
    torch.manual_seed(0)
    return MSRMHead(
        Spec(Boxes, classes=CLASSES), Spec(BEV, 8, 2, GRID), LEVELS, None, DataSpec(classes=CLASSES),
        stages=stages, regions=16, strides=(1, 2), grid=2, channels=16, heads=2, neighbors=4,
    )  # fmt: skip


def boxes(*rows: list[float], batch: list[int] | None = None, samples: int = 1) -> Boxes:
    batches = torch.zeros(len(rows), dtype=torch.long) if batch is None else torch.tensor(batch)
    table = torch.tensor(rows).view(-1, 7)
    label = torch.zeros(len(rows), dtype=torch.long)
    return Boxes.from_tensor(table, label, torch.full((len(rows),), 0.9), batches, samples)


def levels(occupied: bool, samples: int) -> list[Voxels]:
    found = []
    for spec in LEVELS:
        shape = GRID.shape(spec.stride)
        cells = torch.cartesian_prod(torch.arange(samples), *(torch.arange(0, size, 3) for size in shape))
        cells = cells if occupied else cells[:0]
        features = torch.randn(len(cells), 4, requires_grad=True)
        found.append(Voxels(features, cells, GRID, shape, (spec.stride,) * 3, samples))
    return found


def train(proposals: Boxes, truth: Boxes, occupied: bool = True) -> tuple[MSRMHead, dict[str, Tensor]]:
    """One step of training: the terms, after their gradients were found finite."""
    net, samples = head().train(), proposals.batch_size
    bev = BEV(torch.randn(samples, 8, 16, 16, requires_grad=True), GRID, 2)
    output = net(proposals, bev, levels(occupied, samples), None, Targets(boxes=truth))
    terms = MSRMLoss(Spec(Boxes))(output, Targets(boxes=truth))
    sum(terms.values()).backward()  # type: ignore[union-attr]
    assert all(bool(term.isfinite()) for term in terms.values()), terms
    assert all(bool(p.grad.isfinite().all()) for p in net.parameters() if p.grad is not None)
    assert all(bool(state.isfinite().all()) for state in net.state_dict().values())
    found = BoxVoting(Spec(Boxes))(net.decode(output))
    assert bool(found.tensor.isfinite().all())
    assert len(found) == len(output.rois)
    return net, terms


@pytest.mark.parametrize(
    ("rows", "occupied"),
    [
        ([], True),
        ([CAR], True),  # a single region, whose tokens have no variance
        ([CAR], False),  # without any voxel
        ([CAR, [200.0, 90.0, 0.0, 4.0, 2.0, 1.5, 0.0]], True),  # one far outside of the grid
        ([CAR, [8.0, 4.0, -1.0, 0.0, 0.0, 0.0, 0.0]], True),  # one without extent
    ],
    ids=["no proposal", "a single region", "no voxel", "outside", "no extent"],
)
@pytest.mark.parametrize("truth", [[CAR], []], ids=["an object", "no object"])
def test_training_goes_on(rows: list[list[float]], occupied: bool, truth: list[list[float]]) -> None:
    train(boxes(*rows), boxes(*truth), occupied)


def test_a_sample_without_points_beside_one_with() -> None:
    proposals = boxes(CAR, CAR, batch=[0, 1], samples=2)
    output = head().eval()(proposals, BEV(torch.zeros(2, 8, 16, 16), GRID, 2), _only_first(levels(True, 2)))
    alone = head().eval()(boxes(CAR), BEV(torch.zeros(1, 8, 16, 16), GRID, 2), levels(False, 1))
    torch.testing.assert_close(output.boxes[:, 1], alone.boxes[:, 0])


def _only_first(there: list[Voxels]) -> list[Voxels]:
    parts = []
    for level in there:
        rows = level.index[:, 0] == 0
        parts.append(Voxels(level.features[rows], level.index[rows], GRID, level.shape, level.strides, 2))
    return parts


def test_no_foreground_at_the_last_stage_only() -> None:
    """An IoU of 0.57 is foreground of the first two stages; they learn, the third adds nothing."""
    truth = boxes([8.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0])
    moved = boxes([8.0 + 4 * 0.43 / 1.57, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0])
    net = head()
    with torch.no_grad():
        for branch in net.correction:
            branch[-1].weight.zero_()  # type: ignore[index, union-attr, operator]
    output = net.eval()(moved, BEV(torch.zeros(1, 8, 16, 16), GRID, 2), levels(True, 1))
    by_stage = [MSRMLoss(Spec(Boxes))._stage(output, n, truth, Boxes.empty())["box"] for n in range(3)]
    assert [float(term) > 0 for term in by_stage] == [True, True, False]


def test_regions_of_a_short_sample_are_no_others() -> None:
    """A sample with two proposals beside one with five: each gives as many boxes, in every stage."""
    rows = [[2.0 + 3 * n, 0.0, -1.0, 2.0, 1.0, 1.5, 0.0] for n in range(5)]
    proposals = boxes(*rows, *rows[:2], batch=[0] * 5 + [1] * 2, samples=2)
    net = head().eval()
    output = net(proposals, BEV(torch.zeros(2, 8, 16, 16), GRID, 2), levels(True, 2))
    assert net.decode(output).batch.bincount().tolist() == [20, 8]


def test_votes_without_confidence() -> None:
    two = boxes(CAR, [9.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.3]).replace(score=torch.zeros(2), stage=torch.tensor([1, 2]))
    torch.testing.assert_close(BoxVoting(Spec(Boxes))(two).center[0, 0], torch.tensor(8.5))
