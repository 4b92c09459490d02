"""Recursive polynomial models for the suite over all recursive estimators."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import Offsets, PolynomialModel, Polynomials
from ambid.recursive.polynomial import RecursivePolynomial
from tests.recursive.cases import Case

A, B, C, D = (1.0, -1.5, 0.7), (0.0, 1.0, 0.5), (1.0, 0.5, 0.3), (1.0, -0.6)
ORDERS = {
    "arx": {"na": 2, "nb": 2, "nk": 1},
    "armax": {"na": 2, "nb": 2, "nc": 2, "nk": 1},
    "oe": {"nb": 2, "nf": 2, "nk": 1},
    "bj": {"nb": 2, "nc": 2, "nd": 1, "nf": 2, "nk": 1},
}
_LONGEST = 40_000


def polynomials(structure: str) -> Polynomials:
    """The true system of each structure."""
    one = (1.0,)
    return Polynomials(
        A=A if structure in ("arx", "armax") else one,
        B=(B,),
        C=C if structure in ("armax", "bj") else one,
        D=D if structure == "bj" else one,
        F=(A if structure in ("oe", "bj") else one,),
    )


def signals(structure: str):
    """Input and output of the true system at an operating point that is not zero."""
    p = polynomials(structure)

    def made(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        u = 2.0 + np.random.default_rng(seed).standard_normal(n)
        e = 0.3 * np.random.default_rng(1000 + seed).standard_normal(n)
        G = lfilter(p.B[0], np.convolve(p.A, p.F[0]), u)
        return u, 5.0 + G + lfilter(p.C, np.convolve(p.A, p.D), e)

    return made


def fit_of(structure: str) -> BlackBoxFit:
    """An off-line fit near the truth, without the search."""
    model = PolynomialModel(outputs=(polynomials(structure),), dt=1e-3)
    free = np.concatenate([np.arange(c.size) >= 1 for _, _, c in model.outputs[0].parts()])
    return BlackBoxFit(
        structure=structure,
        orders=dict(ORDERS[structure]),
        model=model,
        covariance=np.diag(1e-4 * free),
        n_estimated=int(free.sum()),
        offsets=Offsets(u=np.zeros(1), y=np.zeros(1)),
        noise_covariance=np.array([[0.09]]),
        inputs=("u",),
        outputs=("y",),
        units={"u": "1", "y": "1"},
        dt=1e-3,
        record={},
    )


def case(name: str, structure: str, n: int, **options: object) -> Case:
    start = options.pop("start", "fit")

    def make() -> RecursivePolynomial:
        if start == "fit":
            return RecursivePolynomial.from_fit(fit_of(structure), open_loop=True, **options)
        return RecursivePolynomial(structure, ORDERS[structure], dt=1e-3, open_loop=True, burn_in=200, **options)

    return Case(name=name, make=make, signals=signals(structure), n=n)


CASES = [
    case("polynomial-arx", "arx", 400),
    case("polynomial-armax", "armax", 400),
    case("polynomial-armax-forgetting", "armax", 400, forgetting=0.99),
    case("polynomial-oe", "oe", 400, forgetting=0.98),
    case("polynomial-bj", "bj", 400),
    case("polynomial-armax-from-nothing", "armax", 600, start="nothing"),
]
