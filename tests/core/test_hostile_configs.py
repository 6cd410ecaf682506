"""A config from a stranger must not be able to call a function."""

import pickle

import pytest

from lidarfw.config import check_target, compose, instantiate
from lidarfw.errors import ConfigError

PAYLOADS = [
    {"_target_": "os.system", "command": "touch {mark}"},
    {"_target_": "logging.os.system", "command": "touch {mark}"},
    {"_target_": "subprocess.Popen", "args": ["touch", "{mark}"]},
    {"_target_": "subprocess.run", "args": ["touch", "{mark}"]},
    {"_target_": "builtins.eval", "_args_": ["open('{mark}', 'w')"]},
    {"_target_": "builtins.exec", "_args_": ["open('{mark}', 'w')"]},
    {"_target_": "builtins.open", "file": "{mark}", "mode": "w"},
    {"_target_": "pickle.loads", "data": "{pickle}"},
    {"_target_": "torch.load", "f": "{pickled_file}", "weights_only": False},
    {"_target_": "numpy.load", "file": "{pickled_file}", "allow_pickle": True},
    {"_target_": "shutil.rmtree", "path": "{folder}"},
    {"_target_": "runpy.run_path", "path_name": "{script}"},
    {"_target_": "importlib.import_module", "name": "{script}"},
    {"_target_": "pathlib.Path.write_text", "self": "{mark}", "data": "x"},
    {"_target_": "pip._internal.cli.main.main", "args": ["install", "nothing"]},
    {"_target_": "timeit.timeit", "stmt": "open('{mark}', 'w')"},
    {"_target_": "torch.hub.load", "repo_or_dir": "{folder}", "model": "x", "source": "local"},
    {"_target_": "torch.utils.cpp_extension.load_inline", "name": "x", "cpp_sources": ""},
    {"_target_": "lightning.fabric.utilities.cloud_io._load", "path_or_url": "{pickled_file}", "weights_only": False},
    {"_target_": "lightning.pytorch.core.saving.os.system", "command": "touch {mark}"},
    {"_target_": "torch.optim.optimizer.torch.load", "f": "{pickled_file}", "weights_only": False},
    {"_target_": "lidarfw.checkpoint.load", "path": "{pickled_file}"},
    {"_target_": "torch.optim.AdamW.__init__.__globals__.__class__"},
    {"_target_": ["os", "system"]},
]


class Bomb:
    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return open, (self.mark, "w")


@pytest.fixture
def place(tmp_path):
    mark = tmp_path / "mark"
    (tmp_path / "script.py").write_text(f"open({str(mark)!r}, 'w')")
    (tmp_path / "bomb.pkl").write_bytes(pickle.dumps(Bomb(mark)))
    return {"mark": mark, "folder": tmp_path, "script": tmp_path / "script.py", "pickled_file": tmp_path / "bomb.pkl",
            "pickle": "x"}  # fmt: skip


def filled(node, place):
    if isinstance(node, str):
        return node.format(**place) if "{" in node else node
    if isinstance(node, dict):
        return {key: filled(value, place) for key, value in node.items()}
    return [filled(value, place) for value in node] if isinstance(node, list) else node


@pytest.mark.parametrize("payload", PAYLOADS, ids=lambda p: str(p["_target_"]))
@pytest.mark.parametrize("nested", [False, True])
def test_no_payload_runs(payload, nested, place):
    node = filled(payload, place)
    if nested:
        node = {"_target_": "lightning.pytorch.callbacks.ModelCheckpoint", "dirpath": {"deep": [node]}}
    with pytest.raises(ConfigError, match=r"not allowed in a config|cannot be found"):
        instantiate(node)
    assert not place["mark"].exists()
    assert place["script"].exists()


def test_what_a_config_may_build():
    classes = ["callbacks.EarlyStopping", "loggers.CSVLogger", "Trainer"]
    optimizers = ["torch.optim.AdamW", "torch.optim.lr_scheduler.OneCycleLR"]
    for target in (*optimizers, *(f"lightning.pytorch.{name}" for name in classes)):
        check_target(target)
    with pytest.raises(ConfigError, match="cannot be found"):
        check_target("torch.optim.AdamV")


def test_hydra_callbacks_are_checked_too(tmp_path):
    (tmp_path / "experiment").mkdir()
    mark = tmp_path / "mark"
    text = f"# @package _global_\nhydra: {{callbacks: {{x: {{_target_: os.system, command: 'touch {mark}'}}}}}}\n"
    (tmp_path / "experiment/evil.yaml").write_text(text)
    with pytest.raises(ConfigError, match="not allowed in a config"):
        compose([f"--config-dir={tmp_path}", "experiment=evil"])
    assert not mark.exists()


@pytest.mark.parametrize("text", ["!!python/object/apply:os.system ['touch {mark}']", "a: !!python/name:os.system"])
def test_yaml_tags_are_refused(tmp_path, text):
    (tmp_path / "experiment").mkdir()
    mark = tmp_path / "mark"
    (tmp_path / "experiment/evil.yaml").write_text(text.format(mark=mark))
    with pytest.raises(ConfigError, match=r"evil\.yaml|could not determine a constructor"):
        compose([f"--config-dir={tmp_path}", "experiment=evil"])
    assert not mark.exists()
