"""Networks for single pictures: depth, classes, and what hides behind the own vehicle (paper 3.1).

Weights are those of the library `transformers` by name or folder, so nothing is downloaded that was not named: Depth
Anything V2 (Yang et al., NeurIPS 2024) or another of its depth estimators, SegFormer (Xie et al., NeurIPS 2021) or
another of its semantic segmenters. LaMa (Suvorov et al., WACV 2022) is a TorchScript file, as its authors' exporters
write it. They look at the whole stitched panorama; what they say is kept, since they take seconds a picture on a CPU.
"""

from __future__ import annotations

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from lidarfw.errors import ConfigError, DataError
from lidarfw.files import atomic_path
from torch import Tensor, nn
from torch.nn import functional as F

from lidarfw_crossplace.labels import table_of

if TYPE_CHECKING:
    from lidarfw.interfaces import Dataset

    from lidarfw_crossplace.transforms import Panorama

_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet
_DEPTH_HEIGHT = 518  # pixels that Depth Anything was trained at; its patches are 14 pixels wide


def transformers_model(kind: str, name: str, option: str) -> Any:
    """A model of the library transformers in evaluation; ConfigError where it or its weights are missing."""
    try:
        import transformers
    except ImportError as error:
        raise ConfigError(
            f"{option}={name} needs the library transformers, which is not installed\n"
            "  fix: pip install 'lidarfw-crossplace[pretrained]'"
        ) from error
    try:
        return getattr(transformers, kind).from_pretrained(name).eval()
    except (OSError, ValueError) as error:
        raise ConfigError(f"{option}={name}: {str(error).splitlines()[0]}") from error


def _normalised(picture: Tensor, height: int, width: int) -> Tensor:
    """(3, H, W) RGB 0..1 -> (1, 3, height, width) as networks of ImageNet expect it."""
    mean, std = (picture.new_tensor(values)[:, None, None] for values in (_MEAN, _STD))
    return F.interpolate(((picture - mean) / std)[None], (height, width), mode="bicubic", align_corners=False)


