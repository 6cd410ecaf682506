"""What of a model `torch.export`, tracing and ONNX take, and what they are told of the rest."""

import io

import pytest
import torch
from torch import Tensor, nn

from lidarfw.components.heads.center import CenterHead
from lidarfw.components.necks.bev_fpn import BEVFPN
from lidarfw.errors import LidarfwError
from lidarfw.ops import SparseConv3d, SparseMaxPool3d, SparseModule, SubmanifoldConv3d
from lidarfw.types import BEV, DataSpec, Grid, Spec, Voxels

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")


class Sparse(nn.Module):
    """A sparse layer as a module of tensors."""

    def __init__(self, layer: SparseModule) -> None:
        super().__init__()
        self.layer = layer

    def forward(self, features: Tensor, index: Tensor) -> Tensor:
        return self.layer(Voxels(features, index, Grid((0, 0, 0), (8, 9, 7), (1, 1, 1)), (7, 9, 8))).features


@pytest.mark.parametrize("layer", [SubmanifoldConv3d(3, 4), SparseConv3d(3, 4, 3, 2), SparseMaxPool3d(2)])
@pytest.mark.parametrize(
    "export",
    [
        lambda module, arguments: torch.export.export(module, arguments, strict=False),
        torch.jit.trace,
        lambda module, arguments: torch.onnx.export(module, arguments, io.BytesIO(), dynamo=False),
    ],
    ids=["torch.export", "trace", "onnx"],
)
def test_export_says_what_to_do(layer, export) -> None:
    index = torch.tensor([[0, 1, 1, 1], [0, 1, 1, 2], [0, 4, 5, 6]])
    with pytest.raises(LidarfwError, match="Export the dense part"):
        export(Sparse(layer), (torch.randn(3, 3), index))


class Dense(nn.Module):
    """Neck and head of a detector on a map of 64 x 48 cells, as tensors."""

    grid = Grid((0, -9.6, -3), (25.6, 9.6, 1), (0.4, 0.4, 4))

    def __init__(self) -> None:
        super().__init__()
        self.neck = BEVFPN(Spec(BEV, 8, 1, self.grid), strides=(1, 2), layers=(1, 1), channels=(8, 8), upsampled=(8, 8))
        self.head = CenterHead(self.neck.provides, DataSpec({}, classes=("car", "person")), channels=8)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        output = self.head(self.neck(BEV(features, self.grid)))
        return output.heatmap, output.regression


def test_the_dense_part_is_exported_and_gives_the_same() -> None:
    dense, features, other = Dense().eval(), torch.randn(1, 8, 48, 64), torch.randn(1, 8, 48, 64)
    exported = torch.export.export(dense, (features,), strict=False).module()
    for found, expected in zip(exported(other), dense(other), strict=True):
        torch.testing.assert_close(found, expected)


def test_the_dense_part_is_written_as_onnx() -> None:
    pytest.importorskip("onnx")
    file = io.BytesIO()
    torch.onnx.export(Dense().eval(), (torch.randn(1, 8, 48, 64),), file, dynamo=False)
    assert file.getvalue().count(b"Conv") >= 8
