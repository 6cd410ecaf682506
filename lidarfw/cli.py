"""The command line, `lidarfw COMMAND`; the commands are those of COMMANDS."""

from __future__ import annotations

import argparse
import functools
import importlib
import os
import sys
import traceback
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import ParamSpec

import lidarfw
from lidarfw.errors import LidarfwError

P = ParamSpec("P")

COMMANDS = {
    "train": "train a model: components and settings as overrides (head=center optimizer.lr=0.01)",
    "eval": "measure a checkpoint on a dataset",
    "predict": "run a checkpoint on scans or images and write results and pictures",
    "track": "follow the boxes of any detector through a sequence and write the official result files",
    "index": "maps of place descriptors: build, search, judge",
    "pseudo-label": "learn from a few labelled scans and many that are not",
    "list": "what is installed, by slot",
    "show": "how components would be wired, and how large the model is",
    "check": "test a plugin or component against the rules of its interface",
    "new": "write a plugin distribution to start from",
    "prepare": "make a dataset ready: indices, databases, generated data",
    "bench": "time a model's components, or the ops",
    "claims": "test what a method is said to gain: runs, intervals, verdicts",
    "completion": "print the shell code that completes names with <TAB>",
}
_MANY = ("overrides", "scans", "what", "data")  # arguments of commands that take any number of words
_EXAMPLES = """examples:
  lidarfw list head
  lidarfw show backbone=second neck=[height_compression,bev_fpn] head=center
  lidarfw train experiment=pillars_kitti dataset.kitti.root=/data/kitti
  lidarfw eval runs/train/.../last.ckpt --json figures.json
  lidarfw predict runs/train/.../last.ckpt scan.bin -o out
"""


def _module(command: str) -> ModuleType:
    return importlib.import_module(f"lidarfw.commands.{command.replace('-', '_')}")


def parser(chosen: str | None = None) -> argparse.ArgumentParser:
    """The parser of all commands; only the arguments of the `chosen` one are filled in."""
    top = argparse.ArgumentParser(
        "lidarfw", description=lidarfw.__doc__, epilog=_EXAMPLES, formatter_class=argparse.RawTextHelpFormatter
    )
    top.add_argument("--version", action="version", version=f"lidarfw {lidarfw.__version__}")
    commands = top.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        command.add_argument("--debug", action="store_true", help="show the trace of an error")
        if name == chosen:
            _module(name).add_arguments(command)
    return top


def parse(arguments: list[str]) -> argparse.Namespace:
    """The arguments of one command. What follows `train` is Hydra's, flags included, in its order."""
    chosen = arguments[0] if arguments else None
    if chosen == "train" and not {"-h", "--help"} & set(arguments):
        rest = [argument for argument in arguments[1:] if argument != "--debug"]
        return argparse.Namespace(command="train", overrides=rest, debug="--debug" in arguments)
    top = parser(chosen)
    args, rest = top.parse_known_args(arguments)
    if rest:
        _add_late(args, rest, top)
    return args


def _add_late(args: argparse.Namespace, rest: list[str], top: argparse.ArgumentParser) -> None:
    """Overrides or scans behind an option, which argparse leaves over once it has given away those before it."""
    many = [name for name in _MANY if isinstance(getattr(args, name, None), list)]
    strange = [argument for argument in rest if argument.startswith("-") or not many]
    if strange:
        top.error(f"unrecognized arguments: {' '.join(strange)}")
    getattr(args, many[0]).extend(rest)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit code is 0, 1 (checks failed) or 2 (the user can mend it)."""
    args = parse(list(sys.argv[1:] if argv is None else argv))
    try:
        return int(_module(args.command).run(args))
    except LidarfwError as error:
        if args.debug or os.environ.get("HYDRA_FULL_ERROR") == "1":
            traceback.print_exc()
        print(error, file=sys.stderr)
        return 2
    except BrokenPipeError:  # `lidarfw list | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def answered(command: Callable[P, int | None]) -> Callable[P, int]:
    """For the `main` of a module that is run by `python -m`: its exit code, 0, or 2 with the message of an error that
    the user can mend."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> int:
        try:
            return command(*args, **kwargs) or 0
        except LidarfwError as error:
            print(error, file=sys.stderr)
            return 2

    return run


def run() -> None:
    """Entry of the console script."""
    sys.exit(main())
