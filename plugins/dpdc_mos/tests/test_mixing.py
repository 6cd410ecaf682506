"""The parts in other company: other heads, other backbones, other masks; the second stage; a short training."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw import merge, registry
from lidarfw.assembly import build, make_transforms, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.components.backbones.resnet import ResNetBackbone
from lidarfw.config import compose
from lidarfw.interfaces import Backbone, Head, Loss
from lidarfw.testing.examples import spec_of
from lidarfw.testing.synthetic import CAMERA, SyntheticDataset
from lidarfw.types import (
    BEV,
    DataSpec,
    FrameResult,
    Image,
    PointLabels,
    Points,
    RangeImage,
    RangeView,
    Spec,
    Targets,
    Voxels,
    collate,
)
from torch import Tensor, nn

from lidarfw_dpdc_mos.convolution import DPDC2d, RangeConv2d
from lidarfw_dpdc_mos.distance import distance_maps
from lidarfw_dpdc_mos.losses import edge_aware_terms
from lidarfw_dpdc_mos.refine import SparseRefineHead

DATA = ["dataset=synthetic", "dataset.synthetic.sweeps=3", "dataset.synthetic.pose=true"]
RANGE = [
    "transform=[range_projection,residual_images,edge_distance]",
    "transform.range_projection.height=16",
    "transform.range_projection.width=128",
]
SMALL = [
    "backbone=dpdc",
    "backbone.dpdc.stem=8",
    "backbone.dpdc.widths=[16,16,16]",
    "neck=[]",
    "head=moving_seg",
    "metric=mean_iou",
]


def frames(config: Any, count: int = 4) -> Any:
    """Frames of one synthetic sequence after the transforms of a config."""
    data = SyntheticDataset(frames=count, sequence_length=count, points=2048, sweeps=3, pose=True)
    found = [data[index] for index in range(count)]
    for change in make_transforms(config, training=True):
        found = [change(frame, np.random.default_rng(0)) for frame in found]
    return found


class PointHead(Head):
    """Labels of all points of a frame by a linear layer: a segmentation head without any image."""

    defaults = {"loss": [], "metric": ["mean_iou"]}

    def __init__(self, voxels: Spec, points: Spec, data: DataSpec) -> None:
        super().__init__()
        self.linear = nn.Linear(3 + points.channels, len(data.classes))
        self.provides = Spec(PointLabels, classes=data.classes)

    def forward(self, voxels: Voxels, points: Points) -> Any:
        return self.linear(torch.cat([points.xyz / 10, points.features], 1)), points

    def decode(self, output: Any) -> PointLabels:
        return PointLabels(output[0].softmax(1), output[1].batch, output[1].batch_size)


@pytest.mark.parametrize("transport", ["warp", "voxel", "point"])
def test_the_filter_behind_another_head(transport: str) -> None:
    """A voxel backbone and a head on points of all scans: the filter knows nothing of range images."""
    with registry.use(head={"points": PointHead}):
        options = ["filter.bayes.moving=Car", f"filter.bayes.transport={transport}", "filter.bayes.window=3"]
        config = compose([*DATA, "backbone=second_small", "neck=[]", "head=points", "filter=bayes", *options])
        model = build(plan(config)).eval()
        stream = model.stream()
        out: list[FrameResult] = []
        data = SyntheticDataset(frames=4, sequence_length=4, points=2048, sweeps=3, pose=True)
        raw = [model.predict(collate([data[i]]))[0].of(PointLabels).probability.detach() for i in range(4)]
        for index in range(4):
            out += stream.step(data[index])
        out += stream.flush()
    assert [r.meta.index for r in out] == [0, 1, 2, 3]
    for number, (result, before) in enumerate(zip(out, raw, strict=True)):
        found = result.of(PointLabels).probability
        assert torch.allclose(found.sum(1), torch.ones(len(found)), atol=1e-5)
        changed = float((found - before).abs().max()) > 1e-3
        assert changed is (number > 0 and transport != "point")  # by points later frames only add to earlier ones


class DifferenceResNet(ResNetBackbone):
    """Another network for pictures, its 3 x 3 convolutions of stride 1 replaced by DPDC."""

    def __init__(self, image: Spec) -> None:
        super().__init__(image, channels=(8, 16, 16, 16), blocks=(1, 1, 1, 1))
        for module in list(self.modules()):
            for name, child in list(module.named_children()):
                if isinstance(child, nn.Conv2d) and child.kernel_size == (3, 3) and child.stride == (1, 1):
                    setattr(module, name, DPDC2d(child.in_channels, child.out_channels, bias=False))


def test_dpdc_in_another_backbone() -> None:
    """The resnet of the core with DPDC in it trains, and merges with its norms into plain convolutions."""
    torch.manual_seed(0)
    net = DifferenceResNet(Spec(Image, 3, 1, CAMERA))
    given = Image(torch.randn(2, 3, 64, 96), (CAMERA, CAMERA))
    for _ in range(2):
        sum(level.features.square().mean() for level in net(given)).backward()
    assert all(p.grad is not None for p in net.parameters())
    merged = merge(net)
    assert not any(isinstance(m, (DPDC2d, nn.BatchNorm2d)) for m in merged.modules())
    assert sum(isinstance(m, RangeConv2d) for m in merged.modules()) == 5
    with torch.no_grad():
        for one, other in zip(net.eval()(given), merged(given), strict=True):
            assert float((one.features - other.features).abs().max()) < 1e-4 * float(one.features.abs().max())


class MaskHead(Head):
    """A mask of object footprints on a bird's-eye view."""

    def __init__(self, bev: Spec) -> None:
        super().__init__()
        self.conv = nn.Conv2d(bev.channels, 2, 1)
        self.provides = Spec(PointLabels, classes=("free", "object"))

    def forward(self, bev: BEV) -> Tensor:
        return self.conv(bev.features)  # type: ignore[no-any-return]

    def decode(self, output: Tensor) -> PointLabels:
        raise NotImplementedError


