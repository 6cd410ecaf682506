"""What is drawn of a model's answers."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import Descriptors, FrameMeta, FrameResult, Image, RangeView, Record

from lidarfw_crossplace import panorama, pictures, raw, scale
from lidarfw_crossplace.pictures import Answers, _descriptors, answers, both_sensors, examples, searched_by

MODALITIES = ("camera", "lidar")


def metas(count: int = 4) -> list[FrameMeta]:
    """A map and a drive that queries it, every frame by both sensors."""
    return [
        FrameMeta(f"{drive}_{i}_{kind}", drive, i, float(i), modality=kind)
        for drive in ("map", "query")
        for i in range(count)
        for kind in MODALITIES
    ]


def inputs(metas: list[FrameMeta]) -> list[dict[str, Record]]:
    """Two maps for each frame."""
    camera = panorama.camera_of(RangeView(4, 32, 0.1, -0.4))
    draw = torch.Generator().manual_seed(0)
    return [
        {
            "depth": Image(torch.rand(1, 1, 4, 32, generator=draw), (camera,)),
            "semantics": Image(torch.rand(1, 3, 4, 32, generator=draw), (camera,)),
        }
        for _ in metas
    ]


def searched() -> Answers:
    """LiDAR queries to pictures: the last finds the place of the first, 30 m off."""
    frames = metas()
    places = torch.tensor([[10.0 * frame.index, 0.0] for frame in frames])
    vectors = torch.nn.functional.one_hot(torch.tensor([frame.index for frame in frames]), 4).float()
    vectors[-1] = vectors[0]
    return answers(vectors, places, searched_by(frames, 0, ["map"], "3d2d"), radius=5)


def test_answers_say_how_far_off_they_are() -> None:
    found = searched()
    assert found.query.tolist() == [9, 11, 13, 15]
    assert found.found.tolist() == [0, 2, 4, 0]
    assert found.true.tolist() == [0, 2, 4, 6]
    assert found.right.tolist() == [True, True, True, False]
    assert found.off.tolist() == [0, 0, 0, 30]
    assert found.distance.tolist() == [0, 0, 0, 0]
    assert found.true_distance.tolist() == pytest.approx([0, 0, 0, 2**0.5])


@pytest.mark.parametrize("rows", [1, 2, 3, 4, 9])
def test_examples_show_as_many_rows_as_there_are(rows: int) -> None:
    frames = metas()
    height = examples(searched(), inputs(frames), frames, rows).shape[0]
    assert height == pytest.approx(min(rows, 4) * examples(searched(), inputs(frames), frames, 1).shape[0], rel=0.1)


def test_both_sensors_are_drawn_where_a_frame_is_there_by_both() -> None:
    frames = metas()
    vectors = torch.eye(len(frames))
    assert both_sensors(vectors, inputs(frames), frames, 2) is not None
    scans = [frame for frame in frames if frame.modality == "lidar"]
    assert both_sensors(vectors[: len(scans)], inputs(scans), scans, 2) is None


def test_one_of_several_heads_is_chosen() -> None:
    both = {f"head.{name}": Descriptors(torch.full((1, 2), value), ()) for name, value in (("a", 1.0), ("b", 2.0))}
    result = FrameResult(metas()[0], both, None, None)
    assert _descriptors(result, "head.b") is both["head.b"]
    for wrong in ("", "head.c"):
        with pytest.raises(ConfigError, match=r"head\.a, head\.b: choose with --head"):
            _descriptors(result, wrong)


def test_commands_say_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "faiss", None)
    for command, arguments in (
        (pictures, [str(tmp_path / "no.ckpt")]), (raw, ["experiment=no_such_thing"]),
        (scale, ["--places", "8", "--queries", "2", "--width", "4", "--retrievers", "hnsw"]),
    ):  # fmt: skip
        assert command.main(arguments) == 2
        assert capsys.readouterr().err
