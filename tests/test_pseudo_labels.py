"""Learning from pseudo-labels: what is kept, what is ignored, what a stopped loop does."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from lidarfw import pseudo_labels
from lidarfw.cli import main
from lidarfw.components.datasets.folder import FolderDataset
from lidarfw.pseudo_labels import Loop, Settings, split_by_score
from lidarfw.testing.synthetic import SyntheticDataset
from lidarfw.types import Boxes, Points

CLASSES = ("Car", "Pedestrian", "Cyclist")
SEQUENCES = {"street": (4, 2), "road": (3, 0), "held_out": (3, 3)}  # scans, and how many of them are labelled


def boxes_of(scores: list[float], labels: list[int]) -> Boxes:
    table = torch.tensor([[5.0 * n, 0, 0, 4, 2, 1.5, 0] for n in range(len(scores))]).view(-1, 7)
    return Boxes.from_tensor(table, torch.tensor(labels, dtype=torch.long), torch.tensor(scores))


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three sequences of .npy scans, some labelled."""
    root, data = tmp_path_factory.mktemp("yard"), SyntheticDataset(frames=10, points=2048)
    numbers = iter(range(10))
    for name, (count, labelled) in SEQUENCES.items():
        for kind in ("points", "boxes"):
            (root / name / kind).mkdir(parents=True)
        for place in range(count):
            frame = data[next(numbers)]
            points, boxes = frame.inputs["points"], frame.targets.boxes
            assert isinstance(points, Points)
            assert boxes is not None
            np.save(root / name / "points" / f"{place}.npy", torch.cat([points.xyz, points.features], 1).numpy())
            if place < labelled:
                (root / name / "boxes" / f"{place}.txt").write_text(pseudo_labels.box_lines(boxes, CLASSES))
    (root / "train.txt").write_text("street\nroad\n")
    (root / "val.txt").write_text("held_out\n")
    return root


def overrides(root: Path) -> list[str]:
    return [
        "dataset=folder", f"dataset.folder.root={root}", "dataset.folder.classes=[Car,Pedestrian,Cyclist]",
        "dataset.folder.boxes=true", "head=center_small", "metric=box_ap", "trainer=cpu", "trainer.max_epochs=1",
        "logger=none", "trainer.enable_progress_bar=false", "trainer.enable_model_summary=false",
        "backbone.pillars.cell=[0.8,0.8]", "loader.batch_size=2",
    ]  # fmt: skip


ALL = ("--keep", *(f"{name}=0.02" for name in CLASSES), "--ignore", "0.01")  # an untrained model is not confident


def test_confident_boxes_are_kept_and_middling_ones_ignored() -> None:
    boxes = boxes_of([0.69, 0.70, 0.49, 0.50, 0.35, 0.29], [0, 0, 1, 1, 2, 2])
    kept, ignored = split_by_score(boxes, [0.7, 0.5, 0.5], 0.3)
    assert kept.score.tolist() == pytest.approx([0.70, 0.50])
    assert ignored.score.tolist() == pytest.approx([0.69, 0.49, 0.35])
    assert [len(part) for part in split_by_score(boxes[:0], [0.7, 0.5, 0.5], 0.3)] == [0, 0]


