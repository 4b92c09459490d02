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
    """Keep the linear algebra library to one thread inside a ``with`` block."""
    libraries = _controller()
    if all(x.num_threads == 1 for x in libraries.lib_controllers if x.user_api == "blas"):
        yield  # so already, from the environment or a caller: setting it would take longer than a small fit's algebra
        return
    with libraries.limit(limits=1, user_api="blas"):
        yield


@cache
def _controller() -> Any:
    """Controller of the linear algebra libraries that NumPy and SciPy have loaded."""
    import scipy.linalg  # noqa: F401  (SciPy brings a library of its own, which has to be there to be found)
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
