"""Refinement on other people's backbones: every experiment learns a step, and gives boxes of all stages."""

from __future__ import annotations

import itertools

import pytest
import torch
from lidarfw.assembly import build, plan
from lidarfw.config import compose
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Boxes, Poses, collate

from lidarfw_msrm.heads.msrm import MSRMHead

SMALL = ["dataset=synthetic", "head.msrm.grid=2", "head.msrm.regions=8", "head.msrm.neighbors=4", "transform=[]"]


@pytest.mark.parametrize(
    ("experiment", "pool", "losses"),
    [
        ("second_msrm", "voxels", {"anchor", "msrm"}),
        ("pillars_msrm", "bev", {"anchor", "msrm"}),
        ("taco_msrm", "points", {"center", "scene_coord", "msrm"}),
        ("taco_msrm", "voxels", {"center", "scene_coord", "msrm"}),
    ],
)
def test_a_step_on_other_backbones(experiment: str, pool: str, losses: set[str]) -> None:
    if experiment == "taco_msrm":
        pytest.importorskip("lidarfw_taco")
    ranges = [] if experiment == "taco_msrm" else [f"backbone.{experiment[:-5]}.lower=[0,-25.6,-3]"]
    ranges += [] if experiment == "taco_msrm" else [f"backbone.{experiment[:-5]}.upper=[51.2,25.6,1]"]
    chosen = ["head.msrm.pool=voxels"] if (experiment, pool) == ("taco_msrm", "voxels") else []
    config = compose([f"experiment={experiment}", *SMALL, *ranges, *chosen])
    torch.manual_seed(0)
    model = build(plan(config)).train()
    head = next(module for module in model.modules() if isinstance(module, MSRMHead))
    assert head.pool == pool
    data = SyntheticDataset(frames=2, points=4096)
    batch = collate([data[0], data[1]])
    terms = model.losses(model(batch), batch)
    assert set(terms) >= losses
    total = torch.stack(list(itertools.chain.from_iterable(term.values() for term in terms.values()))).sum()
    total.backward()  # type: ignore[no-untyped-call]
    assert bool(total.isfinite())
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for p in head.encoders.parameters())
    result = model.eval().predict(batch)[0]
    assert result.of(Boxes).stage is None
    if "scene_coord" in losses:
        assert result.of(Poses).matrix.shape == (1, 4, 4)
