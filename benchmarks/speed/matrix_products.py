"""The limit of an update's arithmetic: the same matrix products and nothing else, in the time that torch takes for them."""

from collections.abc import Callable, Iterator

import torch as th

from benchmarks.speed.operations import Product, Products

# A batch goes through in pieces of this many rows, as in DenseNetwork, so that operands stay in the cache
_BLOCK_ROWS = 8192


def matrix_products(products: Products) -> Callable[[], None]:
    """
    :param products: shapes, and how many of each
    :return: does them in single precision, with operands that are at hand and results that nobody keeps
    """
    blocks = [block for product, count in products.items() for block in _blocks(product) for _ in range(count)]
    operands = {block: _operands(block) for block in set(blocks)}
    ready = [operands[block] for block in blocks]

    @th.no_grad()
    def multiply() -> None:
        for left, right, result in ready:
            th.mm(left, right, out=result)

    return multiply


def _blocks(product: Product) -> Iterator[Product]:
    """Cut along the batch, which is the one axis that is longer than a block."""
    axis = max(range(3), key=lambda place: product[place])
    for start in range(0, product[axis], _BLOCK_ROWS):
        shape = list(product)
        shape[axis] = min(_BLOCK_ROWS, product[axis] - start)
        yield Product(*shape)


def _operands(block: Product) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    rows, inner, columns = block
    # Sums over the batch are fastest where both matrices have a sample in each row
    left = th.randn(inner, rows).t() if inner > max(rows, columns) else th.randn(rows, inner)
    right = th.randn(inner, columns)
    return left, right, th.empty(rows, columns)