class DepthNetwork:
    """Inverse depth of unknown scale and offset of a picture."""

    def __init__(self, name: str) -> None:
        self.model = transformers_model("AutoModelForDepthEstimation", name, "depth_network")
        settings = self.model.config
        backbone = getattr(settings, "backbone_config", None) or settings
        self.patch = int(getattr(backbone, "patch_size", 14))

    @torch.no_grad()
    def __call__(self, picture: Tensor) -> Tensor:
        """(3, H, W) RGB 0..1 -> (H, W), near is large."""
        height, width = picture.shape[1:]
        rows = max(_DEPTH_HEIGHT // self.patch, 1) * self.patch
        columns = max(round(rows * width / height / self.patch), 1) * self.patch
        said = self.model(pixel_values=_normalised(picture, rows, columns)).predicted_depth
        return F.interpolate(said[None], (height, width), mode="bilinear", align_corners=False)[0, 0]


class SemanticNetwork:
    """Unified class of every pixel of a picture, from the names of the network's classes."""

    def __init__(self, name: str) -> None:
        self.model = transformers_model("AutoModelForSemanticSegmentation", name, "semantics_network")
        names = self.model.config.id2label
        self.table = table_of(names[number] for number in range(len(names)))
        if bool((self.table == table_of(["no such class"])).all()):
            raise ConfigError(
                f"semantics_network={name} knows no class of Cityscapes, but {', '.join(list(names.values())[:5])}\n"
                "  fix: one trained on Cityscapes, for example nvidia/segformer-b0-finetuned-cityscapes-1024-1024"
            )

    @torch.no_grad()
    def __call__(self, picture: Tensor) -> Tensor:
        """(3, H, W) RGB 0..1 -> (H, W) uint8."""
        logits = self.model(pixel_values=_normalised(picture, *picture.shape[1:])).logits
        whole = F.interpolate(logits, picture.shape[1:], mode="bilinear", align_corners=False)
        return self.table[whole[0].argmax(0)]


class InpaintingNetwork:
    """A map with a hole filled by LaMa: TorchScript that takes pictures (1, 3, H, W) and masks (1, 1, H, W)."""

    def __init__(self, path: str) -> None:
        try:
            self.model: nn.Module = torch.jit.load(path, map_location="cpu").eval()  # type: ignore[no-untyped-call]
        except (RuntimeError, ValueError, OSError) as error:
            raise ConfigError(f"inpaint_network={path} is no TorchScript file: {str(error).splitlines()[0]}") from error

    @torch.no_grad()
    def __call__(self, values: Tensor, hole: Tensor) -> Tensor:
        """(H, W) of values 0..1; only the hole (H, W) bool changes. Sides are padded to multiples of 8."""
        height, width = values.shape
        pad = (0, -width % 8, 0, -height % 8)
        picture = F.pad(values[None, None], pad, mode="replicate").expand(-1, 3, -1, -1)
        mask = F.pad(hole[None, None].float(), pad)
        filled = self.model(picture, mask)[0].mean(0)[:height, :width].clamp(0, 1)
        return torch.where(hole, filled, values)


@dataclass
class Said:
    """What is kept of the pictures of a frame, in the panorama of the LiDAR (H, W); None for what is not asked."""

    intensity: Tensor | None = None  # 0..1, own vehicle filled
    depth: Tensor | None = None  # 0..1, far = 1, own vehicle filled, before the power
    classes: Tensor | None = None  # unified, uint8

    def save(self, path: Path, settings: str) -> None:
        """Write an .npz file, atomically: numbers as float16."""
        maps = {name: getattr(self, name) for name in ("intensity", "depth", "classes")}
        arrays = {name: value.numpy() for name, value in maps.items() if value is not None}
        arrays = {n: a.astype(np.float16) if a.dtype == np.float32 else a for n, a in arrays.items()}
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, settings=np.array(settings), allow_pickle=False, **arrays)

    @classmethod
    def load(cls, path: Path, settings: str) -> Said:
        """Read what `save` wrote. DataError for a broken file and for one of other settings."""
        arrays = _arrays(path)
        _compare(path, str(arrays.pop("settings", "")), settings)
        floats = {name: torch.from_numpy(array) for name, array in arrays.items()}
        return cls(**{name: value.float() if value.is_floating_point() else value for name, value in floats.items()})


def _arrays(path: Path, only: str = "") -> dict[str, np.ndarray]:
    """The arrays of a file by name, or `only` one, where it is there. DataError for a broken file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files if only in ("", name)}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise DataError(f"{path} is broken: {error}\n  fix: remove it, it is made again") from error


def _compare(path: Path, found: str, expected: str) -> None:
    if found != expected:
        raise DataError(
            f"{path} was made by other networks or for another panorama\n"
            f"  expected: {expected}\n  found: {found or 'nothing about it'}\n"
            "  fix: another folder for transform.panorama.cache, or remove what is in this one"
        )


def kept(path: Path, settings: str) -> bool:
    """Whether an answer is there. DataError for one of other settings, and for a broken one."""
    if not path.is_file():
        return False
    _compare(path, str(_arrays(path, "settings").get("settings", "")), settings)
    return True


def file_of(folder: str, frame: str) -> Path:
    """Where what was said of a frame is kept; names of frames may hold characters that paths must not."""
    safe = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in frame)
    return Path(folder) / f"{safe}_{hashlib.blake2b(frame.encode(), digest_size=4).hexdigest()}.npz"


class Work(torch.utils.data.Dataset[int]):
    """Frames to ask networks about: reading one asks, and keeps the answer in the cache."""

    def __init__(self, transform: Panorama, dataset: Dataset, numbers: list[int]) -> None:
        self.transform, self.dataset, self.numbers = transform, dataset, numbers

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, index: int) -> int:
        torch.set_num_threads(1)  # one frame a core, not every frame on all
        self.transform.said(self.dataset[self.numbers[index]])
        return self.numbers[index]
