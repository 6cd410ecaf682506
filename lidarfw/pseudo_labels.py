"""Pseudo-labels: a detector labels the scans that nobody has labelled, learns from them, and does so again.

Source: the loop for custom data of "Three-Dimensional Object Detection in Point Clouds with Multi-Stage Proposal
Refinement Network", section III-B: train on the labelled frames, predict the others, keep what is confident (0.7 for
cars, 0.5 for pedestrians and cyclists), train on both, repeat. What the paper does not say: boxes of middling
confidence are neither objects nor background, and frames without a confident box are left out.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig, open_dict

from lidarfw import checkpoint, config
from lidarfw.assembly import make_dataset, make_transforms, plan
from lidarfw.components.datasets.folder import FolderDataset
from lidarfw.components.per_class import per_class
from lidarfw.data import make_ready
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import write_text
from lidarfw.model import PerceptionModel
from lidarfw.predict import predict_frames
from lidarfw.training import evaluate, train
from lidarfw.types import Boxes, Frame, Targets

CONFIDENT = {"Car": 0.7, "Pedestrian": 0.5, "Cyclist": 0.5}  # section III-B
USUAL = 0.5  # of other classes
MIDDLING = 0.3
SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Settings:
    """What the loop does: overrides of `lidarfw train` whose dataset is a folder, and the scores of pseudo-labels."""

    overrides: tuple[str, ...]
    start: str | None = None  # checkpoint that the first round begins with
    confident: Mapping[str, float] = field(default_factory=dict)  # score of a pseudo-label, by class
    middling: float = MIDDLING  # score from which on a box is no background


@dataclass(frozen=True)
class Round:
    """One model: what it learned from, and how good it is."""

    number: int
    frames: int  # with labels of people
    pseudo_frames: int  # with labels of the model before
    kept: dict[str, int]  # pseudo-labels by class
    ignored: int
    figures: dict[str, float]  # on the test split


def split_by_score(boxes: Boxes, confident: Sequence[float], middling: float) -> tuple[Boxes, Boxes]:
    """Boxes to learn from, with a score of at least that of their class; and those from `middling` up to it."""
    limit = boxes.score.new_tensor(list(confident))[boxes.label]
    return boxes[boxes.score >= limit], boxes[(boxes.score < limit) & (boxes.score >= middling)]


class Loop:
    """The rounds in a folder: round_0 learns from the labelled frames, each later one from those and pseudo-labels.

    A frame of the training split is labelled where boxes/NAME.txt stands beside it. What is there already is not made
    again, so an interrupted loop goes on. Every round trains on a folder of its own, ROUND/data, in the layout of
    `dataset=folder`: links to the scans and labels, and the pseudo-labels as files.

    Raises ConfigError where the dataset is no folder with boxes, no frame is labelled or none is not, or validation
    uses training frames.
    """

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.folder, self.settings = folder, settings
        self.config = config.compose(settings.overrides)
        self.name, node = _folder_node(self.config)
        plan(self.config)
        self.classes = tuple(node["classes"])
        self.confident = per_class(self.classes, self._scores(), USUAL, "--keep")
        _check_scores(self.confident, settings.middling)
        self.training = self._dataset("train")
        self.labelled, self.unlabelled = _divide(self.training)
        self.others = {split: self._names(split) for split in SPLITS[1:]}
        self._record()

    def _scores(self) -> dict[str, float]:
        usual = {name: score for name, score in CONFIDENT.items() if name in self.classes}
        return {**usual, **self.settings.confident}

    def _dataset(self, split: str, **changes: Any) -> FolderDataset:
        node = config.to_plain(self.config)["dataset"][self.name]
        found = make_dataset({"dataset": {self.name: node | changes}}, self.config.splits[split])
        assert isinstance(found, FolderDataset)
        return found

    def _names(self, split: str) -> list[str]:
        """Sequences of a split for validation, which must not be trained on."""
        dataset = self._dataset(split)
        whole = dataset.present() if "all" in dataset.split.split("+") else []
        found = [_name(dataset, sequence) for sequence in dict.fromkeys([*dataset.named, *whole])]
        shared = sorted(set(found) & set(self.labelled) | set(found) & set(self.unlabelled))
        if shared:
            raise ConfigError(
                f"splits.{split} has sequences that are trained on: {', '.join(shared[:5])}\n"
                "  a model would be judged by what it made up itself\n"
                f"  fix: list some labelled sequences in {self.training.root}/val.txt, the others in train.txt"
            )
        return found

    def _record(self) -> None:
        """Write the settings, or compare them with those that the folder was made with."""
        path, ours = self.folder / "settings.json", json.loads(json.dumps(asdict(self.settings)))
        if path.is_file():
            theirs = json.loads(path.read_text(encoding="utf-8"))
            if not (self.folder / "round_1" / "data").is_dir():  # no pseudo-label was made yet
                theirs |= {key: ours[key] for key in ("confident", "middling")}
            changed = [
                f"  {key}: {theirs.get(key)} there, {ours[key]} here" for key in ours if ours[key] != theirs.get(key)
            ]
            if changed:
                raise ConfigError(
                    f"{self.folder} was begun with other settings\n" + "\n".join(changed) + "\n  fix: another folder"
                )
        else:
            write_text(path, json.dumps(ours, indent=1) + "\n")

    def run(self, rounds: int) -> Iterator[Round]:
        """The first model and `rounds` more, as they are ready."""
        for number in range(rounds + 1):
            yield self._round(number)

    def _round(self, number: int) -> Round:
        place = self.folder / f"round_{number}"
        done = place / "round.json"
        if not done.is_file():
            counts = self._data(number, place)
            train(self._config(number, place))
            found = Round(number, **counts, figures=evaluate(place / "checkpoints" / "last.ckpt"))
            write_text(done, json.dumps(asdict(found), indent=1) + "\n")
        return Round(**json.loads(done.read_text(encoding="utf-8")))

    def _config(self, number: int, place: Path) -> DictConfig:
        """The config of a round's training: its data, its folder, the weights of the round before."""
        made = self.config.copy()
        before = self.settings.start if number == 0 else str(_last(self.folder / f"round_{number - 1}"))
        with open_dict(made):
            made.run_dir, made.resume = str(place), "auto"
            made.dataset[self.name].root = str((place / "data").resolve())
            made.splits = {split: split for split in SPLITS}
            if before is not None:
                made.init = {"from": before}
        return made

    # data

    def _data(self, number: int, place: Path) -> dict[str, Any]:
        """Make ROUND/data; how many frames and boxes there are."""
        counts = place / "data" / "counts.json"
        if not counts.is_file():
            temporary = place / f".{uuid.uuid4().hex}"
            try:
                found = self._write_data(temporary, self._pseudo(number) if number else iter(()))
                write_text(temporary / "counts.json", json.dumps(found) + "\n")
                os.replace(temporary, place / "data")
            except OSError as error:
                raise DataError(f"cannot write {place / 'data'}: {error.strerror or error}") from error
            finally:
                shutil.rmtree(temporary, ignore_errors=True)
        read: dict[str, Any] = json.loads(counts.read_text(encoding="utf-8"))
        return read

    def _write_data(self, root: Path, pseudo: Iterable[tuple[str, Path, Boxes, Boxes]]) -> dict[str, Any]:
        for sequence, scans in self.labelled.items():
            for scan in scans:
                _link(scan, root / sequence / "points" / scan.name)
                label = self.training.beside(scan, "boxes")
                _link(label, root / sequence / "boxes" / label.name)
        kept, frames, ignored = Counter[str](), 0, 0
        for sequence, scan, sure, unsure in pseudo:
            _link(scan, root / sequence / "points" / scan.name)
            for kind, boxes in (("boxes", sure), ("ignored", unsure)):
                write_text(root / sequence / kind / f"{scan.stem}.txt", box_lines(boxes, self.classes))
            kept.update(self.classes[label] for label in sure.label.tolist())
            frames, ignored = frames + 1, ignored + len(unsure)
        write_text(root / "train.txt", "\n".join(sorted(p.name for p in root.iterdir() if p.is_dir())) + "\n")
        self._link_others(root)
        people = sum(map(len, self.labelled.values()))
        return {"frames": people, "pseudo_frames": frames, "kept": dict(kept), "ignored": ignored}

    def _link_others(self, root: Path) -> None:
        """The sequences of the other splits as they are."""
        for split, names in self.others.items():
            write_text(root / f"{split}.txt", "\n".join(names) + "\n")
            for name in names:
                if not (root / name).exists():
                    (root / name).symlink_to((self.training.folder / name).resolve(), target_is_directory=True)

    def _pseudo(self, number: int) -> Iterator[tuple[str, Path, Boxes, Boxes]]:
        """Sequence, scan, boxes to learn from and boxes to ignore, of the frames with a box to learn from."""
        import torch

        device = "cuda" if torch.cuda.is_available() else "cpu"
        model = checkpoint.load(_last(self.folder / f"round_{number - 1}")).to(device).eval()
        places = [(sequence, scan) for sequence, scans in self.unlabelled.items() for scan in scans]
        results = predict_frames(model, self._frames(model, {scan for _, scan in places}))
        found, best = 0, [0.0] * len(self.classes)
        for (sequence, scan), result in zip(places, _with_progress(results, len(places), number), strict=True):
            boxes = result.of(Boxes)
            sure, unsure = split_by_score(boxes, self.confident, self.settings.middling)
            best = [max(b, *boxes.score[boxes.label == label].tolist(), 0.0) for label, b in enumerate(best)]
            if len(sure):
                found += 1
                yield sequence, scan, sure, unsure
        if not found:
            raise DataError(self._nothing(number, len(places), best))

    def _nothing(self, number: int, scans: int, best: Sequence[float]) -> str:
        scores = ", ".join(
            f"{n} {b:.2f} of {c:.2f}" for n, b, c in zip(self.classes, best, self.confident, strict=True)
        )
        return (
            f"round {number}: no box of {scans} scans without labels is sure enough to learn from\n"
            f"  highest scores: {scores}\n"
            f"  fix: a longer training in another folder, or a lower --keep {self.classes[0]}=..."
        )

    def _frames(self, model: PerceptionModel, chosen: set[Path]) -> Iterator[Frame]:
        """The frames of these scans as the model takes them."""
        dataset, transforms = self._dataset("train", boxes=False), make_transforms(model.plan.config, training=False)
        make_ready(dataset, transforms)
        for index in range(len(dataset)):
            if Path(dataset.meta(index).path) in chosen:
                frame = dataset[index].replace(targets=Targets())
                for change in transforms:
                    frame = change(frame, np.random.default_rng(0))
                yield frame


