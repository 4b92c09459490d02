"""Choice of terms of a polynomial NARX model: ambid's orthogonal least squares beside the FROLS of sysidentpy.

Both choose from the same candidates on the same samples by the same criterion. Alone: ``python bench/selection.py``.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from ambid.nonlinear.polynomial import Selection, Term, candidates, lagged, products, select_terms
from peers import Array, Bench, bench
from table import Table
from timing import quantity

SAMPLES = (1_000, 10_000, 25_000)
DEGREE, LAGS, VALUES, CRITERION = 3, 5, 50, "aic"
LIMIT_S = 900.0


def record(n: int, seed: int = 0) -> tuple[Array, Array]:
    """y(t) = 0.2 y(t-1) + 0.1 y(t-1) u(t-1) + 0.9 u(t-2) + e(t), u uniform, e normal with sd 0.005."""
    rng = np.random.default_rng(seed)
    u, y = rng.uniform(-1, 1, n), np.zeros(n)
    for t in range(2, n):
        y[t] = 0.2 * y[t - 1] + 0.1 * y[t - 1] * u[t - 1] + 0.9 * u[t - 2] + 0.005 * rng.standard_normal()
    return u, y


def chosen(u: Array, y: Array) -> tuple[tuple[Term, ...], Selection]:
    """All of ambid's work: candidates made, terms chosen."""
    terms = products(lagged(1, 1, ny=LAGS, nu=LAGS, nk=1, ne=0), DEGREE)
    found = candidates(terms, [(y[:, None], u[:, None])], LAGS)
    picked = select_terms(found, y[LAGS:], most=VALUES, criterion=CRITERION)
    return tuple(terms[k] for k in picked.order), picked


def selection_tables() -> Iterator[Table]:
    with bench() as opened:
        yield _table(opened)


def _table(opened: Bench) -> Table:
    rows, data = [], []
    for n in SAMPLES:
        u, y = record(n)
        times = []
        for _ in range(5):
            before = time.perf_counter()
            order, picked = chosen(u, y)
            times.append(time.perf_counter() - before)
        ours = [_code(x) for x in order]
        orders = {"degree": DEGREE, "lags": LAGS, "values": VALUES}
        said = opened.ask("frols", "narx", orders, u, y, mode=CRITERION, limit_s=LIMIT_S)
        seconds = float(np.median(times))
        if "problem" in said:
            rows.append((f"{n}", quantity(seconds, "s"), said["problem"], "–", "–"))
            continue
        theirs = [tuple(sorted(int(c) for c in x if c)) for x in said["found"]["terms"]]
        same = ours[: len(theirs)] == theirs
        ratio = said["seconds"] / seconds
        rows.append(
            (
                f"{n}",
                quantity(seconds, "s"),
                quantity(said["seconds"], "s"),
                f"{ratio:.0f}",
                f"{'the same' if same else 'not the same'} {len(theirs)}; ambid ends at {picked.n_best}",
            )
        )
        err = np.abs(picked.err[: len(theirs)] - np.array(said["found"]["err"]))
        data.append({"samples": n, "ambid_s": times, "peer_s": said["seconds"], "same": same, "err": float(err.max())})
    return Table(
        group="Choice of terms: 286 candidates, 50 looked at",
        columns=("samples", "ambid", "sysidentpy", "ratio", "terms"),
        rows=tuple(rows),
        before=(
            "Polynomial NARX of degree 3, lags to 5, 286 candidates, Akaike's criterion over 50 terms for both; making"
            " the candidates is within the time. Same terms: those of the peer, one for one in the order of choice."
        ),
        remarks=("The peer ends where the criterion rises for the first time, ambid where it is least.",),
        data={"cases": data},
    )


def _code(term: Term) -> tuple[int, ...]:
    """A term as the peer writes it, without its zeros."""
    return tuple(sorted({"y": 1000, "u": 2000}[f.kind] + f.lag for f in term))


if __name__ == "__main__":
    for found in selection_tables():
        print(found.as_markdown())
