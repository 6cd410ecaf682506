"""How the words of a command line are read."""

import pytest

from lidarfw.cli import answered, parse
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


def test_a_command_of_a_plugin_answers_as_these_do(capsys: pytest.CaptureFixture[str]) -> None:
    @answered
    def command(fails: bool) -> None:
        if fails:
            raise ConfigError("key is wrong\n  fix: another")

    assert (command(False), command(fails=True)) == (0, 2)
    assert capsys.readouterr().err == "key is wrong\n  fix: another\n"
