"""Checkpoints: what is in them, loading them anywhere, and every way in which they can be broken or hostile."""

import importlib.metadata
import os
import pickle
import random
import resource
import shutil
import signal
import sys
import zipfile
from pathlib import Path

import pytest
import torch
import training_parts
import yaml
from training_runs import Child, settings

import lidarfw
from lidarfw import checkpoint
from lidarfw.checkpoint import AtomicCheckpointIO
from lidarfw.cli import main
from lidarfw.errors import CheckpointError, ConfigError
from lidarfw.training import evaluate, train
from lidarfw.types import Frame, collate


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    from lidarfw import registry

    folder = tmp_path_factory.mktemp("trained")
    with registry.use(**training_parts.SLOTS):
        train(settings(folder, "callbacks=ema", "balance=uncertainty"))
    return folder / "checkpoints/last.ckpt"


@pytest.fixture
def file(trained, tmp_path) -> Path:
    return Path(shutil.copy(trained, tmp_path / "model.ckpt"))


def frame() -> Frame:
    return training_parts.ToyDataset(split="val")[0]


def rewrite(path: Path, change) -> None:
    content = torch.load(path, weights_only=True)
    change(content)
    torch.save(content, path)


def described(path: Path) -> dict:
    return torch.load(path, weights_only=True)["lidarfw"]


# --- what is in them


def test_plain_types_only(trained):
    about = described(trained)
    assert set(about) == {"format", "config", "data_spec", "distributions", "components", "figures"}
    assert about["format"] == 1
    assert about["components"]["head.toy"] == "this program"
    assert about["distributions"] == {"lidarfw": lidarfw.__version__}
    assert about["data_spec"]["classes"] == ["a", "b"]
    assert "width: 8" in about["config"]

    def check(value) -> None:
        assert type(value) in (dict, list, str, int, float, bool, type(None), torch.Tensor), type(value)
        for item in value.items() if isinstance(value, dict) else value if isinstance(value, list) else ():
            for part in item if isinstance(item, tuple) else (item,):
                check(part)

    check(about)


def test_load_gives_the_model_that_was_trained(trained):
    model = lidarfw.load(trained)
    assert not model.training
    state = torch.load(trained, weights_only=True)["state_dict"]
    assert torch.equal(model.state_dict()["backbone.toy.layer.weight"], state["model.backbone.toy.layer.weight"])
    (result,) = model.predict(collate([frame()]))
    assert result.predictions["head.toy"].center.shape == (1, 3)


def test_load_does_not_need_the_dataset(trained, monkeypatch):
    from lidarfw import assembly

    monkeypatch.setattr(assembly, "make_dataset", lambda *a: pytest.fail("the dataset was made"))
    lidarfw.load(trained)


def test_safetensors_and_back(trained, tmp_path):
    checkpoint.export(trained, tmp_path / "model.safetensors")
    one, other = lidarfw.load(trained), lidarfw.load(tmp_path / "model.safetensors")
    assert all(torch.equal(v, other.state_dict()[n]) for n, v in one.state_dict().items())
    assert (tmp_path / "model.safetensors").stat().st_size < trained.stat().st_size


def test_a_cut_safetensors_file(trained, tmp_path):
    path = tmp_path / "model.safetensors"
    checkpoint.export(trained, path)
    path.write_bytes(path.read_bytes()[:-50])
    with pytest.raises(CheckpointError, match=r"model\.safetensors cannot be read"):
        lidarfw.load(path)


# --- damage


@pytest.mark.parametrize("share", [0.0, 0.001, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 0.999])
def test_cut_off(share, file):
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(CheckpointError, match=r"model\.ckpt cannot be read: it is (empty|cut off)") as error:
        lidarfw.load(file)
    assert len(str(error.value).splitlines()) <= 10


