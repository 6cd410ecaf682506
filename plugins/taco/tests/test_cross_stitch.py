"""Backbone cross_stitch: two networks that mix, in the place of the shared one."""

from __future__ import annotations

import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.config import compose
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Points, Spec, collate

from lidarfw_taco.backbones.cross_stitch import CrossStitch, CrossStitchBackbone

SMALL = {
    "lower": (0.0, -16.0, -3.0), "upper": (32.0, 16.0, 1.0), "cell": (0.5, 0.5, 0.5), "stem": 4,
    "blocks": ((6,), (8,)), "bev_stride": 2, "bev_channels": 8,
}  # fmt: skip


def points() -> Points:
    return collate([SyntheticDataset(frames=1, points=1024)[0]]).inputs["points"]


def test_unit():
    unit = CrossStitch(2, 0.9, both=True)
    one, other = unit(torch.tensor([[1.0, 2.0]]), torch.tensor([[10.0, 0.0]]))
    assert one[0].tolist() == pytest.approx([1.9, 1.8])
    assert other[0].tolist() == pytest.approx([9.1, 0.2])


def test_without_mixing_the_networks_are_two_backbones():
    torch.manual_seed(0)
    scan = points()
    both = CrossStitchBackbone(Spec(Points, 1), **SMALL, own=1.0).eval()
    levels, bev = both(scan)
    both.localization.flatten = both.detection.flatten  # so that it runs alone; only its levels are compared
    for level, alone in zip(levels, both.localization(scan)[0], strict=True):
        assert torch.equal(level.index, alone.index)
        assert torch.allclose(level.features, alone.features, atol=1e-6)
    assert torch.allclose(bev.features, both.detection(scan)[1].features, atol=1e-6)


def test_with_mixing_a_task_sees_the_other():
    torch.manual_seed(0)
    both = CrossStitchBackbone(Spec(Points, 1), **SMALL).eval()
    before = both(points())[1].features
    with torch.no_grad():
        for parameter in both.localization.parameters():
            parameter.mul_(2)
    assert not torch.allclose(before, both(points())[1].features)


def test_it_stands_in_for_the_shared_backbone():
    overrides = [
        "dataset.synthetic.frames=2", "dataset.synthetic.pose=true", "neck=[bev_fpn_taco_small,gated_fusion]",
        "head=[center_small,scene_coord_small]", "metric=box_ap",
    ]  # fmt: skip
    sizes = {}
    for name in ("taco", "cross_stitch"):
        model = build(plan(compose([*overrides, f"backbone={name}_small"])))
        sizes[name] = sum(p.numel() for p in model.backbone.parameters())
    assert 1.8 * sizes["taco"] < sizes["cross_stitch"] < 2.1 * sizes["taco"]
    batch = collate([SyntheticDataset(frames=1, pose=True, points=2048)[0]])
    terms = model.train().losses(model(batch), batch)
    torch.stack([term for each in terms.values() for term in each.values()]).sum().backward()
    missed = [n for n, p in model.backbone.named_parameters() if p.grad is None]
    assert not missed
