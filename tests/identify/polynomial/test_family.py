"""Many ARX models from one triangle are those that are fitted one by one."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.identify.polynomial.family import arx_family
from tests.identify.polynomial.systems import SYSTEMS, record, two_outputs


def test_losses_are_those_of_least_squares() -> None:
    u, y, _ = two_outputs(600)
    data = record(u, 1e-3 * y + 5.0)
    found = arx_family(data, 1, range(4), (1, 3), (0, 1, 2))
    assert [(x.na, x.nb, x.nk) for x in found][:3] == [(0, 1, 0), (0, 1, 1), (0, 1, 2)]
    assert len(found) == 24
    first = data.n_samples - found[0].n_rows
    assert first == 4  # the largest model looks back to nk + nb - 1 = 4
    z = data.y[:, 1]
    for x in found:
        rows = [-z[first - k : z.size - k] for k in range(1, x.na + 1)]
        rows += [w[first - x.nk - k : z.size - x.nk - k] for w in u.T for k in range(x.nb)]
        rows = np.column_stack([*rows, np.ones(x.n_rows)])
        rest = np.linalg.lstsq(rows, z[first:], rcond=None)[1][0]
        assert x.loss == pytest.approx(rest / x.n_rows, rel=1e-9)
        assert x.n_estimated == rows.shape[1] - 1


def test_bic_finds_the_orders() -> None:
    found = arx_family(SYSTEMS["arx"].data(20, 2000), 0, range(6), range(1, 6), range(4))
    best = min(found, key=lambda x: x.n_rows * np.log(x.loss) + x.n_estimated * np.log(x.n_rows))
    assert (best.na, best.nb, best.nk) == (2, 2, 1)


@pytest.mark.parametrize("orders", [((-1,), (1,), (1,)), ((1,), (0,), (1,)), ((), (1,), (1,)), ((1,), (900,), (1,))])
def test_orders_out_of_range_are_refused(orders: tuple[tuple[int, ...], ...]) -> None:
    with pytest.raises(EstimationError, match="arx: "):
        arx_family(SYSTEMS["arx"].data(20, 1000), 0, *orders)