def test_the_last_good_one_is_offered(file):
    good = Path(shutil.copy(file, file.parent / "best.ckpt"))
    broken = Path(shutil.copy(file, file.parent / "older.ckpt"))
    broken.write_bytes(b"PK")
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(CheckpointError, match=f"the last good one there: {good}"):
        lidarfw.load(file)


@pytest.mark.parametrize("seed", range(10))
def test_a_flipped_bit_is_noticed(seed, file):
    """Bits of the stored data, of which a checksum is kept."""
    rng = random.Random(seed)
    with zipfile.ZipFile(file) as archive:
        entry = max(archive.infolist(), key=lambda info: info.file_size * rng.random())
        data = archive.read(entry)
    raw = bytearray(file.read_bytes())
    place = raw.index(data[:64]) + rng.randrange(len(data))
    raw[place] ^= 1 << rng.randrange(8)
    file.write_bytes(raw)
    with pytest.raises(CheckpointError, match=r"model\.ckpt cannot be read: the checksum of .* is wrong"):
        lidarfw.load(file)


def test_missing_says_what_is_there(file):
    with pytest.raises(CheckpointError, match=r"there is no checkpoint .*other.ckpt\n.*model.ckpt"):
        lidarfw.load(file.parent / "other.ckpt")


def test_a_folder(tmp_path):
    with pytest.raises(CheckpointError, match="it is a folder"):
        lidarfw.load(tmp_path)


def test_an_address_is_not_fetched():
    with pytest.raises(CheckpointError, match="download it first"):
        lidarfw.load("https://example.org/model.ckpt")


# --- foreign and hostile


def test_foreign(tmp_path):
    torch.save({"model_state": {}, "epoch": 3}, tmp_path / "foreign.ckpt")
    with pytest.raises(CheckpointError, match="no key 'lidarfw', it has model_state, epoch"):
        lidarfw.load(tmp_path / "foreign.ckpt")
    torch.save([1, 2], tmp_path / "list.ckpt")
    with pytest.raises(CheckpointError, match="holds a list"):
        lidarfw.load(tmp_path / "list.ckpt")


def test_newer_format(file):
    rewrite(file, lambda content: content["lidarfw"].update(format=2))
    with pytest.raises(CheckpointError, match="has format 2, this lidarfw reads up to 1"):
        lidarfw.load(file)


def test_missing_plugin(file):
    def change(content):
        content["lidarfw"]["distributions"]["lidarfw-absent"] = "0.1.0"
        content["lidarfw"]["components"]["head.absent"] = "lidarfw-absent"

    rewrite(file, change)
    with pytest.raises(CheckpointError) as error:
        lidarfw.load(file)
    assert str(error.value).startswith(
        "this checkpoint uses head 'absent' from lidarfw-absent 0.1.0, which is not installed. "
        "Fix: pip install lidarfw-absent"
    )


def test_other_version_is_one_warning(file, caplog):
    rewrite(file, lambda content: content["lidarfw"]["distributions"].update(torch="1.0"))
    lidarfw.load(file)
    lines = [record.getMessage() for record in caplog.records if "torch" in record.getMessage()]
    assert lines == [f"{file} was written with torch 1.0, installed is {importlib.metadata.version('torch')}"]


def test_other_architecture(file):
    def change(content):
        content["lidarfw"]["config"] = content["lidarfw"]["config"].replace("width: 8", "width: 16")

    rewrite(file, change)
    with pytest.raises(CheckpointError, match="weights do not fit") as error:
        lidarfw.load(file)
    assert "backbone.toy.layer.weight (8, 4) there, (16, 4) here" in str(error.value)


