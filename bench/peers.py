"""Ambid's estimators and those of other packages behind one call: a record, a structure and orders in, a model out.

Every package runs in a process of its own, in the environment that ``make peers`` makes, fed through files
(peer_child.py). What fails, stops or takes too long is an answer that says so.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import solve_discrete_are

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import structure as registered
from ambid.blackbox.model import Offsets, PolynomialModel, Polynomials, StateSpaceModel
from ambid.errors import EstimationError

HERE = Path(__file__).resolve().parent
ENVIRONMENT, TRACKING, ROTOR = (HERE / ".venv" / name / "bin" / "python" for name in ("linear", "tracking", "rotor"))
Array = np.ndarray
Model = PolynomialModel | StateSpaceModel


@dataclass(frozen=True, slots=True, kw_only=True)
class Way:
    """One way to estimate: a program and its setting, and the structures that it has."""

    label: str
    program: str
    structures: tuple[str, ...]
    mode: str = ""


AMBID = Way(label="ambid", program="ambid", structures=("arx", "oe", "armax", "bj", "n4sid", "moesp", "cva", "pbsid"))
WAYS = (
    AMBID,
    Way(label="pysib", program="pysib", structures=("arx", "oe", "armax", "bj")),
    Way(label="SIPPY", program="sippy", structures=("arx", "n4sid")),
    Way(label="SIPPY, IPOPT", program="sippy", structures=("oe", "armax", "bj"), mode="OPT"),
    Way(label="SIPPY, iterated LS", program="sippy", structures=("armax",), mode="ILLS"),
    Way(label="SIPPY, recursive LS", program="sippy", structures=("oe", "armax"), mode="RLLS"),
    Way(label="sysidentpy", program="sysidentpy", structures=("arx",)),
    Way(label="sysidentpy, extended LS", program="sysidentpy", structures=("oe", "armax")),
    Way(label="nfoursid", program="nfoursid", structures=("n4sid",)),
    Way(label="SciPy by hand", program="scipy", structures=("oe", "armax", "bj")),
)
PACKAGES = ("pysib", "sippy-unipi", "sysidentpy", "nfoursid", "numpy", "scipy", "casadi")
TRACKERS = ("padasip", "filterpy", "statsmodels")
ROTORS = ("ross-rotordynamics",)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answer:
    """What came out; no model where there is a problem."""

    seconds: float
    model: Model | None = None
    offsets: Offsets | None = None
    problem: str = ""
    sd: Array | None = None


@dataclass(slots=True)
class Bench:
    """The children, started when first asked and again after a time limit."""

    folder: Path
    children: dict[str, subprocess.Popen[str]] = field(default_factory=dict)

    def answer(
        self, way: Way, structure: str, orders: Mapping[str, int], u: Array, y: Array, *, limit_s: float = 60.0,
        open_loop: bool = True, at_rest: bool = False,
    ) -> Answer:  # fmt: skip
        """Fit one record, u and y of shape (n_samples,); the peers take for granted that it begins at rest."""
        if way.program == "ambid":
            return _ambid(structure, orders, u, y, open_loop, at_rest)
        said = self.ask(way.program, structure, orders, u, y, mode=way.mode, limit_s=limit_s)
        if "problem" in said:
            return Answer(seconds=said["seconds"], problem=said["problem"])
        return Answer(seconds=said["seconds"], model=model_of({k: np.array(v) for k, v in said["found"].items()}))

    def ask(
        self, program: str, structure: str, orders: Mapping[str, Any], u: Array, y: Array, *, mode: str = "",
        limit_s: float = 60.0,
    ) -> dict[str, Any]:  # fmt: skip
        """Have a peer do one job; seconds and what it found, or the problem."""
        data = self.folder / "record.npz"
        np.savez(data, u=u, y=y)
        job = {"structure": structure, "orders": dict(orders), "mode": mode, "data": str(data)}
        child = self._child(program)
        assert child.stdin is not None
        assert child.stdout is not None
        before = time.perf_counter()
        try:
            child.stdin.write(json.dumps(job) + "\n")
            child.stdin.flush()
        except BrokenPipeError:
            self._stop(program)
            return {"seconds": 0.0, "problem": "the process ended"}
        ready, _, _ = select.select([child.stdout], [], [], limit_s)
        line = child.stdout.readline() if ready else ""
        if not line:
            self._stop(program)
            spent = time.perf_counter() - before
            return {"seconds": spent, "problem": "the process ended" if ready else f"more than {limit_s:.0f} s"}
        return dict(json.loads(line))

    def _child(self, program: str) -> subprocess.Popen[str]:
        if program not in self.children:
            own = {"scipy": Path(sys.executable), "ross": ROTOR} | dict.fromkeys(TRACKERS, TRACKING)
            python = own.get(program, ENVIRONMENT)
            self.children[program] = subprocess.Popen(
                [str(python), str(HERE / f"peer_{program}.py")],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                env={k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"},
                cwd=self.folder,
            )
        return self.children[program]

    def _stop(self, program: str) -> None:
        child = self.children.pop(program)
        child.kill()
        child.wait()

    def close(self) -> None:
        for program in list(self.children):
            self._stop(program)


@contextmanager
def bench() -> Iterator[Bench]:
    """Open a bench whose children end with it."""
    if not all(python.exists() for python in (ENVIRONMENT, TRACKING, ROTOR)):
        raise SystemExit("the peers are not installed: make peers")
    with tempfile.TemporaryDirectory() as folder:
        found = Bench(folder=Path(folder))
        try:
            yield found
        finally:
            found.close()


def ways(structure: str) -> list[Way]:
    return [w for w in WAYS if structure in w.structures]


def versions() -> dict[str, str]:
    """Of the peers and of what they compute with."""
    code = "import sys; from importlib.metadata import version; [print(version(x)) for x in sys.argv[1:]]"
    found: dict[str, str] = {}
    for python, packages in ((ENVIRONMENT, PACKAGES), (TRACKING, TRACKERS), (ROTOR, ROTORS)):
        done = subprocess.run([str(python), "-c", code, *packages], capture_output=True, text=True, check=True)
        found |= dict(zip(packages, done.stdout.split(), strict=True))
    return found


def io_data(u: Array, y: Array, dt: float = 1.0, *, open_loop: bool = True) -> IOData:
    return IOData(
        u=u[:, None], y=y[:, None], dt=dt, inputs=("u",), outputs=("y",), units={"u": "1", "y": "1"},
        open_loop=open_loop,
    )  # fmt: skip


def _ambid(structure: str, orders: Mapping[str, int], u: Array, y: Array, open_loop: bool, at_rest: bool) -> Answer:
    data = io_data(u, y, open_loop=open_loop)
    estimator = registered(structure).estimator
    options: dict[str, Any] = {"horizon": orders["horizon"]} if "horizon" in orders else {}
    options |= {"feedthrough": True} if "feedthrough" in orders else {}
    options |= {"at_rest": True} if at_rest else {}
    orders = {k: v for k, v in orders.items() if k not in ("horizon", "feedthrough")}
    before = time.perf_counter()
    try:
        fit = estimator(data, orders, **options)
    except EstimationError as problem:
        return Answer(seconds=time.perf_counter() - before, problem=str(problem))
    seconds = time.perf_counter() - before
    assert isinstance(fit.model, PolynomialModel | StateSpaceModel)
    problem = "" if fit.status == "converged" else "did not converge"
    return Answer(seconds=seconds, model=fit.model, offsets=fit.offsets, problem=problem, sd=fit.sd)


def model_of(found: Mapping[str, Array]) -> Model:
    """Put polynomials or matrices into ambid's models, so that all are judged by the same code."""
    if "B" in found and found["B"].ndim == 1:
        one = np.ones(1)
        p = Polynomials(
            A=found.get("A", one), B=(found["B"],), C=found.get("C", one), D=found.get("D", one),
            F=(found.get("F", one),),
        )  # fmt: skip
        return PolynomialModel(outputs=(p,), dt=1.0)
    return StateSpaceModel(**{k: found[k] for k in "ABCD"}, K=_gain(found), dt=1.0)


def _gain(found: Mapping[str, Any]) -> Array:
    """The Kalman gain that comes with the matrices, or that of the noise covariances; zero where there is none."""
    A, C = found["A"], found["C"]
    none = np.zeros((A.shape[0], C.shape[0]))
    if "K" in found:
        return np.asarray(found["K"]) if np.shape(found["K"]) == none.shape else none
    if "covariance" not in found:
        return none
    n_y, cov = C.shape[0], found["covariance"]
    R, S, Q = cov[:n_y, :n_y], cov[n_y:, :n_y], cov[n_y:, n_y:]
    try:
        P = solve_discrete_are(A.T, C.T, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError):
        return none
    return np.asarray(np.linalg.solve(C @ P @ C.T + R, (A @ P @ C.T + S).T).T)
