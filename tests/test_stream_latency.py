"""`lidarfw bench --stream`: every part has its time, and memory does not grow."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from lidarfw.assembly import build, plan
from lidarfw.cli import main
from lidarfw.config import compose
from lidarfw.stream_latency import measure_stream, simulated_drive

SMALL = [
    "dataset.synthetic.sweeps=3",
    "dataset.synthetic.pose=true",
    "backbone.pillars.channels=8",
    "neck.bev_fpn.layers=[1,1,1]",
    "neck.bev_fpn.channels=[8,8,8]",
    "neck.bev_fpn.upsampled=[8,8,8]",
    "transform=crop",
    "transform.crop.lower=[0,-20,-3]",
    "transform.crop.upper=[40,20,1]",
    "transform.crop.boxes=false",
    "filter=score",
    "tracker=greedy",
]


def test_frames_of_a_simulated_drive() -> None:
    model = build(plan(compose(SMALL)))
    first, second, third = simulated_drive(model, 3)
    sizes = [len(frame.inputs["points"]) for frame in (first, second, third)]
    assert sizes == [sizes[0], 2 * sizes[0], 3 * sizes[0]]
    assert torch.unique(third.inputs["points"].time).tolist() == pytest.approx([-0.2, -0.1, 0.0])
    own, past = (
        third.inputs["points"].xyz[third.inputs["points"].time == t] for t in (0.0, third.inputs["points"].time.min())
    )
    assert torch.allclose((own - past)[:, 0], torch.tensor(1.6), atol=1e-4)  # the sensor moved on by two steps


def test_every_part_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    threads = torch.get_num_threads()
    try:
        code = main(["bench", *SMALL, "--stream", "4", "--threads", "1", "--merge", "--json", str(tmp_path / "s.json")])
    finally:
        torch.set_num_threads(threads)
    assert code == 0
    assert "processor time" in capsys.readouterr().out
    found = json.loads((tmp_path / "s.json").read_text())
    names = ["data", "transform.crop", "backbone.pillars", "neck.bev_fpn", "head.center", "postprocessor.nms"]
    assert list(found["parts"]) == [*names, "filter.score", "tracker.greedy"]
    assert all(0 <= middle <= high for middle, high in found["parts"].values())
    assert sum(middle for middle, _ in found["parts"].values()) <= 1.5 * found["total"][0]
    assert 0 < found["memory"][0] <= found["memory"][1]


def test_what_is_for_training_only_is_left_out() -> None:
    """Also where the options say so: `crop` of boxes is for training."""
    found = measure_stream(
        build(plan(compose([*SMALL, "transform.crop.boxes=true", "transform=[crop,random_flip]"]))), 1
    )
    assert "backbone.pillars" in found.parts
    assert not any(name.startswith("transform") for name in found.parts)


def test_half_precision_runs() -> None:
    found = measure_stream(build(plan(compose(SMALL))), 2, "bf16")
    assert found.precision == "bf16"
    assert found.frames == 2
