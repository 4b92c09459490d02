"""One thread for small matrices.

The QR factors and matrix exponentials of an identification are small: threads of the linear algebra library cannot
speed them up, and on a busy machine they wait for each other (ten times the time was measured). Set back on leaving.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep the linear algebra library to one thread inside a ``with`` block.

    Yields
    ------
    None
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield


@cache
def _controller() -> Any:
    """Controller of the linear algebra libraries that NumPy and SciPy have loaded."""
    import scipy.linalg  # noqa: F401  (SciPy brings a library of its own, which has to be there to be found)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
