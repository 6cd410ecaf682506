"""From training to a searchable map, by the commands a user types."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import lidarfw
import numpy as np
import pytest
import torch
from lidarfw import config, predict
from lidarfw.assembly import build, plan
from lidarfw.checkpoint import describe
from lidarfw.cli import main
from lidarfw.components.datasets.kitti_360 import Kitti360Dataset
from lidarfw.data import PairOrder
from lidarfw.errors import ConfigError, DataError
from lidarfw.training import evaluate

from lidarfw_crossplace.datasets import BEVPlaceDataset, EitherSensor


def drive(folder: Path, count: int = 48, size: int = 31) -> Path:
    """A round of which the second half is the first once more, with pictures that depend on the place."""
    places = np.arange(count) % (count // 2)
    rng = np.random.default_rng(0)
    scene = rng.integers(0, 255, (count // 2, size, size))
    noise = rng.integers(0, 20, (count, size, size))
    pose = np.tile(np.eye(4)[:3], (count, 1, 1))
    pose[:, 0, 3] = 10.0 * places
    np.savez(folder / "00.npz", bev=(scene[places] * 0.9 + noise).clip(0, 255).astype(np.uint8), pose=pose)
    return folder


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("bev")
    drive(folder)
    options = (
        f"experiment=place_bev dataset.bev_place.root={folder} dataset.bev_place.size=31 hydra.run.dir={folder}/run "
        "backbone.equivariant_bev.turns=4 backbone.equivariant_bev.channels=[2,4] "
        "backbone.equivariant_bev.halve=[true,false] head.place_bev.channels=16 head.place_bev.rings=3 "
        "loader.batch_size=16 trainer.max_epochs=2 metric.recall_at.gap=1 logger=none "
        "trainer.enable_progress_bar=false trainer.accelerator=cpu"
    )
    assert main(["train", *options.split()]) == 0
    return folder, next(folder.glob("run/checkpoints/last*.ckpt"))


def test_place_bev_trains_and_its_map_is_searched(trained: tuple[Path, Path], tmp_path: Path) -> None:
    _folder, checkpoint = trained
    places = tmp_path / "map.npz"
    build = ["index", "build", str(checkpoint), "--split", "val", "-o", str(places)]
    assert main(build) == 0
    assert main([*build, "--add"]) == 0
    assert main(["index", "eval", str(places), str(places), "--json", str(tmp_path / "figures.json")]) == 0
    assert json.loads((tmp_path / "figures.json").read_text())["recall@1_5m"] == 1
    found = tmp_path / "found.json"
    query = ["index", "query", str(places), str(checkpoint), "--split", "val", "-k", "2", "--json", str(found)]
    assert main(query) == 0
    rows = json.loads(found.read_text())
    assert len(rows) == 48
    for number, row in enumerate(rows):
        assert {match["place"] for match in row["matches"]} == {number, number + 48}
        assert row["matches"][0]["distance"] < 1e-3
        assert row["matches"][0]["modality"] == "lidar"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "map.txt", "--split", "val"], "-o map.npz"),
        (["-o", "map.npz"], "scans or --split"),
        (["-o", "map.npz", "--split", "val", "--option", "chunks=3"], "options of retriever 'exact': chunk"),
    ],
)
def test_wrong_commands_are_answered(
    trained: tuple[Path, Path], arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["index", "build", str(trained[1]), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_regions_of_a_drive(tmp_path: Path) -> None:
    drive(tmp_path)
    west, east = (BEVPlaceDataset(root=str(tmp_path), split=f"00:x{sign}100", size=31) for sign in "<>")
    assert len(west) == 20
    assert len(west) + len(east) == 48
    assert max(west.positions()[:, 0]) < 100 <= min(east.positions()[:, 0])
    assert (east.meta(0).index, east.meta(0).time) == (10, 1.0)
    with pytest.raises(ConfigError, match="x<100"):
        len(BEVPlaceDataset(root=str(tmp_path), split="00:z<1", size=31))
    with pytest.raises(DataError, match="found \\(48, 31, 31\\)"):
        len(BEVPlaceDataset(root=str(tmp_path), split="00"))


def test_pairs_are_of_both_sensors_in_half_of_the_cases() -> None:
    frames = EitherSensor(of="synthetic", options={"frames": 4, "image": True})
    assert [frames.meta(i).modality for i in range(4)] == ["camera", "lidar"] * 2
    assert frames[3].meta.id == frames.meta(3).id
    assert [len(run) for run in frames.sequences()] == [8]
    places = np.zeros((2000, 3))
    places[:, 0] = np.arange(2000) // 2  # every place by both sensors
    order = PairOrder(places, 5.0, 2, seed=0)
    first, second = np.array(order.numbers()).reshape(-1, 2).T % 2
    shares = [float(((first == a) & (second == b)).mean()) for a, b in ((0, 0), (1, 1))]
    assert shares == pytest.approx([0.25, 0.25], abs=0.05)
    assert (first != second).mean() == pytest.approx(0.5, abs=0.06)
    with pytest.raises(ConfigError, match="do not fit 'synthetic'"):
        EitherSensor(of="synthetic", options={"colour": 1})
    with pytest.raises(ConfigError, match="name of an installed dataset"):
        EitherSensor(of="this:Data")


def test_one_network_reads_one_map_or_all_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", "experiment=crossplace_town_one"]) == 0
    alone = capsys.readouterr().out
    assert "image <- data.depth" in alone
    assert "data.semantics" not in alone
    early = [
        "transform.panorama.stack=true",
        "transform.panorama.maps=[intensity,depth,semantics]",
        "head.place.channels=384",
    ]
    assert main(["show", "experiment=crossplace_town_one", *early]) == 0
    stacked = capsys.readouterr().out
    assert "Image 5ch" in stacked
    assert "image <- data.panorama" in stacked
    assert "Descriptors 384ch" in stacked
    assert "descriptors <- head.place" in stacked


def test_branches_and_fusions_are_judged_by_one_training(capsys: pytest.CaptureFixture[str]) -> None:
    added = "{type: late_fusion, fusion: add, inputs: {parts: [head.intensity, head.depth, head.semantics]}}"
    for name, width in (("added", 128), ("fused", 384), ("depth", 128)):
        wanted = f"metric.place_recall.inputs.descriptors=head.{name}"
        assert main(["show", "experiment=crossplace_town", f"+head.added={added}", wanted]) == 0
        rows = {row.split()[0]: row for row in capsys.readouterr().out.splitlines() if row}
        assert f"descriptors <- head.{name}" in rows["metric.place_recall"]
        assert f"Descriptors {width}ch" in rows[f"head.{name}"]


@pytest.mark.parametrize("name", ["crossplace_town", "crossplace_town_one"])
def test_another_drive_queries_the_map_of_the_town(name: str) -> None:
    settings = config.compose([f"experiment={name}"])
    for stage in ("val", "test"):
        drives = Kitti360Dataset.splits[settings.splits[stage]]
        assert set(settings.metric.place_recall.map_sequences) < set(drives)


def test_a_branch_is_judged_though_fusion_replaces_it(tmp_path: Path) -> None:
    options = (
        "dataset=either_sensor dataset.either_sensor.of=synthetic +dataset.either_sensor.options={frames:4,image:true} "
        "transform=panorama transform.panorama.maps=[intensity] transform.panorama.cameras=[image] "
        "transform.panorama.height=16 transform.panorama.width=64 backbone=cosplace_small "
        "~neck head=[place_small,late_fusion] head.place.channels=8 +head.late_fusion.inputs={parts:[head.place]} "
        "loss=tsap metric=place_recall +metric.place_recall.inputs={descriptors:head.late_fusion} loader.batch_size=4 "
        f"trainer.max_epochs=1 trainer.accelerator=cpu logger=none hydra.run.dir={tmp_path}"
    )
    assert main(["train", *options.split()]) == 0
    checkpoint = next(tmp_path.glob("checkpoints/last*.ckpt"))
    whole = evaluate(checkpoint)
    alone = evaluate(checkpoint, ["metric.place_recall.inputs.descriptors=head.place"])
    assert alone == pytest.approx(whole)  # fused of this branch alone
    with pytest.raises(ConfigError, match=r"is of the map\n  fix: "):
        evaluate(checkpoint, ["metric.place_recall.map_sequences=[elsewhere]"])
    model = lidarfw.load(checkpoint)
    result = next(iter(predict.predict_frames(model, [predict.SplitFrames(model, "val")[0]])))
    assert list(result.predictions) == ["head.late_fusion"]


def test_a_split_is_described_with_the_classes_of_its_points(tmp_path: Path) -> None:
    options = [
        "dataset=synthetic", "dataset.synthetic.frames=2", "transform=panorama", "transform.panorama.maps=[semantics]",
        "transform.panorama.height=16", "transform.panorama.width=64", "backbone=cosplace_small", "~neck",
        "head=place_small", "loss=tsap", "metric=place_recall",
    ]  # fmt: skip
    wired = plan(config.compose(options))
    weights = {f"model.{name}": value for name, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, tmp_path / "a.ckpt")
    command = ["index", "build", str(tmp_path / "a.ckpt"), "--split", "val", "-o", str(tmp_path / "map.npz")]
    assert main(command) == 0


@pytest.mark.parametrize("part", ["debug=fast", "trainer.limit_val_batches=1"])
def test_a_part_of_a_split_may_lack_the_map(part: str, tmp_path: Path) -> None:
    options = (
        "dataset=either_sensor dataset.either_sensor.of=synthetic +dataset.either_sensor.options={frames:4,image:true} "
        "transform=panorama transform.panorama.maps=[intensity] transform.panorama.cameras=[image] "
        "transform.panorama.height=16 transform.panorama.width=64 backbone=cosplace_small ~neck head=place_small "
        "head.place.channels=8 loss=tsap metric=place_recall metric.place_recall.map_sequences=[later] "
        f"loader.batch_size=4 trainer.max_epochs=1 trainer.accelerator=cpu logger=none hydra.run.dir={tmp_path}"
    )
    assert main(["train", *options.split(), part]) == 0


@pytest.mark.parametrize("name", ["crossplace_kitti360", "crossplace_nclt"])
def test_the_presets_of_the_paper_start_from_pretrained_weights(name: str) -> None:
    backbone = config.compose([f"experiment={name}"]).backbone.cosplace
    assert (backbone.network, backbone.pretrained, backbone.chunk) == ("resnet152", "microsoft/resnet-152", 64)


@pytest.mark.parametrize("name", ["crossplace_kitti360", "crossplace_nclt"])
def test_scans_alone_query_a_map(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = [f"experiment={name}", "backbone=cosplace_small", "head=place_small", "transform.panorama.width=64"]
    options += ["backbone.cosplace.pretrained=''"]
    wired = plan(config.compose(options))
    weights = {f"model.{part}": value for part, value in build(wired).state_dict().items()}
    torch.save({"lidarfw": describe(wired), "state_dict": weights}, tmp_path / "a.ckpt")
    (tmp_path / "scans").mkdir()
    for number in range(3):
        ahead, remission = np.random.default_rng(number).uniform(-20, 20, (500, 3)), np.full((500, 1), 0.5)
        np.save(tmp_path / "scans" / f"{number}.npy", np.hstack([ahead, remission]).astype(np.float32))
    model, scans, place = str(tmp_path / "a.ckpt"), str(tmp_path / "scans"), str(tmp_path / "map.npz")
    assert main(["index", "build", model, scans, "-o", place]) == 0
    assert main(["index", "query", place, model, scans, "-k", "1"]) == 0
    found = [row for row in capsys.readouterr().out.splitlines() if "place " in row]
    assert [row.split(" (")[0] for row in found] == [f"{number}: place {number}" for number in range(3)]


def test_a_checkpoint_needs_no_pretrained_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ["experiment=crossplace_kitti360", "backbone=cosplace_small", "head=place_small"]
    wired = plan(config.compose([*options, "backbone.cosplace.pretrained=''"]))
    weights = {f"model.{part}": value for part, value in build(wired).state_dict().items()}
    about = describe(wired) | {"config": describe(plan(config.compose(options)))["config"]}
    torch.save({"lidarfw": about, "state_dict": weights}, tmp_path / "a.ckpt")
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ConfigError, match="needs the library transformers"):
        build(plan(config.compose(options)))
    assert lidarfw.load(tmp_path / "a.ckpt").backbone["cosplace"].trunk.chunk == 64
