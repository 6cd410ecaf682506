"""Networks for single pictures, small and with random weights, in the transform and in the cache."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lidarfw.draw import write_png
from lidarfw.errors import ConfigError, DataError
from lidarfw.types import Camera, DataSpec, Frame, FrameMeta, Image, Spec, Targets
from torch import Tensor, nn

from lidarfw_crossplace import networks
from lidarfw_crossplace.networks import InpaintingNetwork, Said, file_of
from lidarfw_crossplace.transforms import Panorama

LEFT = ((0.0, -1, 0, 0), (0, 0, -1, 0), (1, 0, 0, 0), (0, 0, 0, 1.0))


def rig() -> tuple[Camera, ...]:
    """Two fisheyes of 190 degrees, one looking ahead and one back."""
    back = ((0.0, 1, 0, 0), (0, 0, -1, 0), (-1, 0, 0, 0), (0, 0, 0, 1.0))
    return tuple(Camera("fisheye", 64, 64, (19.0, 19.0, 31.5, 31.5), (), axes) for axes in (LEFT, back))


class Frames:
    """Three frames of two pictures each."""

    spec = DataSpec(
        {n: Spec(Image, 3, 1, c) for n, c in zip(("image_02", "image_03"), rig(), strict=True)}, frozenset()
    )

    def __len__(self) -> int:
        return 3

    def meta(self, index: int) -> FrameMeta:
        return FrameMeta(f"a/{index}", "a", index, modality="camera")

    def __getitem__(self, index: int) -> Frame:
        draw = torch.Generator().manual_seed(index)
        pictures = [torch.rand(1, 3, 64, 64, generator=draw) for _ in range(2)]
        inputs = {n: Image(p, (c,)) for n, p, c in zip(("image_02", "image_03"), pictures, rig(), strict=True)}
        return Frame(inputs, Targets(), self.meta(index))


class Brightness:
    """Stands in for a network: says how bright a pixel is, and counts how often it is asked."""

    asked = 0

    def __init__(self, _name: str) -> None: ...

    def __call__(self, picture: Tensor) -> Tensor:
        Brightness.asked += 1
        return picture.mean(0)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Panorama:
    monkeypatch.setattr(networks, "DepthNetwork", Brightness)
    monkeypatch.setattr(Brightness, "asked", 0)
    return Panorama(
        maps=("intensity", "depth"), width=64, height=8, depth_network="any", cache=str(tmp_path), sphere=128
    )


def test_what_a_network_said_is_kept_and_not_asked_again(small: Panorama, tmp_path: Path) -> None:
    frames, rng = Frames(), np.random.default_rng(0)
    assert "depth" in small.spec(frames.spec).inputs  # without CAMERA_depth
    first = small(frames[0], rng).inputs["depth"].features
    assert Brightness.asked == 1
    small.prepare(frames)  # type: ignore[arg-type]
    assert Brightness.asked == 3
    assert len(list(tmp_path.glob("*.npz"))) == 3
    assert torch.allclose(small(frames[0], rng).inputs["depth"].features, first, atol=2e-3)
    assert Brightness.asked == 3
    grey = small(frames[0], rng).inputs["intensity"].features
    depth = first ** (1 / 5)
    assert np.corrcoef(grey.flatten().numpy(), -depth.flatten().numpy())[0, 1] > 0.6  # bright said near


def test_files_of_other_settings_and_broken_ones_are_refused(small: Panorama) -> None:
    frames = Frames()
    small.said(frames[0])
    other = Panorama(maps=("depth",), width=32, height=8, depth_network="any", cache=small.cache)
    with pytest.raises(DataError, match="another panorama"):
        other.said(frames[0])
    file_of(small.cache, "a/1").write_bytes(b"PK broken")
    with pytest.raises(DataError, match="is broken"):
        small.said(frames[1])
    assert file_of("x", "a/1") != file_of("x", "a_1")


@pytest.mark.parametrize("change", [
    {"maps": ("depth", "semantics"), "semantics_network": "any"}, {"maps": ("depth",), "semantics_network": "any"},
    {"cameras": ("image_03", "image_02")}, {"fov": 2.0}, {"ego_fill": "zero"}, {"ego_mask": "ego.png"},
    {"sphere": 64}, {"depth_network": "other"},
])  # fmt: skip
def test_what_was_said_for_other_settings_is_never_used(
    small: Panorama, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    mask = np.zeros((8, 64, 3), np.uint8)
    mask[4:, :10] = 255
    write_png(tmp_path / "ego.png", mask)
    monkeypatch.chdir(tmp_path)
    frames = Frames()
    small.prepare(frames)  # type: ignore[arg-type]
    options = {"maps": ("intensity", "depth"), "width": 64, "height": 8, "depth_network": "any", "sphere": 128}
    other = Panorama(**{**options, "cache": small.cache, **change})
    with pytest.raises(DataError, match="another panorama"):
        other(frames[0], np.random.default_rng(0))
    with pytest.raises(DataError, match="another panorama"):
        other.prepare(frames)  # type: ignore[arg-type]


def test_maps_without_a_network_do_not_ask_for_other_answers(small: Panorama) -> None:
    frames = Frames()
    small.prepare(frames)  # type: ignore[arg-type]
    same = Panorama(maps=("depth",), width=64, height=8, depth_network="any", cache=small.cache, sphere=128)
    same.prepare(frames)  # type: ignore[arg-type]
    none = Panorama(maps=("intensity",), width=64, height=8, depth_network="any", cache=small.cache)
    none(frames[0], np.random.default_rng(0))
    assert Brightness.asked == 3


def test_kept_maps_come_back(tmp_path: Path) -> None:
    said = Said(depth=torch.rand(4, 6), classes=torch.arange(24, dtype=torch.uint8).view(4, 6))
    said.save(tmp_path / "a.npz", "x")
    back = Said.load(tmp_path / "a.npz", "x")
    assert back.intensity is None
    assert torch.equal(back.classes, said.classes)
    assert torch.allclose(back.depth, said.depth, atol=1e-3)


def test_lama_fills_the_hole_only(tmp_path: Path) -> None:
    class Fill(nn.Module):
        def forward(self, picture: Tensor, mask: Tensor) -> Tensor:
            known = 1 - mask
            return picture * 0 + (picture * known).sum((2, 3), keepdim=True) / known.sum((2, 3), keepdim=True)

    torch.jit.script(Fill()).save(str(tmp_path / "lama.pt"))
    values, hole = torch.full((6, 10), 0.5), torch.zeros(6, 10, dtype=torch.bool)
    values[2:4, 3:5], hole[2:4, 3:5] = 0.0, True
    assert torch.allclose(InpaintingNetwork(str(tmp_path / "lama.pt"))(values, hole), torch.tensor(0.5))
    with pytest.raises(ConfigError, match="no TorchScript file"):
        InpaintingNetwork(str(tmp_path / "none.pt"))


def test_networks_need_a_cache() -> None:
    with pytest.raises(ConfigError, match=r"transform\.panorama\.cache="):
        Panorama(depth_network="any")


def test_small_networks_of_the_library_say_something_of_every_pixel(tmp_path: Path) -> None:
    transformers = pytest.importorskip("transformers", reason="needs lidarfw-crossplace[pretrained]")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=24, num_hidden_layers=4, num_attention_heads=2, image_size=70, patch_size=14,
        reshape_hidden_states=False, out_features=["stage1", "stage2", "stage3", "stage4"], apply_layernorm=True,
    )  # fmt: skip
    depth = transformers.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=24, neck_hidden_sizes=[4, 8, 12, 16], fusion_hidden_size=8,
        head_hidden_size=8, patch_size=14,
    )  # fmt: skip
    transformers.DepthAnythingForDepthEstimation(depth).save_pretrained(tmp_path / "depth")
    named = {0: "road", 1: "vegetation", 2: "sky"}
    classes = transformers.SegformerConfig(
        hidden_sizes=[8, 8, 16, 16], depths=[1, 1, 1, 1], num_attention_heads=[1, 1, 2, 2], decoder_hidden_size=8,
        id2label=named, label2id={name: number for number, name in named.items()},
    )  # fmt: skip
    transformers.SegformerForSemanticSegmentation(classes).save_pretrained(tmp_path / "classes")
    picture = torch.rand(3, 32, 64)
    inverse = networks.DepthNetwork(str(tmp_path / "depth"))(picture)
    assert inverse.shape == (32, 64)
    assert inverse.isfinite().all()
    said = networks.SemanticNetwork(str(tmp_path / "classes"))(picture)
    assert said.shape == (32, 64)
    assert set(said.unique().tolist()) <= {0, 6, 15}
    with pytest.raises(ConfigError, match="depth_network="):
        networks.DepthNetwork(str(tmp_path / "nothing"))
