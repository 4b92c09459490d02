"""Measured records of a levitated ball: begun on half of the first, followed through the rest and four more."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox import polynomial
from ambid.blackbox.data import IOData
from ambid.recursive.polynomial import RecursivePolynomial
from tests.blackbox.polynomial.systems import record
from tests.measured import ABSENT, MAGLEV

pytestmark = pytest.mark.skipif(not MAGLEV.is_dir(), reason=ABSENT)

RECORDS = ("stairs_a", "stairs_b", "updown_c", "sine_d", "sine_e")


def current_and_position(name: str) -> IOData:
    values = np.genfromtxt(MAGLEV / f"levitate_{name}.csv", delimiter=",", skip_header=1)[2000:]
    return record(values[:, 3:4], values[:, 2:3])


@pytest.mark.parametrize(
    ("structure", "orders"), [("arx", {"na": 6, "nb": 6, "nk": 1}), ("armax", {"na": 3, "nb": 2, "nc": 3, "nk": 1})]
)
def test_innovations_are_those_of_a_model_fitted_to_each_record(structure: str, orders: dict[str, int]) -> None:
    whole = [current_and_position(name) for name in RECORDS]
    half = whole[0].n_samples // 2
    fitted = getattr(polynomial, structure)
    before, rest = whole[0].part(0, half), whole[0].part(half, whole[0].n_samples)
    r = RecursivePolynomial.from_fit(fitted(before, orders), samples=half, forgetting=0.999)
    r.prime(before.u, before.y)
    for k, data in enumerate((rest, *whole[1:])):
        if k:
            r.update(np.nan, np.nan)  # another day, another operating point
        e = r.update(data.u, data.y)
        ratio = np.sqrt(np.nanmean(e**2) / fitted(data, orders).noise_covariance[0, 0])
        assert ratio < 1.05, RECORDS[k]
        assert np.mean(np.isnan(e)) < 0.02
        assert np.all(np.linalg.eigvalsh(r.covariance / np.outer(r.sd, r.sd)) > 0)
    assert r.counts["projected"] == 0
    assert not r.warnings
