"""Refinement learns four scans by heart: boxes that are off end tight, the tighter the later the stage."""

from __future__ import annotations

import torch
from lidarfw.interfaces.data import Dataset
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import BEV, Batch, Boxes, Grid, Points, Spec, Targets, collate

from lidarfw_msrm.heads.msrm import MSRMHead
from lidarfw_msrm.losses.msrm import MSRMLoss
from lidarfw_msrm.metrics.box_quality import BoxQuality

STEPS = 300
GRID = Grid((0.0, -40.0, -3.0), (70.4, 40.0, 1.0), (3.2, 3.2, 4.0))


def scans() -> tuple[Batch, Dataset]:
    """Four scans as a batch."""
    data = SyntheticDataset(frames=4, sequence_length=1, points=2048)
    return collate([data[number] for number in range(4)]), data


def moved(truth: Boxes, copies: int) -> Boxes:
    """Proposals around the objects, off by some tenths of their size and some degrees."""
    generator = torch.Generator().manual_seed(0)
    rows = torch.arange(len(truth)).repeat_interleave(copies)
    near = truth[rows]
    noise = torch.randn(len(rows), 7, generator=generator)
    return near.replace(
        center=near.center + noise[:, :3] * 0.12 * near.size,
        size=near.size * (noise[:, 3:6] * 0.12).exp(),
        yaw=near.yaw + noise[:, 6] * 0.12,
        score=torch.rand(len(rows), generator=generator),
    )


def overlap(boxes: Boxes, truth: Boxes, stage: int) -> float:
    """Mean 3D IoU of the boxes of a stage with the objects that they match."""
    assert boxes.stage is not None
    metric = BoxQuality(Spec(Boxes, classes=SyntheticDataset().classes))
    metric.update(boxes[boxes.stage == stage], Targets(boxes=truth))
    return float(metric.compute()["mean_iou"])


def test_four_scans_by_heart() -> None:
    torch.manual_seed(0)
    batch, data = scans()
    truth, points = batch.targets.boxes, batch.inputs["points"]
    assert truth is not None
    assert isinstance(points, Points)
    truth = truth.replace(occlusion=None)
    proposals, targets = moved(truth, 3), Targets(boxes=truth)
    bev = BEV(torch.zeros(4, 4, *GRID.shape(1)[1:]), GRID)
    net = MSRMHead(
        Spec(Boxes, classes=data.spec.classes), Spec(BEV, 4, 1, GRID), None, data.spec.inputs["points"], data.spec,
        pool="points", regions=16, grid=2, neighbors=4, channels=64, heads=2, dropout=0.0,
    )  # fmt: skip
    loss = MSRMLoss(Spec(Boxes))
    optimizer = torch.optim.Adam(net.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, STEPS)
    for _ in range(STEPS):
        terms = loss(net(proposals, bev, None, points, targets), targets)
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        found = net.eval().decode(net(proposals, bev, None, points))
    by_stage = [overlap(found, truth, stage) for stage in range(4)]
    assert by_stage[3] > 0.9, by_stage
    assert by_stage[3] >= by_stage[1], by_stage
    assert by_stage[1] > by_stage[0] + 0.2, by_stage
