"""Products of many rows with small matrices, by either library."""

import threading

import pytest
import torch

from lidarfw.ops import product

CHANNELS = [(4, 16), (32, 32), (32, 64), (64, 64), (64, 128), (128, 256)]


@pytest.fixture(params=["mkl", "onednn"])
def library(request, monkeypatch):
    if request.param == "onednn" and not hasattr(torch.backends.mkldnn, "matmul"):
        pytest.skip("this torch does not let float32 products be computed by oneDNN")
    monkeypatch.setattr(product, "_onednn_is_faster", lambda: request.param == "onednn")
    return request.param


def operands(rows: int, inputs: int = 64, outputs: int = 64, slack: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(rows)
    buffer = torch.full((rows + slack, inputs), torch.nan)
    buffer[:rows] = torch.randn(rows, inputs, generator=random)
    return buffer, torch.randn(inputs, outputs, generator=random)


def multiplied(rows: torch.Tensor, sizes: tuple[int, ...], weights: list[torch.Tensor]) -> torch.Tensor:
    out = torch.full((len(rows), weights[0].shape[1]), torch.nan, dtype=rows.dtype)
    product.multiply(rows, sizes, weights, out)
    return out[: sum(sizes)]


@pytest.mark.parametrize("sizes", [(0,), (1,), (511, 1), (512,), (513, 0, 700), (4096, 5), (9000, 300)])
@pytest.mark.parametrize("channels", CHANNELS)
def test_groups_are_multiplied_whatever_lies_behind_the_rows(library, sizes, channels) -> None:
    rows, weight = operands(sum(sizes), *channels, slack=product.SLACK)
    weights = [weight * (number + 1) for number in range(len(sizes))]
    expected = [own.double() @ w.double() for own, w in zip(rows[: sum(sizes)].split(sizes), weights, strict=True)]
    result = multiplied(rows, sizes, weights)
    torch.testing.assert_close(result.double(), torch.cat(expected), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("rows", [0, 1, 512, 700, 9000])
@pytest.mark.parametrize("channels", CHANNELS)
def test_a_product_is_added(library, rows, channels) -> None:
    matrix, weight = operands(rows, *channels)
    out = torch.ones(rows, channels[1])
    product.add_product(matrix, weight, out)
    torch.testing.assert_close(out.double(), 1 + matrix.double() @ weight.double(), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("sizes", [(), (0,), (1,), (512, 3), (700, 0, 513), (9000,)])
@pytest.mark.parametrize("channels", CHANNELS)
def test_transposed_products_of_groups_are_added(library, sizes, channels) -> None:
    rows, _ = operands(sum(sizes), channels[0])
    others = operands(sum(sizes) + 1, channels[1])[0][: sum(sizes)]
    outs = [torch.ones(channels) for _ in sizes]
    product.add_transposed_product(rows, others, sizes, outs)
    for own, other, out in zip(rows.split(sizes), others.split(sizes), outs, strict=True):
        expected = 1 + own.t().double() @ other.double()
        torch.testing.assert_close(out.double(), expected, rtol=1e-4, atol=1e-3)


def test_a_row_does_not_depend_on_the_others_nor_on_the_threads(library) -> None:
    rows, weight = operands(5000, slack=product.SLACK)
    threads, results, sums = torch.get_num_threads(), [], []
    try:
        for count, size in ((1, 5000), (2, 5000), (1, 300), (2, 300)):
            torch.set_num_threads(count)
            results.append(multiplied(rows, (size,), [weight]))
            sums.append(torch.ones(size, 64))
            product.add_product(rows[:size], weight, sums[-1])
    finally:
        torch.set_num_threads(threads)
    for several in (results, sums):
        assert torch.equal(several[0], several[1])
        assert all(torch.equal(one[:300], several[0][:300]) for one in several)


def test_float64_is_computed_in_float64(library) -> None:
    rows, weight = (matrix.double() for matrix in operands(300, slack=product.SLACK))
    torch.testing.assert_close(multiplied(rows, (300,), [weight]), rows[:300] @ weight)


@pytest.mark.skipif(not hasattr(torch.backends.mkldnn, "matmul"), reason="this torch has no such setting")
@pytest.mark.parametrize("setting", ["none", "ieee", "tf32"])
def test_the_setting_of_the_process_is_restored(setting, monkeypatch) -> None:
    monkeypatch.setattr(product, "_onednn_is_faster", lambda: True)
    matmul, rows = torch.backends.mkldnn.matmul, operands(600, slack=product.SLACK)
    matmul.fp32_precision = setting
    try:
        workers = [threading.Thread(target=multiplied, args=(rows[0], (600,), [rows[1]])) for _ in range(8)]
        for worker in workers:
            worker.start()
        for worker in workers:
            worker.join()
        with pytest.raises(RuntimeError):
            product.multiply(rows[0], (600,), [rows[1].double()], torch.empty(1112, 64))
        assert matmul.fp32_precision == setting
    finally:
        matmul.fp32_precision = "none"


@pytest.mark.skipif(not hasattr(torch.backends.mkldnn, "matmul"), reason="this torch has no such setting")
def test_a_processor_that_drops_bits_is_noticed(monkeypatch) -> None:
    if not product._onednn_is_exact():
        pytest.skip("this processor drops bits")
    exact = torch.Tensor.__matmul__
    rounded = lambda a, b: exact(a, b) if not a.is_floating_point() else exact(a.bfloat16().float(), b)  # noqa: E731
    monkeypatch.setattr(torch.Tensor, "__matmul__", rounded)
    assert not product._onednn_is_exact()
