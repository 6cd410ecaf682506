"""`lidarfw prepare`: what has to be checked or written once before training, which else does it itself."""

from __future__ import annotations

import argparse
import os


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw prepare`."""
    parser.add_argument(
        "overrides", nargs="*", metavar="OVERRIDE", help="those of the training: experiment=pillars_kitti ..."
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes, default one per core")


def run(args: argparse.Namespace) -> int:
    """Prepare the dataset's splits, then what the transforms need of the split that is trained on."""
    from lidarfw.assembly import make_dataset, make_transforms
    from lidarfw.config import compose

    config = compose(args.overrides)
    splits = dict.fromkeys(split for split in config.splits.values() if split)
    datasets = {split: make_dataset(config, split) for split in splits}
    for split, dataset in datasets.items():
        dataset.prepare(args.workers)
        print(f"{split}: {len(dataset)} frames")
    for transform in make_transforms(config, training=True):
        transform.prepare(datasets[config.splits.train], args.workers)
    return 0
