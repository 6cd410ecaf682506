"""Every combination of backbone, necks and head that is said to fit is built, trained for a step and decoded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import compat_table as table
import numpy as np
import pytest
import torch

from lidarfw import assembly, declaration, registry
from lidarfw.config import compose, to_plain
from lidarfw.testing.checks.compare import finite
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Batch, Boxes, Frame, collate

ROOT = Path(__file__).resolve().parents[1]
AT_MOST = 40  # combinations that are built; with more, an even choice of them
POINTS = 500
VALID = table.valid_combinations()
BUILT = VALID[:: -(-len(VALID) // AT_MOST)]
RANGE = {"lower": (0.0, -16.0, -3.0), "upper": (32.0, 16.0, 1.0)}  # metres


@pytest.fixture(scope="module")
def sizes() -> dict[str, dict[str, Any]]:
    """Options that make each component small: those of its preset NAME_small, what its class says, a short range."""
    found = {}
    for slot in ("backbone", "neck", "head"):
        for name in table.repository_names(slot):
            small = (ROOT / "conf" / slot / f"{name}_small.yaml").exists()
            node = to_plain(compose([f"{slot}={name}{'_small' * small}", *(["neck=[]"] if slot != "neck" else [])]))
            options = {k: v for k, v in node[slot][name].items() if k not in ("type", "inputs")}
            known = declaration.read(slot, name).options
            options |= getattr(registry.load(slot, name), "example", {})
            found[f"{slot}.{name}"] = options | {k: v for k, v in RANGE.items() if k in known}
    return found


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    dataset = SyntheticDataset(frames=2, points=2048, **table.INPUTS)
    return [thin(dataset[index]) for index in range(2)]


def batch_for(backbone: str, frames: list[Frame]) -> Batch:
    """The frames as the backbone gets them."""
    for transform in assembly.make_transforms(table.data_config(backbone), training=False):
        frames = [transform(frame, np.random.default_rng(0)) for frame in frames]
    return collate(frames)


def thin(frame: Frame) -> Frame:
    points = frame.inputs["points"]
    chosen = torch.linspace(0, len(points) - 1, POINTS).long()
    inputs = {**frame.inputs, "points": points[chosen]}
    return frame.replace(inputs=inputs, targets=frame.targets.replace(points=frame.targets.points[chosen]))


def test_the_page_is_what_the_rules_say() -> None:
    assert table.PAGE.read_text(encoding="utf-8") == table.page(), "run: python tools/compat_table.py"


def test_the_table_covers_what_is_installed() -> None:
    assert len(VALID) >= 100
    assert {c.backbone for c in VALID} == set(table.backbones()), "a backbone fits nowhere"
    assert {name for c in VALID for name in c.heads} == set(table.repository_names("head")), "a head fits nowhere"
    if len(BUILT) < len(VALID):
        print(f"building {len(BUILT)} of {len(VALID)} combinations, evenly chosen")


@pytest.mark.parametrize("combination", BUILT, ids=lambda c: c.id)
def test_a_valid_combination_trains_and_decodes(
    combination: Any, sizes: dict[str, dict[str, Any]], frames: list[Frame]
) -> None:
    batch = batch_for(combination.backbone, frames)
    torch.manual_seed(0)
    model = assembly.build(assembly.plan(combination.config(sizes), table.data_spec(combination.backbone))).train()
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-3)
    terms = model.losses(model(batch), batch)
    torch.stack([term for named in terms.values() for term in named.values()]).sum().backward()
    assert finite([p.grad for p in model.parameters() if p.grad is not None])
    # a feature that nothing reads learns nothing, but every head does
    learned = {name.split(".")[1] for name, p in model.named_parameters() if p.grad is not None}
    assert learned.issuperset(head for head in combination.heads if any(True for _ in model.head[head].parameters()))
    optimizer.step()
    with torch.no_grad():
        results = model.eval().predict(batch)
    assert [r.meta.id for r in results] == [m.id for m in batch.meta]
    for result in results:
        assert result.predictions
        assert finite(list(result.predictions.values()))
        assert all((p.label < 3).all() for p in result.predictions.values() if isinstance(p, Boxes))


def test_a_combination_that_does_not_fit_is_refused() -> None:
    broken = table.Combination("second", (), ("center",))
    assert not table.fits(broken)
    with pytest.raises(assembly.AssemblyError, match="height_compression"):
        assembly.plan(broken.config(), table.data_spec("second"))


def test_what_only_a_metric_reads_is_of_no_use() -> None:
    """`box_ap` may count points, which is no reason to compute features on them behind a detector's neck."""
    assert not [c.id for c in VALID if "voxels_to_points" in c.necks[-1:] and c.heads == ("center",)]