def _folder_node(cfg: DictConfig) -> tuple[str, dict[str, Any]]:
    """Name and options of the dataset; ConfigError where pseudo-labels of it cannot be written."""
    nodes: dict[str, dict[str, Any]] = config.to_plain(cfg)["dataset"] or {}
    name, node = next(iter(nodes.items()), ("", dict[str, Any]()))
    if len(nodes) != 1 or node.get("type", name) != "folder" or not node.get("boxes"):
        raise ConfigError(
            f"pseudo-labels are made for a folder of scans some of which have boxes, the dataset is {name or 'none'}\n"
            "  fix: dataset=folder dataset.folder.root=/scans dataset.folder.boxes=true dataset.folder.classes=[Car]"
        )
    more = [key for key in ("tracks", "labels", "poses", "pose") if node.get(key)] + ["sweeps"] * (node["sweeps"] > 1)
    if more:
        raise ConfigError(
            f"pseudo-labels are boxes of single scans, and dataset.{name} asks for {', '.join(more)}\n"
            f"  fix: {' '.join(f'dataset.{name}.{key}=' + ('1' if key == 'sweeps' else 'false') for key in more)}"
        )
    return name, node


def _name(dataset: FolderDataset, sequence: str) -> str:
    """A sequence as its drive is called: a root that holds scans itself is the sequence "."."""
    return dataset.folder.resolve().name if sequence == "." else sequence


