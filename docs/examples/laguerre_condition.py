"""Powers of s and of the Laguerre operator
========================================

What the Laguerre operator does: condition numbers with and without it, order 2 to 20 (thesis eq. 1.7-1.8).

A subspace method in continuous time works on rows of powers of s = j omega, which grow like omega^k and are nearly
parallel. Powers of w = (s - p)/(s + p) stay on the unit circle; here p is the one that conditions them best.

Run: ``python docs/examples/laguerre_condition.py``
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ambid.blackbox.frequency_subspace import best_conditioned, block_rows_condition

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Result:
    """Condition numbers and the operator's p in Hz by order."""

    orders: Array
    without: Array
    with_operator: Array
    p_hz: Array


def main() -> Result:
    """Compute and print a table; return the numbers."""
    frequency_hz = np.linspace(5.0, 2000.0, 400)
    omega = 2 * np.pi * frequency_hz
    orders = np.arange(2, 21)
    p = np.array([best_conditioned(omega, int(n)) for n in orders])
    result = Result(
        orders=orders,
        without=np.array([block_rows_condition(omega, int(n)) for n in orders]),
        with_operator=np.array([block_rows_condition(omega, int(n), float(q)) for n, q in zip(orders, p, strict=True)]),
        p_hz=p / (2 * np.pi),
    )
    print(f"400 lines from {frequency_hz[0]:g} to {frequency_hz[-1]:g} Hz; powers of s are of s over the median")
    print("order   powers of s   powers of w   p (Hz)")
    for n, a, b, q in zip(result.orders, result.without, result.with_operator, result.p_hz, strict=True):
        print(f"{n:5d} {a:13.3g} {b:13.3g} {q:8.0f}")
    return result


def draw(result: Result) -> Figure:
    """Draw both condition numbers over the order."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.subplots()
    axes.semilogy(result.orders, result.without, "o-", label="powers of s = jω (over the median ω)")
    axes.semilogy(result.orders, result.with_operator, "s-", label="powers of w = (s - p)/(s + p)")
    axes.axhline(1 / np.finfo(float).eps ** 0.5, color="0.6", linestyle=":", linewidth=1)
    axes.annotate("half of all digits lost", (2, 1.3 / np.finfo(float).eps ** 0.5), color="0.4")
    axes.set_xlabel("order")
    axes.set_ylabel("condition number of the rows")
    axes.set_xticks(result.orders[::2])
    axes.grid(visible=True, alpha=0.3)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.8))
    return figure


if __name__ == "__main__":
    figure = draw(main())
