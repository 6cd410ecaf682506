"""Statistics of normalisation at the end of a training."""

from __future__ import annotations

import torch
from torch import nn

from lidarfw.assembly import build, plan
from lidarfw.config import compose
from lidarfw.norms import settle_norms
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import collate

SMALL = ["backbone.pillars.channels=8", "neck.bev_fpn.layers=[1,1,1]", "neck.bev_fpn.channels=[8,8,8]",
         "neck.bev_fpn.upsampled=[8,8,8]"]  # fmt: skip


def test_statistics_are_the_mean_over_the_batches() -> None:
    torch.manual_seed(0)
    model = build(plan(compose(SMALL))).train()
    data = SyntheticDataset(frames=4, points=2048)
    batches = [collate([data[0], data[1]]), collate([data[2], data[3]])]
    weights = {name: value.clone() for name, value in model.named_parameters()}
    first = next(m for m in model.modules() if isinstance(m, nn.BatchNorm2d))
    inputs = []
    handle = first.register_forward_pre_hook(lambda module, given: inputs.append(given[0]))
    settle_norms(model, batches)
    handle.remove()
    means, variances = zip(*((x.mean((0, 2, 3)), x.var((0, 2, 3))) for x in inputs))
    assert torch.allclose(first.running_mean, torch.stack(means).mean(0), atol=1e-5)  # type: ignore[arg-type]
    assert torch.allclose(first.running_var, torch.stack(variances).mean(0), rtol=1e-4)  # type: ignore[arg-type]
    assert model.training
    assert all(torch.equal(value, weights[name]) for name, value in model.named_parameters())
    assert all(not m._forward_pre_hooks for m in model.modules())


def test_nothing_to_go_by_changes_nothing() -> None:
    model = build(plan(compose(SMALL)))
    before = {name: value.clone() for name, value in model.state_dict().items()}
    settle_norms(model, [])
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
