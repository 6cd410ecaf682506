"""`lidarfw train`: check the combination at once, then hand over to Hydra and Lightning."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from lidarfw.errors import ConfigError, LidarfwError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of `lidarfw train`: those of Hydra."""
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="OVERRIDE",
        help="GROUP=NAME, GROUP=[A,B], KEY=VALUE; Hydra's own flags work: -m, --cfg job",
    )


def run(args: argparse.Namespace) -> int:
    """Compose, plan (which refuses a wrong combination within a second), then train."""
    from lidarfw import config
    from lidarfw.assembly import plan

    overrides = config.with_config_dirs(args.overrides)
    _check_folder(overrides)
    if {"-m", "--multirun"} & set(overrides):  # the jobs of a sweep are planned one by one
        for job in config.jobs_to_compose(overrides):
            config.compose(job)
    elif not any(argument.startswith("-") for argument in overrides):
        plan(config.compose(overrides))
    config.register()
    return _hydra(overrides)


def _check_folder(overrides: list[str]) -> None:
    """ConfigError where Hydra could not make the folder of the run."""
    for override in overrides:
        key, _, value = override.partition("=")
        there = next((path for path in (Path(value), *Path(value).parents) if path.exists()), Path())
        if key in ("hydra.run.dir", "hydra.sweep.dir") and not there.is_dir():
            raise ConfigError(f"{override}: {there} is no folder.\n  fix: another {key}")


def _hydra(arguments: list[str]) -> int:
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import DictConfig

    argv = sys.argv
    failed: list[LidarfwError] = []

    def task(cfg: DictConfig) -> Any:
        # Lightning starts the other processes of a DDP run from sys.argv: give it back first
        sys.argv = argv
        from lidarfw.training import train

        try:
            return train(cfg)
        except LidarfwError as error:
            if HydraConfig.get().mode == RunMode.MULTIRUN:  # perhaps in another process: only Hydra brings it home
                print(f"{HydraConfig.get().runtime.output_dir}: {error}", file=sys.stderr)
                raise
            failed.append(error)  # Hydra would print a trace
            return None

    sys.argv = [argv[0], *arguments]
    try:
        hydra.main(config_path="pkg://lidarfw.conf", config_name="train", version_base="1.3")(task)()
    finally:
        sys.argv = argv
    if failed:
        raise failed[-1]
    return 0
