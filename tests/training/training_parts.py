"""A tiny detector of one box per scan, for tests of training: batch norm, dropout, milliseconds per step."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lidarfw.errors import DataError
from lidarfw.interfaces import Backbone, Dataset, Filter, Head, Loss, Metric, Transform
from lidarfw.types import Boxes, DataSpec, Frame, FrameMeta, FrameResult, Points, Spec, Targets

POINTS = 12


class ToyDataset(Dataset):
    """Clouds around the centre of one box; split `val` has other clouds than `train`."""

    def __init__(
        self,
        *,
        split: str = "train",
        frames: int = 12,
        length: int = 4,
        broken: list[int] = [],  # noqa: B006  # read only
        poison: int = -1,
        classes: list[str] = ["a", "b"],  # noqa: B006
    ):
        self.split, self.frames, self.length, self.broken, self.poison = split, frames, length, set(broken), poison
        self.spec = DataSpec({"points": Spec(Points, 1)}, frozenset({Boxes}), tuple(classes))

    def __len__(self) -> int:
        return self.frames

    def meta(self, index: int) -> FrameMeta:
        sequence, step = divmod(index, self.length)
        return FrameMeta(f"{self.split}{index:03d}", f"{self.split}{sequence}", step, 0.1 * step)

    def sequences(self):
        return [range(s, min(s + self.length, self.frames)) for s in range(0, self.frames, self.length)]

    def __getitem__(self, index: int) -> Frame:
        if index in self.broken:
            raise DataError(f"scan{index:03d}.bin: size 7 is not a multiple of 16")
        rng = np.random.default_rng((index, len(self.split)))
        center = rng.normal(size=3)
        xyz = torch.tensor(center + 0.1 * rng.normal(size=(POINTS, 3)), dtype=torch.float32)
        if index == self.poison:
            xyz[0, 0] = float("nan")
        box = torch.tensor([[*center, 1, 1, 1, 0]], dtype=torch.float32)
        boxes = Boxes.from_tensor(box, torch.tensor([int(center[0] > 0)]))
        return Frame({"points": Points.from_scan(xyz, torch.ones(POINTS, 1))}, Targets(boxes), self.meta(index))


class ToyJitter(Transform):
    """Moves every point a little."""

    train_only = True

    def __init__(self, *, size: float = 0.05):
        self.size = size

    def __call__(self, frame: Frame, rng: np.random.Generator) -> Frame:
        points = frame.inputs["points"]
        noise = torch.tensor(rng.normal(size=points.xyz.shape) * self.size, dtype=torch.float32)
        return frame.replace(inputs={"points": points.replace(xyz=points.xyz + noise)})


class ToyBackbone(Backbone):
    """One layer with batch norm and dropout."""

    def __init__(self, points: Spec, *, width: int = 8, dropout: float = 0.2):
        super().__init__()
        self.layer = nn.Linear(3 + points.channels, width)
        self.norm = nn.BatchNorm1d(width)
        self.dropout = nn.Dropout(dropout)
        self.provides = Spec(Points, width)

    def forward(self, points: Points) -> Points:
        features = self.layer(torch.cat([points.xyz, points.features], 1))
        return points.replace(features=self.dropout(self.norm(features).relu()))


@dataclass
class ToyOutput:
    center: Tensor  # (B, 3)
    logits: Tensor  # (B, K)


class ToyHead(Head):
    """Mean of the features, then two linear layers."""

    defaults = {"loss": ["toy"], "metric": ["toy"]}

    def __init__(self, points: Spec, data: DataSpec):
        super().__init__()
        self.center = nn.Linear(points.channels, 3)
        self.label = nn.Linear(points.channels, len(data.classes))
        self.provides = Spec(Boxes, classes=data.classes)

    def forward(self, points: Points) -> ToyOutput:
        mean = points.features.new_zeros(points.batch_size, points.features.shape[1])
        mean = mean.index_add(0, points.batch, points.features) / POINTS
        return ToyOutput(self.center(mean), self.label(mean))

    def decode(self, output: ToyOutput) -> Boxes:
        size = torch.ones_like(output.center)
        boxes = torch.cat([output.center, size, output.center[:, :1] * 0], 1)
        score, label = output.logits.softmax(1).max(1)
        return Boxes.from_tensor(boxes, label, score, torch.arange(len(boxes)), len(boxes))


class ToyLoss(Loss):
    """Distance of the centre, cross entropy of the class."""

    def forward(self, toy: ToyOutput, targets: Targets) -> dict[str, Tensor]:
        distance = (toy.center - targets.boxes.center).abs().mean()
        return {"center": distance, "class": nn.functional.cross_entropy(toy.logits, targets.boxes.label)}


class ToyMetric(Metric):
    """Share of right classes, and how many frames were seen."""

    monitor = "accuracy"

    def __init__(self):
        super().__init__()
        self.add_state("right", torch.zeros(()), dist_reduce_fx="sum")
        self.add_state("frames", torch.zeros(()), dist_reduce_fx="sum")

    def update(self, boxes: Boxes, targets: Targets) -> None:
        self.right += (boxes.label == targets.boxes.label).sum()
        self.frames += 1

    def compute(self) -> dict[str, float]:
        return {"accuracy": float(self.right / self.frames), "frames": float(self.frames)}


class ToyDelay(Filter):
    """Holds every frame back until the next one has come."""

    def start(self) -> list[FrameResult]:
        return []

    def step(self, state: list[FrameResult], frame: FrameResult) -> list[FrameResult]:
        state.append(frame)
        return [state.pop(0)] if len(state) > 1 else []

    def flush(self, state: list[FrameResult]) -> list[FrameResult]:
        return state


SLOTS = {
    "dataset": {"toy": ToyDataset},
    "transform": {"jitter": ToyJitter},
    "backbone": {"toy": ToyBackbone},
    "head": {"toy": ToyHead},
    "loss": {"toy": ToyLoss},
    "metric": {"toy": ToyMetric},
    "filter": {"delay": ToyDelay},
}
OVERRIDES = [
    "dataset=toy", "transform=[jitter]", "backbone=toy", "neck=[]", "head=toy", "trainer=cpu", "logger=csv",
    "trainer.max_epochs=3", "trainer.log_every_n_steps=1", "trainer.enable_progress_bar=false",
    "trainer.enable_model_summary=false",
    "optimizer.lr=0.01", "trainer.num_sanity_val_steps=0",
]  # fmt: skip