def _check_scores(confident: Sequence[float], middling: float) -> None:
    if not 0 <= middling <= min(confident, default=1) or max(confident, default=0) > 1:
        raise ConfigError(
            "scores of pseudo-labels are 0..1, and a box is ignored from a lower one on\n"
            f"  given: --keep {', '.join(map(str, confident))}, --ignore {middling}\n"
            "  fix: for example --keep Car=0.7 Pedestrian=0.5 --ignore 0.3"
        )


def _divide(dataset: FolderDataset) -> tuple[dict[str, list[Path]], dict[str, list[Path]]]:
    """The scans with a file of boxes beside them, and those without, by sequence."""
    labelled, unlabelled = dict[str, list[Path]](), dict[str, list[Path]]()
    for drive in dataset.drives:
        for scan in drive.scans:
            group = labelled if dataset.beside(scan, "boxes").is_file() else unlabelled
            group.setdefault(drive.name, []).append(scan)
    for group, what in ((labelled, "has"), (unlabelled, "lacks")):
        if not group:
            raise ConfigError(
                f"{dataset.folder}: no scan of the split {dataset.split!r} {what} a file of boxes, "
                "pseudo-labels need some of both\n"
                "  a scan is labelled where boxes/NAME.txt stands beside it; an empty file says no objects\n"
                "  fix: label a few scans, or train as usual: lidarfw train"
            )
    return labelled, unlabelled


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.symlink_to(source.resolve())


def box_lines(boxes: Boxes, classes: Sequence[str]) -> str:
    """Boxes as the folder layout has them: class x y z l w h yaw."""
    rows = zip(boxes.label.tolist(), boxes.tensor.tolist(), strict=True)
    return "".join(f"{classes[label]} {' '.join(f'{value:.4f}' for value in row)}\n" for label, row in rows)


def _last(place: Path) -> Path:
    return place / "checkpoints" / "last.ckpt"


def _with_progress(results: Iterable[Any], total: int, number: int) -> Iterator[Any]:
    from rich.console import Console
    from rich.progress import track

    yield from track(results, f"round {number}: labels", total, console=Console(file=sys.stderr), transient=True)
