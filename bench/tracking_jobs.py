"""What is timed: each job in ambid's terms and, where a public package does it, in those of the package."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ambid.recursive.kalman import KalmanFilter, constant_velocity, linear_state
from ambid.recursive.polynomial import RecursivePolynomial
from ambid.recursive.regression import Lms, Nlms, RecursiveLeastSquares
from experiments import AT_SPEED
from peers import Array, Bench, model_of
from tracking_bearing_jobs import bearing_jobs
from tracking_job import N_PEER, Job, Same, digits

N = 1_000_000
FORGETTING, EPS = 0.999, 1e-6
STEP = 0.01
RATE = 20_000.0


def jobs() -> Iterator[Job]:
    """All jobs, in the order of the table."""
    yield from _regressions()
    yield from _filters()
    yield _polynomial()
    yield from bearing_jobs()


def _regressions() -> Iterator[Job]:
    rng = np.random.default_rng(1)
    phi = rng.standard_normal((N, 4))
    truth = np.array([1.0, -0.5, 0.25, 2.0])
    y = phi @ truth + 0.1 * rng.standard_normal(N)
    values = y.tolist()

    def job(name: str, make: Callable[[], Any], peer: str, program: str, structure: str, **orders: float) -> Job:
        def feed() -> Callable[[int, int], object]:
            made = make()
            return lambda a, b: made.update(phi[a:b], y[a:b])

        def single() -> Callable[[int], object]:
            made = make()
            return lambda k: made.update(phi[k], values[k])

        def ask(children: Bench, mode: str) -> dict[str, Any]:
            return children.ask(program, structure, orders, phi[:N_PEER], y[:N_PEER], mode=mode)

        def compare(found: dict[str, Array]) -> Same:
            made = make()
            made.update(phi[:N_PEER], y[:N_PEER])
            return digits(made.estimate, found["estimate"])

        return Job(
            name=name, n=N, feed=feed, single=single, peer=peer, ask=ask, compare=compare,
            peer_single=program == "padasip",
        )  # fmt: skip

    yield job(
        "RLS, 4 coefficients, forgetting",
        lambda: RecursiveLeastSquares(4, prior=1 / EPS, factor=FORGETTING, limit=1e9),
        "padasip", "padasip", "rls", mu=FORGETTING, eps=EPS,
    )  # fmt: skip
    yield job(
        "RLS, 4 coefficients, all data alike",
        lambda: RecursiveLeastSquares(4, prior=1e9),
        "statsmodels, compiled", "statsmodels", "rls",
    )  # fmt: skip
    yield job(
        "NLMS, 4 coefficients", lambda: Nlms(4, step=0.5, small=EPS), "padasip", "padasip", "nlms", mu=0.5, eps=EPS
    )
    yield job("LMS, 4 coefficients", lambda: Lms(4, step=STEP), "padasip", "padasip", "lms", mu=STEP)


def _filters() -> Iterator[Job]:
    rng = np.random.default_rng(2)
    t = np.arange(N) / RATE
    y = 10.0 * np.sin(2 * np.pi * 7.0 * t) + rng.standard_normal(N)  # µm: the peer's tolerances are absolute
    values = y.tolist()
    model = constant_velocity(RATE, q=1e8, r=1.0)
    P0 = np.diag([1e2, 1e6])
    orders = {"A": model.A, "C": model.C, "Q": model.Q, "R": model.R, "P0": P0}
    plain = {k: v.tolist() for k, v in orders.items()}

    def filter_job(name: str, make: Callable[[], Any], peer: str, program: str, given: dict[str, Any]) -> Job:
        def feed() -> Callable[[int, int], object]:
            made = make()
            return lambda a, b: made.update(y[a:b])

        def single() -> Callable[[int], object]:
            made = make()
            return lambda k: made.update(values[k])

        return Job(
            name=name, n=N, feed=feed, single=single, peer=peer,
            ask=(lambda children, _: children.ask(program, "kalman", given, y[:1], y[:N_PEER])) if program else None,
            compare=lambda found: digits(np.ravel(make().update(y[:N_PEER])[-1]), found["estimate"]),
        )  # fmt: skip

    name = "Kalman filter, position and velocity"
    for peer, program in (("filterpy", "filterpy"), ("statsmodels, compiled", "statsmodels")):
        yield filter_job(name, lambda: KalmanFilter(model, start_covariance=P0), peer, program, plain)
    thesis = linear_state([[1.0]], [[1.0]], [[60.0 / RATE]], [[RATE]])
    bucy = {
        "A": [[1.0]],
        "C": [[1.0]],
        "Q": [[60.0 / RATE]],
        "R": [[RATE]],
        "P0": KalmanFilter(thesis).covariance.tolist(),
    }
    yield filter_job(
        "Kalman-Bucy filter of the thesis, discrete",
        lambda: KalmanFilter(thesis),
        "filterpy", "filterpy", bucy,
    )  # fmt: skip


def _polynomial() -> Job:
    experiment = next(e for e in AT_SPEED if e.structure == "armax")
    n, n_peer = 200_000, 10_000
    u, y, _ = experiment.record(n, 1)
    orders = experiment.orders

    def make() -> RecursivePolynomial:
        made = RecursivePolynomial("armax", orders)
        made.update(u[:10_000], y[:10_000])  # what is fitted off-line to begin with
        return made

    def feed() -> Callable[[int, int], object]:
        made = make()
        return lambda a, b: made.update(u[a:b], y[a:b])

    def single() -> Callable[[int], object]:
        made = make()
        return lambda k: made.update(u[k : k + 1], y[k : k + 1])

    def compare(found: dict[str, Array]) -> Same:
        made = RecursivePolynomial("armax", orders)
        made.update(u[:n_peer], y[:n_peer])
        ours = experiment.simulation_error(made.model, u[:n_peer])
        theirs = experiment.simulation_error(model_of(found), u[:n_peer])
        return Same(
            text=f"simulation error {ours:.2g}, peer {theirs:.2g}",
            numbers={"simulation_error": ours, "peer_simulation_error": theirs},
        )

    return Job(
        name=f"recursive ARMAX, {len(experiment.coefficients)} coefficients", n=n, feed=feed, single=single,
        peer="SIPPY, recursive LS", peer_n=n_peer,
        ask=lambda children, _: children.ask("sippy", "armax", orders, u[:n_peer], y[:n_peer], mode="RLLS"),
        compare=compare,
    )  # fmt: skip