def test_the_loop_learns_from_its_own_labels(scans: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    # the scores of an untrained head are near 0.1, where the nms of the head ends
    command = ["pseudo-label", str(out), *overrides(scans), "postprocessor=nms", "postprocessor.nms.score_threshold=0"]
    assert main([*command, *ALL, "--rounds", "1"]) == 0
    shown = capsys.readouterr().out
    assert "round 1" in shown
    assert "box_ap/mean_3d_ap" in shown

    first, second = (json.loads((out / f"round_{n}" / "round.json").read_text()) for n in (0, 1))
    assert (first["frames"], first["pseudo_frames"]) == (2, 0)
    assert second["frames"] == 2
    assert 0 < second["pseudo_frames"] <= 5
    assert sum(second["kept"].values()) > 0

    learned = FolderDataset(root=str(out / "round_1" / "data"), split="train", classes=CLASSES, boxes=True)
    assert len(learned) == 2 + second["pseudo_frames"]
    frames = [learned[number] for number in range(len(learned))]
    boxes = [frame.targets.boxes for frame in frames if frame.targets.boxes is not None]
    ignored = [frame.targets.ignored for frame in frames if frame.targets.ignored is not None]
    assert len(boxes) == len(ignored) == len(frames)
    assert sum(map(len, ignored)) == second["ignored"]
    human = FolderDataset(root=str(scans), split="street", classes=CLASSES, boxes=True)
    assert human[0].targets.boxes is not None
    labelled = frames[[frame.meta.id for frame in frames].index("street/0")].targets.boxes
    assert labelled is not None
    torch.testing.assert_close(labelled.tensor, human[0].targets.boxes.tensor)

    again = main([*command, *ALL, "--rounds", "1"])
    assert again == 0
    assert capsys.readouterr().out == shown


def test_a_stopped_loop_goes_on(scans: Path, tmp_path: Path, monkeypatch) -> None:
    trained = []

    def once(config):
        trained.append(config.run_dir)
        if len(trained) == 1:
            raise KeyboardInterrupt
        raise SystemExit(143)

    monkeypatch.setattr(pseudo_labels, "train", once)
    settings = Settings(tuple(overrides(scans)))
    with pytest.raises(KeyboardInterrupt):
        list(Loop(tmp_path, settings).run(1))
    written = (tmp_path / "round_0" / "data" / "counts.json").stat().st_mtime_ns
    with pytest.raises(SystemExit):
        list(Loop(tmp_path, settings).run(1))
    assert trained == [str(tmp_path / "round_0")] * 2
    assert (tmp_path / "round_0" / "data" / "counts.json").stat().st_mtime_ns == written
    assert not list((tmp_path / "round_0").glob(".*"))


@pytest.mark.parametrize(
    ("changes", "arguments", "text"),
    [
        (["dataset=synthetic"], [], "folder of scans"),
        (["dataset.folder.boxes=false", "metric=[]"], [], "folder of scans"),
        (["splits.train=held_out", "splits.val=street"], [], "no scan of the split 'held_out' lacks a file of boxes"),
        (["splits.train=road"], [], "no scan of the split 'road' has a file of boxes"),
        (["splits.val=street"], [], "sequences that are trained on: street"),
        (["dataset.folder.poses=true", "dataset.folder.sweeps=2"], [], "asks for poses, sweeps"),
        ([], ["--keep", "Car"], "CLASS=SCORE"),
        ([], ["--keep", "Cra=0.5"], "Did you mean 'Car'"),
        ([], ["--ignore", "0.9"], "0..1"),
        ([], ["--start", "nowhere.ckpt"], "no checkpoint nowhere.ckpt"),
    ],
)
def test_what_cannot_be_is_refused(scans: Path, tmp_path: Path, capsys, changes, arguments, text: str) -> None:
    given = overrides(scans)
    if changes[:1] == ["dataset=synthetic"]:
        given = ["dataset=synthetic", "head=center_small"]
        changes = []
    assert main(["pseudo-label", str(tmp_path / "out"), *given, *changes, *arguments]) == 2
    assert text in capsys.readouterr().err


def test_a_damaged_checkpoint_is_refused_before_the_folder_is_begun(scans: Path, tmp_path: Path, capsys) -> None:
    damaged = tmp_path / "damaged.ckpt"
    damaged.write_text("junk")
    assert main(["pseudo-label", str(tmp_path / "out"), *overrides(scans), "--start", str(damaged)]) == 2
    assert "damaged.ckpt cannot be read" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_file_is_no_folder_for_rounds(scans: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "out").write_text("mine")
    assert main(["pseudo-label", str(tmp_path / "out"), *overrides(scans)]) == 2
    assert "out is a file; the rounds need a folder" in capsys.readouterr().err
    assert (tmp_path / "out").read_text() == "mine"


def test_a_model_that_is_never_sure_says_how_sure_it_was(scans: Path, tmp_path: Path, capsys) -> None:
    command = ["pseudo-label", str(tmp_path), *overrides(scans), "--rounds", "1", "--keep"]
    assert main([*command, "Car=1.0", "Pedestrian=1.0", "Cyclist=1.0"]) == 2
    assert "highest scores: Car 0." in capsys.readouterr().err
    assert (tmp_path / "round_0" / "round.json").is_file()
    # scores may be lowered as long as nothing was learned from them
    lower = Loop(tmp_path, Settings(tuple(overrides(scans)), confident=dict.fromkeys(CLASSES, 0.5)))
    assert lower.confident == [0.5] * 3


def test_other_settings_in_the_same_folder_are_refused(scans: Path, tmp_path: Path) -> None:
    Loop(tmp_path, Settings(tuple(overrides(scans))))
    with pytest.raises(pseudo_labels.ConfigError, match=r"start: None there, a.ckpt here"):
        Loop(tmp_path, Settings(tuple(overrides(scans)), start="a.ckpt"))
    (tmp_path / "round_1" / "data").mkdir(parents=True)
    with pytest.raises(pseudo_labels.ConfigError, match=r"middling: 0.3 there, 0.2 here"):
        Loop(tmp_path, Settings(tuple(overrides(scans)), middling=0.2))


def test_transforms_know_the_dataset_of_the_scans_that_are_labelled(
    scans: Path, tmp_path: Path, told: list[str]
) -> None:
    command = [*overrides(scans), *told, "postprocessor=nms", "postprocessor.nms.score_threshold=0", *ALL]
    assert main(["pseudo-label", str(tmp_path / "out"), *command, "--rounds", "1"]) == 0