@pytest.mark.parametrize(
    "change",
    [lambda c: c["state_dict"].pop("model.head.toy.center.bias"),
     lambda c: c["state_dict"].update({"model.x": torch.ones(1)}),
     lambda c: c.pop("state_dict"), lambda c: c.update(state_dict=[1]), lambda c: c["lidarfw"].pop("config"),
     lambda c: c["lidarfw"].update(config="[1"), lambda c: c["lidarfw"].update(config="3"),
     lambda c: c["lidarfw"].update(data_spec={"inputs": 3}), lambda c: c["lidarfw"].update(format="x"),
     lambda c: c["lidarfw"]["data_spec"]["inputs"]["points"].update(kind="Banana"),
     lambda c: c["lidarfw"].update(config=c["lidarfw"]["config"].replace("type: toy", "type: gone"))],
)  # fmt: skip
def test_a_damaged_description_or_state(change, file):
    rewrite(file, change)
    with pytest.raises(CheckpointError, match=r"model\.ckpt"):
        lidarfw.load(file)


def touch(marker: str) -> dict:
    Path(marker).write_text("ran")
    return {}


class Payload:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def name_class(path: Path, name: str) -> None:
    """Let the checkpoint say that its head is of this type."""

    def change(content):
        head = yaml.safe_load(content["lidarfw"]["config"])
        head["head"]["toy"]["type"] = name
        content["lidarfw"]["config"] = yaml.safe_dump(head)

    rewrite(path, change)


@pytest.fixture
def stranger(file, tmp_path, monkeypatch) -> Path:
    """A checkpoint whose head is of a script that says when it is imported."""
    script = (
        "import pathlib, training_parts\npathlib.Path('marker').touch()\nclass Mine(training_parts.ToyHead): pass\n"
    )
    (tmp_path / "stranger.py").write_text(script)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "stranger", raising=False)
    name_class(file, "stranger:Mine")
    return file


def test_a_class_of_no_plugin_is_not_imported(stranger, capsys):
    for refused in (lidarfw.load, evaluate):
        with pytest.raises(CheckpointError, match=r"head\.toy is 'stranger:Mine', of no installed plugin") as error:
            refused(stranger)
        assert "allow_unregistered=True" in str(error.value)
    for command in ("eval", "show", "predict"):
        assert main([command, str(stranger)]) == 2
        assert "of no installed plugin" in capsys.readouterr().err
    assert not Path("marker").exists()


def test_a_class_of_ones_own_is_trusted_on_request(stranger):
    model = lidarfw.load(stranger, allow_unregistered=True)
    assert type(model.component(model.plan.of("head")[0])).__name__ == "Mine"
    assert evaluate(stranger, allow_unregistered=True)["toy/frames"]


def test_a_class_of_a_package_that_registers_others_is_loaded(file):
    name_class(file, "training_parts:ToyHead")
    assert lidarfw.load(file)
    assert evaluate(file)["toy/frames"]
    for name in ("training_parts:SLOTS", "training_parts.__main__:ToyHead", 3):
        name_class(file, name)
        with pytest.raises(CheckpointError, match=r"model\.ckpt"):
            lidarfw.load(file)


@pytest.mark.parametrize(
    "payload",
    [
        lambda marker: Payload(os.system, f"touch {marker}"),
        lambda marker: Payload(eval, f"open({marker!r}, 'w')"),
        lambda marker: Payload(exec, f"open({marker!r}, 'w')"),
        lambda marker: Payload(touch, marker),
        lambda marker: Payload(__import__("subprocess").run, ["touch", marker]),
    ],
    ids=["os.system", "eval", "exec", "own function", "subprocess"],
)
@pytest.mark.parametrize("how", ["load", "resume", "init", "evaluate", "raw pickle"])
def test_a_hostile_pickle_never_runs(payload, how, file, tmp_path, run):
    marker = tmp_path / "marker"
    content = torch.load(file, weights_only=True)
    content["callbacks"] = {"Checkpoints": payload(str(marker))}
    torch.save(content, file)
    if how == "raw pickle":
        file.write_bytes(pickle.dumps(payload(str(marker))))
    ways = {
        "resume": lambda: run(tmp_path / "run", f"resume={file}"),
        "init": lambda: run(tmp_path / "run", f"init={{from: {file}}}"),
        "evaluate": lambda: evaluate(file),
    }
    with pytest.raises(CheckpointError, match=r"model\.ckpt"):
        ways.get(how, lambda: lidarfw.load(file))()
    assert not marker.exists()


