"""The product of many rows and a small matrix, by either library."""

import pytest
import torch

from lidarfw.ops import product


@pytest.fixture(params=["mkl", "onednn"])
def library(request, monkeypatch):
    if request.param == "onednn" and not torch.backends.mkldnn.is_available():
        pytest.skip("this torch has no oneDNN")
    monkeypatch.setattr(product, "_onednn_is_faster", lambda: request.param == "onednn")
    return request.param


def operands(rows: int, inputs: int = 64, outputs: int = 64) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(rows)
    buffer = torch.full((product.padded(rows), inputs), torch.nan)
    buffer[:rows] = torch.randn(rows, inputs, generator=random)
    return buffer, torch.randn(inputs, outputs, generator=random)


@pytest.mark.parametrize("rows", [0, 1, 511, 512, 513, 4096, 9000])
@pytest.mark.parametrize("channels", [(4, 16), (32, 64), (64, 64), (64, 128), (128, 256)])
def test_product_equals_that_of_float64_whatever_lies_behind_the_rows(library, rows, channels) -> None:
    buffer, weight = operands(rows, *channels)
    out = torch.full((rows, channels[1]), torch.nan)
    product.multiply(buffer, weight, out)
    expected = buffer[:rows].double() @ weight.double()
    torch.testing.assert_close(out.double(), expected, rtol=1e-5, atol=1e-4)


def test_a_row_does_not_depend_on_the_others_nor_on_the_threads(library) -> None:
    buffer, weight = operands(5000)
    threads, results = torch.get_num_threads(), []
    try:
        for count, size in ((1, 5000), (2, 5000), (1, 300), (2, 300)):
            torch.set_num_threads(count)
            out = torch.empty(size, 64)
            product.multiply(buffer, weight, out)
            results.append(out)
    finally:
        torch.set_num_threads(threads)
    for result in results:
        assert torch.equal(result[:300], results[0][:300])
    assert torch.equal(results[0], results[1])


def test_float64_is_computed_in_float64(library) -> None:
    buffer, weight = (t.double() for t in operands(300))
    out = torch.empty(300, 64, dtype=torch.float64)
    product.multiply(buffer, weight, out)
    torch.testing.assert_close(out, buffer[:300] @ weight)
