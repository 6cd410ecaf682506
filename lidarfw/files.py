"""Files: none half-written under its final name, natural order, and a message where a checkpoint is not there."""

from __future__ import annotations

import os
import re
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lidarfw.errors import CheckpointError, DataError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A temporary path in the same folder, with the same suffix, that becomes `path` when the block ends well.

    Makes the folder. On an exception the temporary file is removed and what stood at `path` stays. DataError
    where the file system refuses (no permission, disk full).
    """
    path = Path(path)
    temporary = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        if temporary.exists():
            temporary.unlink()


def write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def natural(name: str) -> list[tuple[int, str]]:
    """Key of the order in which scan_2 comes before scan_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def require_checkpoint(path: str | Path) -> None:
    """CheckpointError unless something lies at `path`. Commands ask before they import torch, which takes seconds."""
    path = Path(path)
    if "://" in str(path) or str(path).startswith(("http:", "https:", "s3:")):
        raise CheckpointError(f"{path} is an address.\n  fix: download it first, and give the file")
    if not path.exists():
        there = ", ".join(sorted(p.name for p in path.parent.glob("*.ckpt"))) if path.parent.is_dir() else ""
        raise CheckpointError(
            f"there is no checkpoint {path}\n"
            + (f"  in that folder: {there}\n" if there else "")
            + "  fix: `lidarfw train` writes checkpoints/best.ckpt and last.ckpt into the folder of its run"
        )
