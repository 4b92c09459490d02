"""The simulated experiments of the black-box benchmarks: known truths, their records and the Cramér-Rao bound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from ambid.blackbox.model import PolynomialModel
from peers import Array, Model

SETTLED = 500  # samples run before a record that is cut out of a longer run
OPERATING_POINT = np.array([3.0, 20.0])  # of u and y


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Experiment:
    """A truth, its input, its noise, and whether the record begins at rest, without offsets.

    Polynomials are in q^-1; B begins with nk zeros. A record that does not begin at rest is cut out of a longer run
    about an operating point.
    """

    name: str
    structure: str
    orders: dict[str, int]
    truth: dict[str, Array]
    excitation: Callable[[int, np.random.Generator], Array]
    sd: float
    at_rest: bool
    says: str

    @property
    def letters(self) -> str:
        return {"arx": "ab", "oe": "bf", "armax": "abc", "bj": "bcdf"}[self.structure]

    @property
    def coefficients(self) -> dict[str, float]:
        """The free coefficients of the truth by name, in the order of `vector`."""
        return {
            f"{x}{k}": float(v)
            for x in self.letters
            for k, v in enumerate(self.truth[x.upper()])
            if k >= (self.orders["nk"] if x == "b" else 1)
        }

    def vector(self, model: Model) -> Array:
        """The same coefficients of an estimate; not a number where the program keeps them to itself."""
        assert isinstance(model, PolynomialModel)
        p = model.outputs[0]
        found = {"a": p.A, "b": p.B[0], "c": p.C, "d": p.D, "f": p.F[0]}
        return np.array(
            [found[x[0]][int(x[1:])] if int(x[1:]) < found[x[0]].size else np.nan for x in self.coefficients]
        )

    def record(self, n: int, seed: int) -> tuple[Array, Array, Array]:
        """Return u, y and the whitened sensitivities dε/dθ at the truth, shape (n, n_theta)."""
        rng = np.random.default_rng(seed)
        before = 0 if self.at_rest else SETTLED
        u = self.excitation(n + before, rng)
        e = self.sd * rng.standard_normal(n + before)
        t = self.truth
        y = lfilter(t["B"], _product(t["A"], t["F"]), u) + lfilter(t["C"], _product(t["A"], t["D"]), e)
        point = np.zeros(2) if self.at_rest else OPERATING_POINT
        return u[before:] + point[0], y[before:] + point[1], self._sensitivity(u, y)[before:]

    def _sensitivity(self, u: Array, y: Array) -> Array:
        """Derivatives of ε = D/C (A y - B/F u) at the truth, by complex step."""
        names, step = list(self.coefficients), 1e-30
        out = np.empty((u.size, len(names)))
        for j, name in enumerate(names):
            p = {k: v.astype(complex) for k, v in self.truth.items()}
            p[name[0].upper()][int(name[1:])] += 1j * step
            inner = lfilter(p["A"], [1.0], y.astype(complex)) - lfilter(p["B"], p["F"], u.astype(complex))
            out[:, j] = lfilter(p["D"], p["C"], inner).imag / step
        return out

    def simulation_error(self, model: Model, u: Array) -> float:
        """|y0 - G u| / |y0| on the input of the record, both from rest; infinite for an unstable model."""
        t, u = self.truth, u if self.at_rest else u - OPERATING_POINT[0]
        y0 = lfilter(t["B"], _product(t["A"], t["F"]), u)
        g = model.state_space()
        if np.max(np.abs(np.linalg.eigvals(g.A)), initial=0.0) >= 1.0:
            return float("inf")
        return float(np.linalg.norm(y0 - simulated(g.A, g.B[:, 0], g.C[0], float(g.D[0, 0]), u)) / np.linalg.norm(y0))


def simulated(A: Array, B: Array, C: Array, D: float, u: Array) -> Array:
    """Simulate from rest through the transfer function: numerator by the characteristic polynomials."""
    denominator = np.poly(A).real
    numerator = np.poly(A - np.outer(B, C)).real + (D - 1.0) * denominator
    return np.asarray(lfilter(numerator, denominator, u))


def _product(first: Array, second: Array) -> Array:
    return np.asarray(np.convolve(first, second))


def _sines(n: int, rng: np.random.Generator) -> Array:  # noqa: ARG001
    t = np.arange(n)
    return np.asarray(sum(a * np.sin(2 * np.pi * t / p) for a, p in ((1.0, 17), (0.7, 43), (0.4, 97))))


def _binary(n: int, rng: np.random.Generator) -> Array:
    return rng.choice([-1.0, 1.0], size=n)


def _truth(**polynomials: list[float]) -> dict[str, Array]:
    return {x: np.array(polynomials.get(x, [1.0])) for x in "ABCDF"}


_B, _SECOND = [0.0, 1.0, 0.5], [1.0, -1.5, 0.7]
_BINARY = "random binary input, noise of standard deviation 1"


def _experiments(at_rest: bool) -> list[Experiment]:
    start = "from rest" if at_rest else "in operation"
    common = {"excitation": _binary, "sd": 1.0, "at_rest": at_rest}
    return [
        Experiment(
            name=f"OE, {start}",
            structure="oe",
            orders={"nb": 2, "nf": 2, "nk": 1},
            truth=_truth(B=_B, F=_SECOND),
            says=f"B = q^-1 + 0.5 q^-2, F = 1 - 1.5 q^-1 + 0.7 q^-2; {_BINARY}",
            **common,
        ),
        Experiment(
            name=f"ARMAX, {start}",
            structure="armax",
            orders={"na": 2, "nb": 2, "nc": 2, "nk": 1},
            truth=_truth(A=_SECOND, B=_B, C=[1.0, -1.0, 0.2]),
            says=f"A = 1 - 1.5 q^-1 + 0.7 q^-2, B = q^-1 + 0.5 q^-2, C = 1 - q^-1 + 0.2 q^-2; {_BINARY}",
            **common,
        ),
        Experiment(
            name=f"BJ, {start}",
            structure="bj",
            orders={"nb": 2, "nc": 1, "nd": 1, "nf": 2, "nk": 1},
            truth=_truth(B=_B, C=[1.0, 0.5], D=[1.0, -0.85], F=_SECOND),
            says=f"B/F as for OE, C = 1 + 0.5 q^-1, D = 1 - 0.85 q^-1; {_BINARY}",
            **common,
        ),
    ]


PUBLISHED = Experiment(
    name="OE, published, from rest",
    structure="oe",
    orders={"nb": 1, "nf": 3, "nk": 1},
    truth=_truth(B=[0.0, 1.0], F=[float(x) for x in np.poly([0.9, 0.8, 0.7])]),
    excitation=_sines,
    sd=1.0,
    at_rest=True,
    says="B = q^-1, poles 0.9, 0.8, 0.7; input of three sines (periods 17, 43, 97; amplitudes 1, 0.7, 0.4), noise of "
    "standard deviation 1: the public comparison of pysib with SIPPY",
)
EXPERIMENTS = (PUBLISHED, *_experiments(at_rest=True), *_experiments(at_rest=False))

_ARX = Experiment(
    name="ARX",
    structure="arx",
    orders={"na": 2, "nb": 2, "nk": 1},
    truth=_truth(A=_SECOND, B=_B),
    excitation=_binary,
    sd=1.0,
    at_rest=True,
    says=f"A = 1 - 1.5 q^-1 + 0.7 q^-2, B = q^-1 + 0.5 q^-2; {_BINARY}",
)
AT_SPEED = (_ARX, *_experiments(at_rest=True))
