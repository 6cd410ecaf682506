"""The trunk, the heads and their fusion."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from lidarfw.errors import ConfigError
from lidarfw.types import BEV, Camera, Descriptors, FrameMeta, Grid, Image, Spec
from torch import Tensor

from lidarfw_crossplace.backbones import CosPlaceBackbone, CosPlaceBEVBackbone
from lidarfw_crossplace.heads import GeM, LateFusionHead, PlaceBEVHead, PlaceHead

CAMERA = Camera("equirectangular", 64, 32, (10.0, 10.0, 31.5, 15.5))
GRID = Grid((-30.2, -30.2, -3.0), (30.2, 30.2, 3.0), (0.4, 0.4, 6.0))


def picture(count: int = 2, channels: int = 1) -> Image:
    features = torch.rand(count, channels, 32, 64, generator=torch.Generator().manual_seed(0))
    return Image(features, (CAMERA,) * count)


def meta(*modalities: str) -> list[FrameMeta]:
    return [FrameMeta(str(i), modality=name) for i, name in enumerate(modalities)]


@pytest.mark.parametrize(("power", "expected"), [(1.0, 2.5), (3.0, 2.924018), (6.0, 3.269953)])
def test_generalised_mean(power: float, expected: float) -> None:
    assert float(GeM(power)(torch.tensor([1.0, 2, 3, 4]))) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("network", "channels", "stride"), [("small", 128, 16), ("resnet18", 512, 32), ("resnet50", 2048, 32)]
)
def test_sizes(network: str, channels: int, stride: int) -> None:
    backbone = CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network=network).eval()
    assert isinstance(backbone.provides, Spec)
    assert (backbone.provides.channels, backbone.provides.stride) == (channels, stride)
    with torch.no_grad():
        assert backbone(picture()).features.shape == (2, channels, 32 // stride, 64 // stride)


def test_resnet152_has_the_weights_of_the_original() -> None:
    with torch.device("meta"):
        backbone = CosPlaceBackbone(Spec(Image, 3, 1, CAMERA))
    assert sum(p.numel() for p in backbone.parameters()) == 60_192_808 - 2048 * 1000 - 1000  # without the classifier


def test_descriptor_does_not_know_the_sensor() -> None:
    backbone = CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="small").eval()
    head = PlaceHead(backbone.provides, channels=16)  # type: ignore[arg-type]
    maps = backbone(picture())
    camera, lidar = (head.decode(head(maps, meta(name, name))) for name in ("camera", "lidar"))
    assert torch.equal(camera.vector, lidar.vector)
    assert camera.modality == ("camera", "camera")
    assert lidar.modality == ("lidar", "lidar")
    assert camera.vector.norm(dim=1).tolist() == pytest.approx([1, 1])
    names = [name for name, _ in (*backbone.named_parameters(), *head.named_parameters())]
    assert not any("camera" in name or "lidar" in name for name in names)


def test_chunks_give_the_gradient_of_the_whole_batch() -> None:
    torch.manual_seed(0)
    whole, parts = (CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="small", chunk=c).double() for c in (5, 2))
    parts.load_state_dict(whole.state_dict())
    maps = picture(5).map(lambda t: t.double())
    runs = []
    for backbone in (whole.train(), parts.train()):
        features = backbone(maps).features.flatten(1)
        torch.cdist(features, features).square().sum().backward()  # every sample depends on every other
        runs.append([p.grad for p in backbone.parameters()])
    for one, other in zip(*runs, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-12)  # type: ignore[arg-type]


def test_parts_without_a_trained_normalisation_are_pointed_out() -> None:
    torch.manual_seed(0)
    backbone = CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="small", chunk=2).train()
    with pytest.warns(UserWarning, match="pretrained=microsoft/resnet-152"):
        backbone(picture(3, 1))
    trained = CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="small", chunk=0).train()
    trained(picture(3, 1))
    backbone = CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="small", chunk=2).train()
    backbone.load_state_dict(trained.state_dict())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        backbone(picture(3, 1))


def test_weights_of_the_transformers_library_fit() -> None:
    transformers = pytest.importorskip("transformers", reason="needs lidarfw-crossplace[pretrained]")
    from lidarfw_crossplace.backbones import load_pretrained

    for kind, network, hidden in (("basic", "resnet18", [64, 128, 256, 512]), ("bottleneck", "resnet50", None)):
        depths = [2, 2, 2, 2] if kind == "basic" else [3, 4, 6, 3]
        sizes = hidden or [256, 512, 1024, 2048]
        config = transformers.ResNetConfig(layer_type=kind, depths=depths, hidden_sizes=sizes)
        theirs = transformers.ResNetModel(config).eval()
        ours = CosPlaceBackbone(Spec(Image, 3, 1, CAMERA), network=network).eval()
        load_pretrained(ours.trunk, theirs.state_dict())
        maps = picture(1, 3)
        normal = (maps.features - ours.trunk.mean) / ours.trunk.std  # type: ignore[operator]
        with torch.no_grad():
            assert torch.allclose(ours(maps).features, theirs(normal).last_hidden_state, rtol=1e-4, atol=1e-5)


def test_missing_library_and_wrong_network_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "transformers", None)
    with pytest.raises(ConfigError, match=r"pip install 'lidarfw-crossplace\[pretrained\]'"):
        CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="small", pretrained="microsoft/resnet-18")
    with pytest.raises(ConfigError, match="resnet152"):
        CosPlaceBackbone(Spec(Image, 1, 1, CAMERA), network="resnet19")


def bev_descriptor(features: Tensor) -> Tensor:
    torch.manual_seed(0)
    backbone = CosPlaceBEVBackbone(Spec(BEV, 1, 1, GRID)).eval()
    head = PlaceBEVHead(backbone.provides, channels=32)  # type: ignore[arg-type]
    with torch.no_grad():
        return head(backbone(BEV(features, GRID)), meta("lidar")).vector


def test_descriptors_of_maps_do_not_see_the_heading_but_the_arrangement() -> None:
    head = PlaceBEVHead(Spec(BEV, 4, 4, GRID), channels=16, rings=5)
    features = torch.rand(1, 4, 38, 38)
    one, other = (head(BEV(f, GRID, 4), meta("lidar")).vector for f in (features, features.rot90(1, (2, 3))))
    assert torch.allclose(one, other, atol=1e-5)
    moved = head(BEV(features.roll(5, 2), GRID, 4), meta("lidar")).vector
    assert (one - moved).norm() > 1e-3
    # the same things on every ring, but not in the same directions: no mean over rings tells these apart
    ahead, across = torch.zeros(2, 1, 4, 38, 38)
    for row in (9, 28):
        ahead[..., row, 18:20] = 1
        across[..., row, 18:20] = 1
    across[..., 28, 18:20], across[..., 18:20, 28] = 0, 1
    line, corner = (head(BEV(f, GRID, 4), meta("lidar")).vector for f in (ahead, across))
    assert (line - corner).norm() > 0.05


def test_rings_end_at_the_nearest_border() -> None:
    wide = Grid((-32.0, -16.0, -1.0), (32.0, 16.0, 1.0), (1.0, 1.0, 2.0))
    features = torch.zeros(1, 1, 32, 64)
    features[..., :15] = features[..., -15:] = 1  # farther than 16 m along x
    head = PlaceBEVHead(Spec(BEV, 1, 1, wide), channels=8, rings=4, angles=16)
    seen, nothing = (head(BEV(f, wide), meta("lidar")).vector for f in (features, torch.zeros_like(features)))
    assert torch.allclose(seen, nothing, atol=1e-5)
    features[..., 12, 36] = 1
    assert not torch.allclose(head(BEV(features, wide), meta("lidar")).vector, nothing, atol=1e-3)
    with pytest.raises(ConfigError, match="16 angles have 9 frequencies, not 12"):
        PlaceBEVHead(Spec(BEV, 1, 1, wide), angles=16, frequencies=12)


def test_more_rings_than_cells_still_give_numbers() -> None:
    head = PlaceBEVHead(Spec(BEV, 4, 64, GRID), channels=16, rings=40)
    assert head(BEV(torch.zeros(1, 4, 3, 3), GRID, 64), meta("lidar")).vector.isfinite().all()
    assert bev_descriptor(torch.zeros(1, 1, 151, 151)).isfinite().all()


HALF = math.sqrt(0.5)
QUERY = {"i": (1.0, 0.0), "d": (0.0, 1.0), "s": (HALF, HALF)}
SWAPPED = {"i": (0.0, 1.0), "d": (1.0, 0.0), "s": (HALF, HALF)}


def fused(branches: dict[str, tuple[float, float]], **options: object) -> Tensor:
    parts = {name: Descriptors(torch.tensor([values]), ("lidar",)) for name, values in branches.items()}
    head = LateFusionHead({name: Spec(Descriptors, 2) for name in branches}, **options)  # type: ignore[arg-type]
    result = head.decode(head(parts))
    assert result.vector.shape[1] == head.provides.channels  # type: ignore[union-attr]
    return result.vector[0]


def test_fusion_by_concatenation_tells_apart_what_a_sum_does_not() -> None:
    root = math.sqrt(3)
    assert float((fused(QUERY) - fused(SWAPPED)).norm()) * root == pytest.approx(2)
    assert float((fused(QUERY) - fused(QUERY)).norm()) == 0
    assert float((fused(QUERY, fusion="add") - fused(SWAPPED, fusion="add")).norm()) == pytest.approx(0, abs=1e-7)


def test_weights_of_branches_and_branches_left_out() -> None:
    weights = {"i": 2.0, "d": 1.0, "s": 1.0}
    one, other = (fused(branches, fusion="weighted", weights=weights) for branches in (QUERY, SWAPPED))
    assert float((one - other).norm()) == pytest.approx(math.sqrt((4 * 2 + 1 * 2) / 6))
    two = {name: QUERY[name] for name in ("i", "s")}
    assert fused(two).tolist() == pytest.approx([HALF, 0, 0.5, 0.5])
    assert float(fused(QUERY).norm()) == pytest.approx(1)


def test_fusions_that_cannot_be_are_refused() -> None:
    specs = {"i": Spec(Descriptors, 2), "d": Spec(Descriptors, 3)}
    with pytest.raises(ConfigError, match="one length"):
        LateFusionHead(specs, fusion="add")
    with pytest.raises(ConfigError, match="above 0 for i, d"):
        LateFusionHead(specs, fusion="weighted", weights={"i": 1.0})
    with pytest.raises(ConfigError, match="concat, add, weighted"):
        LateFusionHead(specs, fusion="early")
