"""The datasets of the town: what they make, where, and how often."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lidarfw import cli
from lidarfw.components.datasets.kitti import KittiDataset
from lidarfw.components.transforms.ground_truth_sampling import GroundTruthSampling
from lidarfw.components.transforms.object_database import ObjectDatabase
from lidarfw.errors import ConfigError, DataError
from lidarfw.interfaces import Dataset

from lidarfw_town import generate as generating
from lidarfw_town.datasets import (
    Town360,
    TownDataset,
    TownKitti,
    TownMos,
    TownNuScenes,
    TownOxford,
    TownTracking,
)
from lidarfw_town.generate import drive_of
from lidarfw_town.streets import circuit

ALL = (TownKitti, TownTracking, TownMos, TownNuScenes, Town360, TownOxford)


@pytest.fixture
def cache(tmp_path_factory: pytest.TempPathFactory) -> str:
    """One for all tests, which also use the examples of the conformance kit."""
    return str(tmp_path_factory.getbasetemp() / "town_cache" / "lidarfw" / "town")


@pytest.fixture
def ready(cache: str) -> Callable[..., Any]:
    """A dataset with its files."""

    def made(cls: type[TownDataset], **options: Any) -> Dataset:
        dataset: Dataset = cls(cache=cache, **{**cls.example, **options})
        dataset.prepare()
        return dataset

    return made


@pytest.mark.parametrize("cls", ALL)
def test_files_are_made_once(cls: type[TownDataset], ready: Callable[..., Any]) -> None:
    dataset = ready(cls)
    times = {path: path.stat().st_mtime_ns for path in Path(dataset.root).rglob("*") if path.is_file()}
    assert len(dataset) > 0
    ready(cls)
    assert {path: path.stat().st_mtime_ns for path in times} == times


@pytest.mark.parametrize("cls", ALL)
def test_splits_share_a_folder_that_the_options_name(cls: type[TownDataset]) -> None:
    make: Callable[..., Any] = cls
    roots = {make(split=split).root for split in cls.made}
    assert len(roots) == 1
    assert make(seed=2).root not in roots
    assert make(weather="fog").root not in roots
    assert make(workers=3).root in roots
    with pytest.raises(DataError, match="have the splits train, val"):
        make(split="everything")


def test_objects_of_another_town_are_not_pasted(ready: Callable[..., Any], tmp_path: Path) -> None:
    """A database of objects stands for one town: with another seed it is cut out anew."""
    sampling = GroundTruthSampling(database=str(tmp_path))
    found = []
    for seed in (1, 2):
        sampling.prepare(ready(TownKitti, seed=seed, frames=1, picture_width=0, camera_view=False))
        found.append(ObjectDatabase.load(tmp_path).points)
    assert found[0].tobytes() != found[1].tobytes()


def test_traversals_are_of_one_circuit(ready: Callable[..., Any]) -> None:
    """The second drive of training goes the other way round; the one held out goes as the first one does."""
    train, test = ready(TownOxford), ready(TownOxford, split="test")
    assert train.named == ["2019-01-11-14-02-26", "2019-01-14-12-05-52"]
    assert test.named == ready(TownOxford, split="val").named == ["2019-01-15-13-06-37"]
    first, held = (data.drives[0].poses[0] for data in (train, test))
    assert np.linalg.norm(first[:3, 3] - held[:3, 3]) < 60
    assert first[:2, 0] @ held[:2, 0] > 0.9
    assert [train.job.town(0), train.job.town(1), test.job.town(0)] == [(1000, 0), (1000, 1), (1000, 4)]
    network = drive_of(test.job, 0).world.network
    there, back = (list(itertools.pairwise(circuit(network, reverse, 10))) for reverse in (False, True))
    assert {(b, a) for a, b in there} == set(back)
    assert back[0] == there[0][::-1]
    assert all(len(data[0].targets.boxes) for data in (train, test))


def test_drives_of_the_split_and_their_sweeps(ready: Callable[..., Any]) -> None:
    moving = ready(TownMos, sweeps=2)
    assert moving.named == ["00"]
    assert moving.spec.sweeps == 2
    assert moving.spec.classes == ("static", "moving")
    points = moving[2].inputs["points"]
    assert points.time.unique().tolist() == pytest.approx([-0.1, 0])
    assert len(moving[2].targets.points.label) == len(points)


def test_tracks_last_from_frame_to_frame(ready: Callable[..., Any]) -> None:
    tracking = ready(TownTracking, camera_view=False)
    ids = [set(tracking[n].targets.tracks.id.tolist()) for n in range(len(tracking))]
    assert len(ids) == 3
    assert ids[0] & ids[1] & ids[2]


def test_pictures_come_with_their_truth(ready: Callable[..., Any]) -> None:
    """The spec knows the cameras as they are, before there are files."""
    dataset = ready(Town360, semantics=True, image_scale=0.5)
    frame = dataset[0]
    camera = dataset.spec.inputs["image_02"].geometry
    assert (camera.model, camera.width, camera.height) == ("mei", 50, 50)
    assert camera == dataset.spec.inputs["image_02_depth"].geometry
    for name in ("image_02", "image_02_depth", "image_02_semantics"):
        read = frame.inputs[name].cameras[0]
        assert frame.inputs[name].features.shape[2:] == (50, 50)
        assert read.intrinsics == pytest.approx(camera.intrinsics)
        assert np.array(read.from_sensor) == pytest.approx(np.array(camera.from_sensor), abs=1e-9)
    assert {7, 11, 23} <= set(frame.inputs["image_02_semantics"].features.unique().int().tolist())
    depth = frame.inputs["image_02_depth"].features
    assert 2 < float(depth[depth > 0].median()) < 60


def test_more_drives_than_the_layout_has_are_refused(cache: str) -> None:
    with pytest.raises(ConfigError, match="has 4 drives at most, found 5"):
        TownOxford(cache=cache, drives=5).prepare()
    assert TownMos(drives=9, split="val").job.frames == 60
    assert TownNuScenes(drives=9, length=10, split="val").job.frames == 40


def test_a_cache_that_cannot_be_made_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["prepare", "dataset=town_mos", "dataset.town_mos.cache=/dev/null/c", "--workers", "1"]) == 2
    told = capsys.readouterr().err
    assert "cannot write /dev/null/c" in told
    assert "dataset.NAME.cache" in told


def test_a_truth_that_is_gone_is_told(ready: Callable[..., Any]) -> None:
    dataset = ready(Town360)
    path = min(Path(dataset.root).glob("data_2d_depth/*_0000_sync/image_02/*.png"))
    content = path.read_bytes()
    path.unlink()
    try:
        with pytest.raises(DataError, match=r"data_2d_depth.*cannot be read as a picture"):
            dataset[0]
    finally:
        path.write_bytes(content)


@pytest.mark.parametrize(("workers", "expected"), [("3", 3), ("1", 1)])
def test_prepare_takes_the_workers_of_the_command(
    cache: str, monkeypatch: pytest.MonkeyPatch, workers: str, expected: int
) -> None:
    asked = []
    monkeypatch.setattr(generating, "generate", lambda job, count: asked.append(count))
    monkeypatch.setattr(KittiDataset, "prepare", lambda self, workers=0: None)
    monkeypatch.setattr(KittiDataset, "__len__", lambda self: 0)
    words = ["dataset=town_kitti", f"dataset.town_kitti.cache={cache}", "dataset.town_kitti.workers=2"]
    assert cli.main(["prepare", *words, "--workers", workers]) == 0
    assert set(asked) == {expected}
