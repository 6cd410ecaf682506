"""Runs of the tiny detector, in this process or in forked ones that may be killed."""

import multiprocessing
import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import training_parts
from omegaconf import DictConfig, OmegaConf

from lidarfw.config import compose


def settings(folder: Path, *overrides: str) -> DictConfig:
    """The config of a run that writes into `folder`."""
    config = compose([*training_parts.OVERRIDES, *overrides])
    OmegaConf.set_struct(config, False)
    config.run_dir = str(folder)
    return config


def weights(folder: Path, name: str = "last") -> dict[str, torch.Tensor]:
    return torch.load(folder / "checkpoints" / f"{name}.ckpt", weights_only=True)["state_dict"]


def assert_same_weights(one: Path, other: Path) -> None:
    first, second = weights(one), weights(other)
    assert first.keys() == second.keys()
    different = {n: float((v - second[n]).abs().max()) for n, v in first.items() if not torch.equal(v, second[n])}
    assert not different


class Child:
    """A forked run: its exit code is 0, 1 (any error, printed), or what it exits with."""

    def __init__(self, function: Callable[..., Any], *arguments: Any) -> None:
        self.process = multiprocessing.get_context("fork").Process(target=self._main, args=(function, *arguments))
        self.process.start()

    @staticmethod
    def _main(function: Callable[..., Any], *arguments: Any) -> None:
        try:
            function(*arguments)
        except SystemExit as error:
            os._exit(error.code if isinstance(error.code, int) else 1)
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)

    def signal(self, number: int) -> None:
        assert self.process.pid is not None
        os.kill(self.process.pid, number)

    def wait(self, seconds: float = 60) -> int:
        self.process.join(seconds)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
            pytest.fail(f"the run did not end within {seconds} s")
        code = self.process.exitcode
        assert code is not None
        return code