class MaskLoss(Loss):
    """The edge-aware terms on such a mask, whose columns do not go round."""

    def forward(self, logits: Tensor, targets: Targets) -> dict[str, Tensor]:  # type: ignore[override]
        label = torch.zeros(logits.shape[0], *logits.shape[2:], dtype=torch.long)
        label[:, 10:20, 30:44] = 1
        return edge_aware_terms(logits, label, distance_maps(label, 2, wrap=False), alpha=0.3)


def test_the_edge_loss_on_a_birds_eye_mask() -> None:
    torch.manual_seed(0)
    bev = spec_of(BEV)
    head = MaskHead(bev)
    height, width = bev.grid.shape(bev.stride)[1:]
    features = torch.randn(2, bev.channels, height, width)
    features[:, 0] = -1
    features[:, 0, 10:20, 30:44] = 1
    optimizer = torch.optim.Adam(head.parameters(), 0.05)
    loss, totals = MaskLoss(), []
    for _ in range(60):
        terms = loss(head(BEV(features, bev.grid, bev.stride)), Targets())
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        optimizer.step()
        totals.append(float(sum(t.detach() for t in terms.values())))
    assert totals[-1] < 0.3 * totals[0]
    found = head(BEV(features, bev.grid, bev.stride)).argmax(1)
    truth = torch.zeros_like(found)
    truth[:, 10:20, 30:44] = 1
    assert float((found == truth).float().mean()) > 0.97


def test_training_lowers_the_loss_and_resumes_on_distances_of_the_loader() -> None:
    torch.manual_seed(0)
    config = compose([*DATA, *RANGE, *SMALL, "optimizer=adamw"])
    model = build(plan(config)).train()
    batch = collate(frames(config))
    assert batch.targets.pixels is not None
    optimizer = torch.optim.AdamW(model.parameters(), 0.01)
    totals = []
    for step in range(25):
        terms = model.losses(model(batch), batch, progress=(step + 1) / 25)["edge_aware"]
        total = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(float(total.detach()))
    assert totals[-1] < 0.6 * totals[0]
    without = batch.replace(targets=batch.targets.replace(pixels=None))
    with torch.no_grad():
        one, other = (model.eval().losses(model(b), b, 0.5)["edge_aware"] for b in (batch, without))
    for name, value in one.items():
        assert torch.allclose(value, other[name], atol=1e-6), name  # made in the loss where the loader has none


