"""How the words of a command line are read."""

from pathlib import Path

import pytest

from lidarfw import registry
from lidarfw.cli import answered, main, parse
from lidarfw.config import jobs_to_compose
from lidarfw.errors import ConfigError


@pytest.mark.parametrize(
    ("words", "place"),
    [("eval x.ckpt {} --json f {}", "overrides"), ("bench {} --stream 3 --threads 2 {}", "what"),
     ("show {} --debug {}", "overrides"), ("predict x.ckpt {} -o out {} --stream", "scans")],
)  # fmt: skip
def test_overrides_may_stand_behind_options(words, place):
    args = parse(words.format("a=1", "b=2 c=3").split())
    assert getattr(args, place) == ["a=1", "b=2", "c=3"]


@pytest.mark.parametrize("words", ["bench ops --bogus 3", "list head neck", "eval x.ckpt a=1 --threads 3 b=2"])
def test_what_a_command_does_not_know_is_an_error(words, capsys):
    with pytest.raises(SystemExit) as stop:
        parse(words.split())
    assert stop.value.code == 2
    assert "unrecognized arguments: " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["show", "head={center:{type:'os:system'}}"], "head 'os:system' is no class: os:system is a builtin_function"),
        (["show", "head.center.channels=-3"], "head.center: Trying to create tensor with negative dimension"),
        (["train", "-m", "head=[center"], "cannot read the override 'head=[center'"),
        (["train", "-m", "head=centr,cente"], "no head named 'centr'"),
        (["train", "-m", "seed=1,2", "head=center,cente"], "no head named 'cente'"),
        (["train", "hydra.run.dir=FILE/x"], "hydra.run.dir=FILE/x: FILE is no folder"),
        (["new", "acme-lidar", "--slot", "head", "-o", "FILE/acme"], "cannot write FILE/acme: Not a directory"),
        (["new", "lambda", "--slot", "head"], "'lambda' is no name for a distribution"),
    ],
)
def test_a_mistake_gives_a_message(words, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("FILE").touch()
    assert main(words) == 2
    assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["FILE"]


def test_what_of_a_sweep_is_composed_first():
    """Every choice of a group once; what only the sweeper can list, not at all."""
    words = ["-m", "head=anchor,center", "seed=1,2", "neck=glob(b*)", "optimizer.lr=interval(0.1,1)", "name='a,b'"]
    rest = ["seed=1", "name='a,b'"]
    assert list(jobs_to_compose(words)) == [["head=anchor", *rest], ["head=center", *rest]]


def test_a_broken_pyproject_is_pointed_out_and_the_others_work(capsys, tmp_path, monkeypatch, caplog):
    (tmp_path / "pyproject.toml").write_text("[project\n")
    monkeypatch.setattr(registry, "editable_projects", lambda: {"lidarfw-mine": tmp_path})
    broken = f"lidarfw-mine: {tmp_path}/pyproject.toml is no TOML"
    assert main(["list", "head"]) == 0
    assert "center" in capsys.readouterr().out
    assert any(message.startswith(broken) for message in registry.stale_metadata())
    assert main(["show", "head=centre"]) == 2
    assert "did you mean 'center'?" in capsys.readouterr().err
    assert broken in caplog.text
    monkeypatch.chdir(tmp_path)
    assert main(["check"]) == 2
    assert "pyproject.toml is no TOML" in capsys.readouterr().err


def test_a_command_of_a_plugin_answers_as_these_do(capsys: pytest.CaptureFixture[str]) -> None:
    @answered
    def command(fails: bool) -> None:
        if fails:
            raise ConfigError("key is wrong\n  fix: another")

    assert (command(False), command(fails=True)) == (0, 2)
    assert capsys.readouterr().err == "key is wrong\n  fix: another\n"
