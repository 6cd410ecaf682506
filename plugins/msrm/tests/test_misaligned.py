"""The head whose attention joins tokens of different regions, which the claims compare with."""

from __future__ import annotations

import torch
from lidarfw.types import BEV, Boxes, DataSpec, Grid, Spec, Targets

from lidarfw_msrm.heads.msrm import MSRMHead
from lidarfw_msrm.misaligned import MisalignedMSRMHead, _shuffled

GRID = Grid((0.0, -8.0, -3.0), (16.0, 8.0, 1.0), (0.5, 0.5, 4.0))
CLASSES = ("Car", "Pedestrian")


def head(kind: type[MSRMHead]) -> MSRMHead:
    torch.manual_seed(0)
    spec, bev = Spec(Boxes, classes=CLASSES), Spec(BEV, 8, 1, GRID)
    small = {"stages": 3, "regions": 16, "grid": 2, "channels": 16, "heads": 2, "dropout": 0.0, "pool": "bev"}
    return kind(spec, bev, None, None, DataSpec(classes=CLASSES), **small)  # type: ignore[arg-type]


def scene() -> tuple[Boxes, BEV, Targets]:
    """Twelve proposals that do not suppress each other, half of them on an object."""
    rows = [[2.0 + 3.5 * (n % 4), -6.0 + 5 * (n // 4), -1, 3, 1.5, 1.5, 0.0] for n in range(12)]
    boxes = Boxes.from_tensor(torch.tensor(rows), torch.zeros(12, dtype=torch.long), torch.linspace(1, 0.5, 12))
    return boxes, BEV(torch.randn(1, 8, 32, 32), GRID), Targets(boxes=boxes[:6])


def test_places_are_shuffled_within_their_group() -> None:
    group = torch.arange(60) % 3
    rows = _shuffled(group)
    assert torch.equal(rows.sort()[0], torch.arange(60))
    assert torch.equal(group[rows], group)
    assert not torch.equal(rows, torch.arange(60))


def test_stage_one_is_the_same_and_later_ones_see_other_regions_while_learning() -> None:
    boxes, bev, targets = scene()
    right, wrong = (head(kind).train() for kind in (MSRMHead, MisalignedMSRMHead))
    torch.manual_seed(0)
    one = right(boxes, bev, targets=targets)
    torch.manual_seed(0)
    other = wrong(boxes, bev, targets=targets)
    assert torch.equal(one.rois.tensor, other.rois.tensor)
    assert torch.equal(one.confidence[0], other.confidence[0])
    assert not torch.allclose(one.confidence[1], other.confidence[1])


def test_without_targets_both_are_the_same() -> None:
    boxes, bev, _ = scene()
    right, wrong = (head(kind).eval() for kind in (MSRMHead, MisalignedMSRMHead))
    assert torch.equal(right(boxes, bev).boxes, wrong(boxes, bev).boxes)