def test_the_second_stage_starts_from_the_first() -> None:
    """sparse_refine gives the labels it takes until it has learned; then it improves on them, alone."""
    torch.manual_seed(0)
    head = ["head=[moving_seg,sparse_refine]", "loss=[edge_aware,sparse_refine]", "loss.edge_aware.weight=0"]
    size = ["head.sparse_refine.cell=0.5", "head.sparse_refine.channels=8"]
    config = compose([*DATA, *RANGE, *SMALL, *head, *size])
    model = build(plan(config)).eval()
    batch = collate(frames(config))
    with torch.no_grad():
        outputs = model(batch)
        first = model.component(model.plan.of("head")[0]).decode(outputs["head.moving_seg"]).probability
        second = model.decode(outputs, batch)
    refined = torch.cat([result.of(PointLabels).probability for result in second])
    seen = first.sum(1) > 0
    assert torch.allclose(refined[seen], first[seen], atol=1e-4)
    part: Any = model.head["sparse_refine"]
    assert isinstance(part, SparseRefineHead)
    optimizer = torch.optim.Adam(part.parameters(), 0.02)
    totals = []
    for _ in range(20):
        terms = model.train().losses(model(batch), batch)["sparse_refine"]
        optimizer.zero_grad()
        torch.stack(list(terms.values())).sum().backward()
        assert all(p.grad is None or not p.grad.any() for p in model.backbone.parameters())
        optimizer.step()
        totals.append(float(sum(t.detach() for t in terms.values())))
    assert totals[-1] < 0.8 * totals[0]


def test_a_backbone_on_the_range_image_of_another_sensor() -> None:
    """Views, point features and numbers of residuals flow through the Specs."""
    view = RangeView(32, 96, math.radians(15), math.radians(-25))
    data = DataSpec({"points": Spec(Points, 2)})
    with registry.use():
        cls: type[Backbone] = registry.load("backbone", "dpdc")
    net: Any = cls(Spec(RangeImage, 5, 1, view), data, stem=8, widths=(16, 16))  # type: ignore[call-arg]
    assert net.residuals == 2
    assert net.provides == Spec(RangeImage, 8, 1, view)


def test_real_scans_go_through() -> None:
    """The public SemanticKITTI scans: residuals mark what moves far more often than what stands."""
    root = Path(os.environ.get("LIDARFW_REAL_DATA", "nowhere")) / "semantic_kitti"
    if not root.is_dir():
        pytest.skip("no real data here: set LIDARFW_REAL_DATA to a folder with the official layouts")
    from lidarfw.components.datasets.semantic_kitti import SemanticKittiDataset

    data = SemanticKittiDataset(root=str(root), split="04", task="moving", sweeps=3, pose=True)
    config = compose(["experiment=mos_semantickitti", "dataset.semantic_kitti.root=unused"])
    frame = data[9]
    for change in make_transforms(config, training=False):
        frame = change(frame, np.random.default_rng(0))
    image, labels = frame.inputs["range"], frame.targets.points
    assert labels is not None
    changed = image.features[0, 2].flatten()[image.pixel] > 0.05
    assert float(changed[labels.label == 1].float().mean()) > 5 * float(changed[labels.label == 0].float().mean())
    assert float(image.mask.float().mean()) > 0.6


def test_the_second_stage_leaves_the_first_as_it_is(tmp_path: Path) -> None:
    """Its weights and the statistics of its normalisation."""
    torch.manual_seed(0)
    small = ["backbone.dpdc.stem=8", "backbone.dpdc.widths=[16,16,16]", *RANGE[1:]]
    options = [
        "experiment=mos_semantickitti_refine", "~dataset.semantic_kitti", *DATA, *small, "dataset.synthetic.frames=4",
        "head.sparse_refine.cell=0.5", "head.sparse_refine.channels=8", "metric=mean_iou", "filter=[]",
        "loss=sparse_refine", "loss.sparse_refine.frequency=null",
        "splits={train: train, val: null, test: null}",
    ]  # fmt: skip
    wired = plan(compose(options))
    before = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": before}, tmp_path / "first.ckpt")
    start = f"init={{from: {tmp_path / 'first.ckpt'}, only: [backbone.dpdc, head.moving_seg]}}"
    run = ["trainer=cpu", "trainer.max_epochs=1", "logger=none", f"hydra.run.dir={tmp_path}"]
    assert main(["train", *options, start, *run]) == 0
    after = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("model.head.sparse_refine.") for name in changed)
