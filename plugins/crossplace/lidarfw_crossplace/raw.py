"""What no learning reaches: python -m lidarfw_crossplace.raw experiment=crossplace_town.

The inputs of a frame, as the transforms of the experiment give them, are its descriptor: every map made coarser, its
mean taken off, to unit length. They are judged by the metric of the experiment, as its model is.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from lidarfw import config
from lidarfw.cli import answered
from lidarfw.data import evaluation_data
from lidarfw.types import BEV, Descriptors, Frame, Image, Spec
from omegaconf import OmegaConf
from rich.progress import track
from torch import Tensor
from torch.nn import functional as F

from lidarfw_crossplace.heads import unit
from lidarfw_crossplace.metrics import PlaceRecall


def raw_descriptor(frame: Frame, height: int = 8, width: int = 64) -> Tensor:
    """(1, D) of unit length: the maps of a frame on `height` x `width` cells, each with mean 0 and length 1."""
    maps = [value.features for value in frame.inputs.values() if isinstance(value, Image | BEV)]
    coarse = [F.adaptive_avg_pool2d(part, (height, width)).flatten(1) for part in maps]
    return unit(torch.cat([unit(part - part.mean(1, keepdim=True)) for part in coarse], 1))


def judged(frames: Iterable[Frame], metric: PlaceRecall) -> dict[str, float]:
    """The figures of a metric for raw descriptors."""
    for frame in frames:
        metric.update(Descriptors(raw_descriptor(frame), (frame.meta.modality,)), frame.targets, [frame.meta])
    return dict(metric.compute())


@answered
def main(arguments: Sequence[str] | None = None) -> None:
    """Judge the split `test` of an experiment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("overrides", nargs="*", help="those of the training")
    settings = config.compose(parser.parse_args(arguments).overrides)
    dataset, transforms = evaluation_data(settings, settings.splits.test)

    def changed(number: int) -> Frame:
        frame = dataset[number]
        for transform in transforms:
            frame = transform(frame, np.random.default_rng(number))
        return frame

    width = raw_descriptor(changed(0)).shape[1]
    chosen = dict(OmegaConf.to_container(settings.metric.place_recall, resolve=True))  # type: ignore[arg-type]
    options = {key: value for key, value in chosen.items() if key not in ("type", "inputs")}
    metric = PlaceRecall(Spec(Descriptors, width), **options)
    for name, value in judged((changed(i) for i in track(range(len(dataset)), "read")), metric).items():
        print(f"{name:<24} {value:.4f}")


if __name__ == "__main__":
    sys.exit(main())
