"""The paper's recipe as the configs give it, and the figures that it is judged by."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from lidarfw.components.metrics.nuscenes_detection import average_precision
from lidarfw.config import compose, to_plain


@pytest.mark.parametrize("experiment", ["msrm_kitti", "msrm_custom"])
def test_one_cycle_of_the_paper(experiment: str) -> None:
    config = to_plain(compose([f"experiment={experiment}"]))
    node = {key: value for key, value in config["optimizer"].items() if key != "groups"}
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = instantiate(node)([weight])
    schedule = instantiate(config["scheduler"] | {"max_lr": optimizer.param_groups[0]["lr"], "total_steps": 101})(
        optimizer
    )
    rate, momentum = [], []
    for _ in range(101):
        rate.append(optimizer.param_groups[0]["lr"])
        momentum.append(optimizer.param_groups[0]["betas"][0])
        optimizer.step()
        schedule.step() if len(rate) < 101 else None
    peak = int(np.argmax(rate))
    assert peak in (39, 40)
    assert [rate[0], rate[peak], rate[-1]] == pytest.approx([1e-3, 1e-2, 1e-7], rel=1e-3)
    assert [momentum[0], momentum[peak], momentum[-1]] == pytest.approx([0.95, 0.85, 0.95], abs=1e-3)
    assert optimizer.param_groups[0]["weight_decay"] == 0.01
    assert config["trainer"]["gradient_clip_val"] == 10


def test_constant_precision_of_nuscenes() -> None:
    assert average_precision(np.full(101, 0.55)) == pytest.approx(0.5)
