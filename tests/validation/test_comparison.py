"""Structures compared on data that none of them has seen."""

from __future__ import annotations

import json

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.validation.comparison import compare
from ambid.validation.orders import folds, hold_out
from tests.validation.blackbox.fits import io, polynomial, run

TRUTH = polynomial(A=(1, -1.5, 0.7), B=((0, 1.0, 0.5),))
RIGHT = ("arx", {"na": 2, "nb": 2, "nk": 1})


def record(seed, n=700):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 1))
    return io(u, run(TRUTH, u, 0.3 * rng.standard_normal((n, 1))))


def test_the_right_structure_comes_first_and_refusals_last():
    found = compare(record(0), [("fir", {"nb": 2, "nk": 1}), RIGHT, ("cliv", {"na": 2, "nb": 2, "nk": 1})])
    assert [x.structure for x in found.entries] == ["arx", "fir", "cliv"]
    assert (found.fitted_samples, found.judged_samples) == (490, 210)
    assert found.entries[0].one_step > found.entries[1].one_step
    assert "reference" in found.entries[2].refusal
    assert "residuals_uncorrelated" in found.entries[1].failed
    assert "arx" in found.meaning
    json.dumps(found.as_dict(), allow_nan=False)


def test_a_second_record_leaves_the_first_whole():
    found = compare(record(1), [RIGHT], second=record(2))
    assert found.fitted_samples == found.judged_samples == 700
    assert found.judged_on == "second record"


def test_orders_are_chosen_where_none_are_given():
    assert dict(compare(record(3), [("arx", None)]).entries[0].orders) == RIGHT[1]


def test_the_table_fits_the_terminal_and_names_every_structure():
    shown = compare(record(4), [RIGHT, ("fir", {"nb": 2, "nk": 1}), ("cliv", None)]).summary()
    assert max(map(len, shown.splitlines())) <= 80
    for word in ("arx", "fir", "cliv was not fitted", "na=2 nb=2 nk=1", "BIC", "last 30 %"):
        assert word in shown


def test_nothing_to_compare_is_refused():
    with pytest.raises(EstimationError, match="at least one"):
        compare(record(5), [])
    with pytest.raises(EstimationError, match="none of the structures"):
        compare(record(5), [("cliv", {"na": 1, "nb": 1, "nk": 1})])
    with pytest.raises(EstimationError, match="between 0 and 1"):
        compare(record(5), [RIGHT], holdout=1.5)


def test_every_sample_is_judged_once_and_never_fitted_with():
    data = record(6, n=503)
    t = np.arange(503.0)
    data = io(data.u, t)
    judged = np.concatenate([f.judged.y[:, 0] for f in folds(data, 4)])
    np.testing.assert_array_equal(judged, t)
    for fold in folds(data, 4):
        assert not set(fold.fitted.y[:, 0]) & set(fold.judged.y[:, 0])
        assert fold.fitted.n_samples >= 240
        assert np.all(np.diff(fold.fitted.y[:, 0]) == 1)  # without a break
    assert hold_out(data, 0.2).judged.n_samples == 101
    with pytest.raises(EstimationError, match="folds"):
        folds(data, 20)
