"""The experiments compose, and their losses of tracking reach the detector, whichever it is."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lidarfw import assembly, registry
from lidarfw.config import compose
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import collate

OURS = ("time3d_town", "time3d_nuscenes", "time3d_boxes_town", "time3d_boxes_kitti")
JOINT = {"msrm_time3d": "backbone.resnet_se", "taco_time3d": "backbone.taco"}


def _installed(*names: str) -> None:
    for slot, name in (("dataset", "town_tracking"), *(("backbone", name.partition(".")[2]) for name in names)):
        if name not in registry.names(slot):
            pytest.skip(f"{slot} {name} is not installed")


@pytest.mark.parametrize("name", [*OURS, *JOINT])
def test_experiments_compose(name: str) -> None:
    _installed(*([JOINT[name]] if name in JOINT else []))
    planned = assembly.plan(compose([f"experiment={name}"]))
    steps = {step.id for step in planned.steps}
    assert {"tracker.time3d", "loss.association", "loss.temporal_consistency"} <= steps


@pytest.mark.parametrize("name", list(JOINT))
def test_a_lidar_detector_learns_from_the_association(name: str) -> None:
    """One step on synthetic scans: the gradient goes through the boxes (of MSRM, which cuts off the geometry of its
    stages, through their scores)."""
    _installed(JOINT[name])
    planned = assembly.plan(compose([f"experiment={name}"]))
    torch.manual_seed(0)
    model = assembly.build(planned).train()
    batch = collate(list(SyntheticDataset(frames=3, sequence_length=3, points=4096, pose=True)))
    outputs = model(batch)
    tracked = outputs["tracker.time3d"]
    losses: Any = model.losses(outputs, batch, 1.0)
    loss = losses["association"]["association"] + losses["temporal_consistency"]["anchor"]
    if float(loss.detach()) == 0:  # an untrained detector may be near no object: pull at the affinities all the same
        loss = tracked.logits.clamp(min=-100).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    weights = [p for n, p in model.named_parameters() if n.startswith(JOINT[name])]
    assert any(p.grad is not None and bool((p.grad != 0).any()) for p in weights)
