"""Presets and chains of backbones and necks: they compose, build, and one training step reaches every weight."""

from __future__ import annotations

from pathlib import Path

import lidarfw.conf
import pytest
import torch
from omegaconf import OmegaConf

from lidarfw import assembly, config
from lidarfw.testing import synthetic
from lidarfw.types import Batch, collate

CHAINS = {
    "pillars": ["backbone=pillars_small", "neck=bev_fpn_small"],
    "second": ["backbone=second_small", "neck=[height_compression,bev_fpn_second_small]"],
    "points to voxels": [
        "backbone=[]",
        "neck=[points_to_voxels,height_compression,bev_fpn_second_small]",
        "neck.points_to_voxels.cell=[0.4,0.4,0.4]",
    ],
    "bev to voxels": ["backbone=pillars_small", "neck=[bev_fpn_small,bev_to_voxels]"],
    "camera": ["backbone=resnet_small", "neck=lift", "neck.lift.channels=16", "dataset.synthetic.image=true"],
}


@pytest.fixture(scope="module")
def batch() -> Batch:
    return collate(synthetic.frames(2, image=True))


@pytest.mark.parametrize("name", CHAINS)
def test_a_chain_of_presets_trains(name: str, batch: Batch) -> None:
    torch.manual_seed(0)
    plan = assembly.plan(config.compose([*CHAINS[name], "head=center_small"]))
    model = assembly.build(plan)
    terms = model.losses(model(batch), batch, 1.0)
    total = sum(term for group in terms.values() for term in group.values())
    total.backward()
    assert bool(total.isfinite())
    silent = [k for k, p in model.named_parameters() if p.grad is None or not bool(p.grad.isfinite().all())]
    assert not silent


def presets() -> list[tuple[str, Path]]:
    folder = Path(lidarfw.conf.__file__).parent
    return [(slot, path) for slot in ("backbone", "neck") for path in sorted((folder / slot).glob("*.yaml"))]


@pytest.mark.parametrize(("slot", "path"), presets(), ids=lambda value: getattr(value, "stem", value))
def test_a_preset_keeps_the_node_name_of_its_type(slot: str, path: Path) -> None:
    preset = OmegaConf.load(path)
    kind = preset.defaults[0]
    assert list(preset) == ["defaults", kind]
    composed = config.to_plain(config.compose([f"{slot}={path.stem}"]))[slot][kind]
    assert composed["type"] == kind
    assert composed.items() >= OmegaConf.to_container(preset[kind]).items()


def test_a_preset_can_be_overridden_by_its_type() -> None:
    composed = config.compose(["backbone=second_small", "neck=height_compression", "backbone.second.layers=1"])
    assert composed.backbone.second.layers == 1
    assert composed.backbone.second.out_channels == 64
