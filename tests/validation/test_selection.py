"""Choice of orders on simulated records: the truth is found, in few fits, by every criterion that is consistent."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.fit import structure
from ambid.errors import EstimationError
from ambid.validation.orders import arx_candidates, select
from tests.validation.blackbox.fits import arx, io, polynomial, run

TRUTH = {
    "arx": polynomial(A=(1, -1.5, 0.7), B=((0, 0, 0, 1.0, 0.5),)),
    "fir": polynomial(B=((0, 0, 1, 0.5, 0.3),)),
    "oe": polynomial(F=((1, -1.5, 0.7),), B=((0, 0, 1.0, 0.5),)),
    "armax": polynomial(A=(1, -1.5, 0.7), B=((0, 0, 1.0, 0.5),), C=(1, 0.5, 0.2)),
}
ORDERS = {
    "arx": {"na": 2, "nb": 2, "nk": 3},
    "fir": {"nb": 3, "nk": 2},
    "oe": {"nb": 2, "nf": 2, "nk": 2},
    "armax": {"na": 2, "nb": 2, "nc": 2, "nk": 2},
}


def record(name, seed=1, n=800):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((n, 1))
    return io(u - 1.0, run(TRUTH[name], u, 0.4 * rng.standard_normal((n, 1))) + 4.0)


@pytest.mark.parametrize("name", list(TRUTH))
def test_the_true_orders_are_chosen(name):
    tried = []
    found = select(name, record(name), tick=tried.append)
    assert dict(found.orders) == ORDERS[name]
    assert len(tried) <= 41
    scores = [c.scores["bic"] for c in found.candidates]
    assert scores == sorted(scores)
    assert found.summary()["best"][0]["orders"] == ORDERS[name]


@pytest.mark.parametrize("criterion", ["aic", "aicc", "mdl", "fpe", "holdout", "kfold"])
def test_every_criterion_chooses_a_model_that_holds_the_truth(criterion):
    found = select("arx", record("arx"), criterion=criterion)
    orders = found.orders
    assert orders["na"] >= 2
    assert orders["nk"] <= 3
    assert orders["nk"] + orders["nb"] >= 5
    assert criterion in found.candidates[0].scores
    assert found.why


def test_coloured_noise_does_not_raise_the_order_of_an_output_error_model():
    rng = np.random.default_rng(5)
    u = rng.standard_normal((1500, 1))
    model = polynomial(F=((1, -1.5, 0.7),), B=((0, 1.0, 0.5),), D=(1, -0.95))
    chosen = select("oe", io(u, run(model, u, 0.5 * rng.standard_normal((1500, 1))))).orders
    assert chosen["nf"] == 2
    assert chosen["nb"] == 2


def test_ranges_are_kept():
    found = select("arx", record("arx"), ranges={"na": (1, 1), "nk": (2, 2)})
    assert {(c.orders["na"], c.orders["nk"]) for c in found.candidates} == {(1, 2)}


def test_all_arx_losses_from_one_factor_are_those_of_the_fits():
    data = record("arx", n=300)
    found = arx_candidates(data, {"na": (1, 3), "nb": (1, 2), "nk": (1, 3)})
    assert len(found) == 18
    for c in found[::5]:
        start = 4  # largest nk + nb - 1: the samples that all candidates share
        part = data.part(start - max(c.na, c.nb + c.nk[0] - 1), data.n_samples)
        n = data.n_samples - start
        variance = arx(part, c.na, c.nb, c.nk[0]).noise_covariance[0, 0]
        assert np.exp(c.log_det) == pytest.approx(variance * (n - c.na - c.nb - 1) / n, rel=1e-9)


def test_two_inputs_have_delays_of_their_own():
    rng = np.random.default_rng(6)
    u = rng.standard_normal((1500, 2))
    model = polynomial(A=(1, -0.8), B=((0, 1.0), (0, 0, 0, 0.7)), F=((1.0,), (1.0,)))
    found = select("arx", io(u, run(model, u, 0.3 * rng.standard_normal((1500, 1)))))
    assert found.orders["nk"] == (1, 3)
    assert found.orders["na"] == 1
    assert structure("arx").name == found.structure


@pytest.mark.parametrize(
    ("options", "what"),
    [({"criterion": "bicc"}, "bic"), ({"ranges": {"nf": (1, 2)}}, "nf"), ({"criterion": ""}, "aic")],
)
def test_what_is_unknown_is_refused(options, what):
    with pytest.raises(EstimationError, match=what):
        select("arx", record("arx"), **options)