# --- writing


def test_a_full_disk_is_noticed_before_writing(file, monkeypatch):
    usage = shutil.disk_usage(file.parent)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=10))
    before = file.read_bytes()
    with pytest.raises(CheckpointError, match=r"needs 0.4 MB, .* has 0.0 MB free") as error:
        AtomicCheckpointIO().save_checkpoint({"x": torch.ones(100000)}, file)
    assert "the one before it is still there" in str(error.value)
    assert file.read_bytes() == before


def write_with_limit(path: Path, limit: int) -> None:
    """As on a disk that is full after `limit` bytes."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    with pytest.raises(CheckpointError, match="could not be written"):
        AtomicCheckpointIO().save_checkpoint({"x": torch.ones(100000)}, path)


@pytest.mark.parametrize("limit", [0, 1000, 200000])
def test_a_disk_that_fills_up_leaves_the_last_good_file(limit, file):
    before = file.read_bytes()
    assert Child(write_with_limit, file, limit).wait() == 0
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


# --- evaluation


def test_evaluate_gives_the_figures_of_the_test_split(trained):
    figures = evaluate(trained)
    assert set(figures) == {"toy/accuracy", "toy/frames"}
    assert figures["toy/frames"] == 12


def test_evaluate_with_other_data_and_settings(trained):
    assert evaluate(trained, ["dataset.toy.frames=5", "loader.batch_size=3"])["toy/frames"] == 5
    assert (
        evaluate(trained, ["dataset=toy", "+loader.extra=1", "~loader.extra", "splits.test=train"])["toy/frames"] == 12
    )
    assert (
        evaluate(trained, ["trainer=cpu", "trainer.limit_test_batches=1", "trainer.enable_progress_bar=false"])[
            "toy/frames"
        ]
        == 2
    )


def test_only_the_split_in_question_is_read(trained, monkeypatch):
    asked = []
    monkeypatch.setattr(training_parts.ToyDataset, "prepare", lambda self, workers=1: asked.append(self.split))
    evaluate(trained, ["splits.test=elsewhere"])
    assert asked == ["elsewhere"]


def test_what_is_tested_is_what_was_validated_on(run, tmp_path):
    run(tmp_path, "trainer.max_epochs=1", "splits.val=elsewhere")
    config = checkpoint.config_of(checkpoint.description(checkpoint.read(tmp_path / "checkpoints/last.ckpt"), ""), "")
    assert config["splits"]["test"] == "elsewhere"


def test_evaluate_does_not_depend_on_the_batch_size(trained):
    assert evaluate(trained, ["loader.batch_size=1"]) == evaluate(trained, ["loader.batch_size=12"])


@pytest.mark.parametrize(
    ("override", "text"),
    [("head.toy.depth=3", "head is part of the model"), ("backbone=toy", "backbone is part of the model"),
     ("optimizer.lr=1", "an evaluation does not train"), ("dataset.toy.frmes=3", "has no 'dataset.toy.frmes'"),
     ("dataset.kitti.root=x", "has no 'dataset.kitti.root'"), ("loader", "cannot read the overrides"),
     ("splits.test=null", "there is no test data"), ("seed=abc", "seed must be a whole number"),
     ("experiment=pillars_kitti", "experiment would set parts of the model"), ("~metric", "~metric has no effect")],
)  # fmt: skip
def test_evaluate_refuses(override, text, trained):
    with pytest.raises(ConfigError, match=text):
        evaluate(trained, [override])


def test_evaluate_on_other_classes(trained):
    with pytest.raises(CheckpointError, match="trained on the classes a, b, this dataset has b, a"):
        evaluate(trained, ["dataset.toy.classes=[b,a]"])
