"""Unbalance, runout and balancing of a rotor: at the speed W y = H(jW) v + X u + r, u = U exp(j phase) of forces U W²
(cos, sin)(angle + phase) in planes x and y, r the sensors' runout, whatever controller holds it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.estimation.linear import directions
from ambid.physics.rotor_model import RotorModel
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.likelihood import Point, at_lines
from ambid.rotor.replay import point_of
from ambid.rotor.spectra import PeriodSpectra
from ambid.rotor.synchronous import SynchronousResponse

_NO_PLANES: Mapping[str, tuple[float, ...]] = MappingProxyType({})
_BEYOND = 3.0  # prior of what a mode sees beyond the planes, over mass, motion and shape
_ROUNDS = 3  # the plant's share of the covariance follows the unbalance
_SEEN = 0.25  # standard deviation over size, up to which an unbalance or a runout is identified
_LINES = 16  # excited lines on either side that show the response to the excitation at a harmonic
_ONE_PLANE = 3.0  # standard deviations within which an unbalance is that of one plane
_SHOWN = 240  # samples of an orbit that a result keeps for its figure
_SAME_SPEED = 0.01
_FAR = 4.5  # standard deviations from which the response is not explained
_CIRCLE_95 = 2.4477468306808166  # radius that holds 95 % of a round normal distribution, in standard deviations


@dataclass(frozen=True, kw_only=True, eq=False)
class Machine:
    """An identified rotor: its numbers, and the covariance of those that `names` lists."""

    model: RotorModel
    at: Point
    names: tuple[str, ...]
    covariance: Array
    beside: Mapping[str, tuple[float, ...]] = field(default_factory=lambda: _NO_PLANES)  # planes: z, shape of each mode

    @classmethod
    def of(cls, estimate: RotorEstimate, planes: Mapping[str, tuple[float, ...]] = _NO_PLANES) -> Machine:
        """Return the machine of an estimate; `planes`: planes in which unbalance may stand."""
        return cls(
            model=estimate.plant, at=point_of(estimate), names=estimate.covariance_names,
            covariance=estimate.covariance, beside=planes,
        )  # fmt: skip

    @property
    def planes(self) -> list[str]:
        """Planes of unbalance: those that are given where they are enough, else the outermost radial bearings'."""
        if self.beside and (self.model.n_modes or len(self.beside) > 1):
            return list(self.beside)
        radial = [f"{b.name}.z" for b in self.model.bearings if not b.axial]
        return list(dict.fromkeys([radial[0], radial[-1]])) if radial else []

    @property
    def beyond(self) -> int:
        """Number of bending modes that may see more than the unbalance in the planes: in given planes is all of it."""
        return 0 if self.planes == list(self.beside) else self.model.n_modes

    def z(self, place: str) -> float:
        """Return where a plane stands along the shaft, m."""
        return self.beside[place][0] if place in self.beside else self.theta[place]

    @property
    def steps(self) -> Array:
        """One standard deviation along each direction of the covariance, (n, n), from the correlations: in SI the
        variance of a stiffness drowns that of an inductance in rounding.
        """
        sd = np.sqrt(np.diag(self.covariance))
        size = np.where(sd > 0.0, sd, 1.0)
        values, vectors = np.linalg.eigh(self.covariance / np.outer(size, size))
        return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T * size)

    def moved(self, by: Array) -> Machine:
        """Return the machine with estimated numbers moved."""
        theta, delays = dict(self.theta), self.at.delays.copy()
        for name, step in zip(self.names, by.tolist(), strict=True):
            if name.endswith(".delay"):
                delays[self.model.inputs.index(name.removesuffix(".delay"))] += step
            else:
                theta[name] += step
        return replace(self, at=Point(theta=theta, delays=delays))

    @property
    def theta(self) -> Mapping[str, float]:
        """Numbers by the names of the model, SI."""
        return self.at.theta

    def transfer(self, omega: Array, speed: float, rate_hz: float) -> Complex:
        """Return its sampled response at a speed, (n_lines, n_y, n_u); all in rad/s."""
        return at_lines(self.model, self.at, omega, speed, rate_hz).transfer()

    def forced(self, speed: float, shapes: Array) -> Complex:
        """Return the response (n_y, n) of the outputs to unbalances of 1 kg m; `shapes`: (n_coordinates a plane, n)."""
        turning = self.model.at_speed(speed)
        space, (mass, _, _) = turning.matrices(self.theta), turning.rotor_matrices(self.theta)
        F = np.zeros((space.A.shape[0], shapes.shape[1]), dtype=complex)
        n = mass.size
        for plane, factor in ((0, 1.0), (1, -1j)):
            at = [k for k, q in enumerate(turning.coordinates) if q.endswith("xy"[plane]) and plane in turning.planes]
            if at:
                F[[n + k for k in at]] = factor * speed**2 * shapes / mass[at, None]
        return np.asarray(space.C @ np.linalg.solve(1j * speed * np.eye(space.A.shape[0]) - space.A, F))

    def shape(self, place: str) -> Array:
        """Return what an unbalance in a plane does to the coordinates of a plane of motion."""
        names = [f"mode{r}.{place}" for r in range(1, self.model.n_modes + 1)]
        modes = self.beside[place][1:] if place in self.beside else [self.theta[name] for name in names]
        return np.array([1.0, self.z(place) - self.theta["z_cg"], *modes])

    @property
    def shapes(self) -> Array:
        """Shapes of what is estimated: unbalance in the planes, then what each bending mode sees beyond them."""
        modes = np.eye(2 + self.model.n_modes)[:, 2 : 2 + self.beyond]
        return np.column_stack([*(self.shape(p) for p in self.planes), modes])


@dataclass(frozen=True, kw_only=True, eq=False)
class Unbalance:
    """Unbalance by plane, modal unbalance and runout, as one vector of complex numbers with its covariance."""

    names: tuple[str, ...]  # of planes, "mode1" …, sensor planes
    value: Complex  # (n,); kg m, kg^(1/2) m, m
    half: Array  # (2 n, k), covariance of (real parts, imaginary parts) is half halfᵀ
    most: Array  # (n,), standard deviation up to which a number is identified
    misfit: float  # mean square of whitened residuals over their degrees of freedom
    freedom: int

    def part(self, names: Sequence[str]) -> tuple[Complex, Array]:
        """Return some of the numbers with their share of `half`."""
        at = [self.names.index(x) for x in names]
        return self.value[at], self.half[[*at, *(len(self.names) + k for k in at)]]

    def entry(self, name: str) -> dict[str, Any]:
        """Return one number for a result: value, phase and standard deviations."""
        k = self.names.index(name)
        value, half = self.part([name])
        return {**polar(complex(value[0]), half), "identifiable": bool(_spread(half) <= self.most[k])}


def polar(value: complex, half: Array) -> dict[str, Any]:
    """Return size and phase of a complex number with standard deviations; `half`: (2, k)."""
    size = abs(value)
    along = np.array([value.real, value.imag]) / size if size else np.array([1.0, 0.0])
    sd, across = (float(np.linalg.norm(d @ half)) for d in (along, np.array([-along[1], along[0]])))
    return {
        "value": float(size), "sd": sd, "phase": float(np.angle(value)),
        "phase_sd": min(across / size, np.pi) if size else np.pi,
    }  # fmt: skip


def estimate_unbalance(
    machine: Machine,
    responses: Sequence[SynchronousResponse],
    *,
    runout: Mapping[str, complex] | None = None,
) -> Unbalance:
    """Estimate unbalance in planes, what bending modes see beyond it (a wide prior, by the mass times the largest
    motion), and runout of the sensors, given by plane in m where known: generalised least squares over all records,
    whose weights count the noise and the plant's common covariance. Currents see motion by its voltage, no runout; two
    speeds part both by W².
    """
    offsets = dict(runout or {})
    free = [place for place in read_by(machine.model) if place not in offsets]
    names = (*machine.planes, *(f"mode{r}" for r in range(1, machine.beyond + 1)), *free)
    parts = [_Part.of(machine, r, free, offsets) for r in responses]
    A, b = (np.concatenate(x) for x in zip(*((_real_rows(p.X), _real(p.left)) for p in parts), strict=True))
    noise = _block([p.noise_half for p in parts])
    prior, n = _prior(machine, responses, names), len(names)
    u = np.zeros(n, dtype=complex)
    for _ in range(_ROUNDS):
        common = np.concatenate([p.plant_half(machine, u) for p in parts])
        factor = np.linalg.cholesky(noise + common @ common.T)
        rows, right = (np.linalg.solve(factor, x) for x in (A, b))
        axes = directions(np.vstack([rows, prior]))
        x = axes.solve(np.concatenate([right, np.zeros(prior.shape[0])]))
        u = x[:n] + 1j * x[n:]
    freedom = max(b.size - x.size + prior.shape[0], 0)
    misfit = float(np.sum((right - rows @ x) ** 2)) / freedom if freedom else 0.0
    most = _SEEN * _sizes(rows, right, u)
    for row in prior:  # what a prior says alone is not identified
        k = int(np.argmax(row)) % n
        most[k] = min(most[k], 0.5 / row.max())
    return Unbalance(names=names, value=u, half=axes.root(1e-9), most=most, misfit=misfit, freedom=freedom)


def _prior(machine: Machine, responses: Sequence[SynchronousResponse], names: Sequence[str]) -> Array:
    """Return rows over standard deviations for what modes see beyond the planes, (2 n_modes, 2 n)."""
    n, beyond = len(names), machine.beyond
    moved = max(abs(r.of(role)) for r in responses for role in machine.model.outputs[: len(machine.model.sensors)])
    rows = np.zeros((2 * beyond, 2 * n))
    for k in range(beyond):
        size = max(abs(machine.shape(p)[2 + k]) for p in machine.planes) * machine.theta["m"] * moved
        at = len(machine.planes) + k
        rows[2 * k, at] = rows[2 * k + 1, n + at] = 1.0 / (_BEYOND * size)
    return rows


def _sizes(A: Array, b: Array, u: Complex) -> Array:
    """Return of each number the larger of its size and of the size at which it alone would explain the response."""
    n = u.size
    alone = [np.linalg.lstsq(A[:, [k, n + k]], b, rcond=None)[0] for k in range(n)]
    return np.maximum(np.abs(u), [float(np.hypot(*x)) for x in alone])


def read_by(model: RotorModel) -> dict[str, Complex]:
    """Return by sensor plane what its runout exp(j phase) does to the outputs: cos(angle + phase) in x, sin in y."""
    readings: dict[str, Complex] = {}
    for row, (j, k) in enumerate(model.sensors):
        bearing, plane = model.placed[j]
        if plane < 2:
            read = readings.setdefault(bearing.sensor_parameter(k), np.zeros(len(model.outputs), dtype=complex))
            read[row] = 1.0 if plane == 0 else -1j
    return readings


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """What one record says: left = X u + noise."""

    response: SynchronousResponse
    V: Complex  # (n_u,)
    X: Complex  # (n_y, n)
    left: Complex  # (n_y,)
    noise_half: Array  # (2 n_y, 2 n_y)

    @classmethod
    def of(
        cls,
        machine: Machine,
        response: SynchronousResponse,
        free: Sequence[str],
        runout: Mapping[str, complex],
    ) -> _Part:
        model, W, rate = machine.model, response.speed, response.rate_hz
        V, Y = (np.array([response.of(role) for role in roles]) for roles in (model.inputs, model.outputs))
        f, bins = response.noise()
        columns = [[response.roles.index(r) for r in roles] for roles in (model.inputs, model.outputs)]
        H = machine.transfer(np.array([W, *(2.0 * np.pi * f)]), W, rate)
        U_f, Y_f = (bins[:, at] for at in columns)
        e = Y_f - np.einsum("kyu,ku->ky", H[1:], U_f)
        e = np.conj(e) if W < 0 else e
        C = response.inflation[0] * e.T @ np.conj(e) / len(f)
        real = 0.5 * np.block([[C.real, -C.imag], [C.imag, C.real]])
        read = read_by(model)
        X = np.column_stack([machine.forced(W, machine.shapes), *(read[place] for place in free)])
        offset = sum((x * read[place] for place, x in runout.items()), np.zeros(len(model.outputs), dtype=complex))
        return cls(
            response=response, V=V, X=X, left=Y - H[0] @ V - offset,
            noise_half=np.asarray(np.linalg.cholesky(real + 1e-12 * np.diag(np.diag(real)))),
        )  # fmt: skip

    def plant_half(self, machine: Machine, u: Complex) -> Array:
        """Return what one standard deviation along each direction of the plant's covariance does, (2 n_y, n)."""
        W = self.response.speed

        def expected(step: Array) -> Complex:
            moved = machine.moved(step)
            H = moved.transfer(np.array([W]), W, self.response.rate_hz)[0]
            return np.asarray(H @ self.V + moved.forced(W, moved.shapes) @ u[: machine.shapes.shape[1]])

        slopes = [0.5 * (expected(s) - expected(-s)) for s in machine.steps]
        return np.column_stack([_real(x) for x in slopes]) if slopes else np.zeros((2 * self.left.size, 0))


def _real(x: Complex) -> Array:
    return np.concatenate([x.real, x.imag])


def _real_rows(X: Complex) -> Array:
    return np.block([[X.real, -X.imag], [X.imag, X.real]])


def _block(halves: Sequence[Array]) -> Array:
    size = sum(h.shape[0] for h in halves)
    matrix, at = np.zeros((size, size)), 0
    for h in halves:
        matrix[at : at + h.shape[0], at : at + h.shape[0]] = h @ h.T
        at += h.shape[0]
    return matrix


def _spread(half: Array) -> float:
    """Return the rms of both parts of a complex number with covariance half halfᵀ, half (2, k)."""
    return float(np.sqrt(0.5 * np.sum(half**2)))


# --- what is told of it ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class Turned:
    """A record in which the rotor turned: its number and response, its spectra where periodic, and the `controller` K
    of u = F r - K y at the speed, (n_u, n_y), where known.
    """

    record: int
    response: SynchronousResponse
    spectra: PeriodSpectra | None = None
    controller: Complex | None = None

    def own(self, order: int = 1) -> tuple[Complex, Array, bool]:
        """Return amplitudes of inputs and outputs at a harmonic without the response to the excitation, and their sd.

        Where an excited line falls on the harmonic, its part follows from the references there and the response to
        them at neighbouring lines, a parabola over the frequency; without references it stays, and the last is false.
        """
        r, s = self.response, self.spectra
        k, n = r.orders.index(order), sum(not role.endswith("_reference") for role in r.roles)
        a, sd = r.amplitude[k, :n], r.sd(order)[:n]
        if not r.together[k]:
            return a, sd, True
        f = order * abs(r.speed) / (2.0 * np.pi)
        if s is None or s.R is None or s.frequency_hz.size < 2 * _LINES:
            return a, sd, False
        near = np.argsort(np.abs(s.frequency_hz - f))[: 2 * _LINES]
        axes = [role.rsplit("_", 1)[0] for role in r.roles[: s.R.shape[1]]]
        at = [j for j, axis in enumerate(axes) if np.any(s.R[near, j]) and f"{axis}_reference" in r.roles]
        drive = np.array([r.of(f"{axes[j]}_reference", order) for j in at])
        drive = np.conj(drive) if r.speed < 0.0 else drive
        away = (s.frequency_hz[near, None] - f) * s.period / s.rate_hz / _LINES
        A = np.hstack([s.R[near][:, at] * away**p for p in range(3)])
        solve = np.linalg.pinv(A, rcond=1e-9)
        Z = np.hstack([s.mean_u, s.mean_y])[near]
        left = np.sqrt(np.sum(np.abs(Z - A @ (solve @ Z)) ** 2, axis=0) / (near.size - A.shape[1]))
        row = drive @ solve[: len(at)]
        part = row @ Z
        part = np.conj(part) if r.speed < 0.0 else part
        return a - part, np.hypot(sd, float(np.linalg.norm(row)) * left / np.sqrt(2.0)), True

    def loop(self, machine: Machine) -> Complex | None:
        """Return what the feedback makes of a disturbance of the outputs: (I + H K)⁻¹, (n_y, n_y)."""
        if self.controller is None:
            return None
        W = self.response.speed
        H = machine.transfer(np.array([W]), W, self.response.rate_hz)[0]
        K = np.conj(self.controller) if W < 0.0 else self.controller
        return np.asarray(np.linalg.inv(np.eye(H.shape[0]) + H @ K))


def balance_rotor(
    machine: Machine,
    turned: Sequence[Turned],
    *,
    runout: Mapping[str, complex] | None = None,
    clearance: float | None = None,
) -> dict[str, Any]:
    """Return unbalance, runout, influence and a proposal for balancing as `RotorEstimate.synchronous` keeps them;
    `clearance`: radius in m within which the rotor may move.
    """
    marked = [t for t in turned if t.response.rotation.marked]
    runs = marked or [max(turned, key=lambda t: abs(t.response.speed))]
    u = estimate_unbalance(machine, [t.response for t in runs], runout=runout)
    planes = machine.planes
    document: dict[str, Any] = {
        "records": [_record(machine.model, t, clearance) for t in turned],
        "used": [t.record for t in runs],
        "unbalance": _unbalance(machine, u, max(abs(t.response.speed) for t in runs)),
        "runout": {place: u.entry(place) for place in read_by(machine.model) if place in u.names},
        "misfit": u.misfit, "freedom": u.freedom,
    }  # fmt: skip
    unseen = [p for p in planes if not document["unbalance"]["planes"][p]["identifiable"]]
    document["hint"] = _hint(unseen, u, machine, marked=bool(marked), records=len(runs))
    if not unseen:
        document |= _proposal(machine, runs, u)
    return document


def _record(model: RotorModel, t: Turned, clearance: float | None) -> dict[str, Any]:
    """Return the response of one record by role and harmonic, and the orbit in each bearing."""
    r = t.response
    parts = [t.own(order) for order in r.orders]
    response = {
        role: {
            "amplitude": [float(abs(a[k])) for a, _, _ in parts], "phase": [float(np.angle(a[k])) for a, _, _ in parts],
            "sd": [float(sd[k]) for _, sd, _ in parts],
        }
        for k, role in enumerate(r.roles[: parts[0][0].size])
    }  # fmt: skip
    orbits = {}
    for b in model.bearings:
        if len(b.axes) == 2 and not b.axial:
            k = [r.roles.index(f"{axis}_position") for axis in b.axes]
            x, y = (complex(parts[0][0][j]) for j in k)
            forward, backward = abs(x + 1j * y) / 2.0, abs(x - 1j * y) / 2.0
            rest = r.left[:, k] - r.left[:, k].mean(axis=0)
            some = rest[np.linspace(0, rest.shape[0] - 1, min(_SHOWN, rest.shape[0])).astype(int)]
            orbits[b.name] = {
                "major": forward + backward, "minor": abs(forward - backward), "forward": bool(forward >= backward),
                "non_synchronous": float(np.max(np.hypot(*rest.T))), "clearance": clearance,
                "samples": [[float(f"{value:.4g}") for value in row] for row in some.T],
            }  # fmt: skip
    return {
        "record": t.record, "speed": r.speed, "drift": r.rotation.drift, "source": r.rotation.source,
        "orders": list(r.orders), "excitation_apart": all(apart for _, _, apart in parts), "response": response,
        "orbits": orbits,
    }  # fmt: skip


def _unbalance(machine: Machine, u: Unbalance, speed: float) -> dict[str, Any]:
    """Return unbalance by plane, static, modal, and where it would stand in one plane."""
    planes = machine.planes
    value, half = u.part(planes)
    n, z = len(planes), np.array([machine.z(p) for p in planes])
    static = polar(complex(value.sum()), _through(np.ones((1, n), dtype=complex), half))
    static["grade_mm_s"] = 1e3 * static["value"] * speed / machine.theta["m"]
    entry: dict[str, Any] = {
        "planes": {p: {"z": float(z[k]), **u.entry(p)} for k, p in enumerate(planes)},
        "static": static,
        "modes": {name: u.entry(name) for name in u.names if name.startswith("mode")},
    }
    if n == 2:
        # z = Σ z U/Σ U is real where one plane holds all; its slope by the U of a plane is (z_p - z)/Σ U
        at = complex(z @ value / value.sum())
        spread = _through(((z - at) / value.sum())[None, :], half)
        sd = [float(np.linalg.norm(row)) for row in spread]
        entry["one_plane"] = {"z": at.real, "sd": sd[0], "fits": bool(abs(at.imag) < _ONE_PLANE * sd[1])}
    return entry


def _proposal(machine: Machine, runs: Sequence[Turned], u: Unbalance) -> dict[str, Any]:
    """Return influence coefficients, and the masses that leave least vibration, with what they leave."""
    model, planes, sensors = machine.model, machine.planes, read_by(machine.model)
    rows = [k for k in range(len(model.sensors)) if any(x[k] for x in sensors.values())]
    free = [place for place in sensors if place in u.names]
    n = len(u.names) - len(free)
    moved, influence, roles = [], [], []
    for t in runs:
        loop = t.loop(machine)
        if loop is None:  # a rigid rotor is balanced whatever holds it, by as much as is known
            opposite = {p: polar(-complex(u.value[j]), u.part([p])[1]) for j, p in enumerate(planes)}
            return {} if machine.model.n_modes else {"balancing": {"correction": opposite, "vibration": []}}
        X = loop @ machine.forced(t.response.speed, machine.shapes)
        shaken = [(loop - np.eye(loop.shape[0])) @ sensors[p] for p in free]  # by a runout that the loop follows
        moved.append(np.column_stack([X, *shaken])[rows])
        influence += [
            {
                "record": t.record, "plane": p,
                "sensors": {
                    model.outputs[k]: {"value": float(abs(X[k, j])), "phase": float(np.angle(X[k, j]))} for k in rows
                },
            }
            for j, p in enumerate(planes)
        ]  # fmt: skip
        roles += [(t.record, model.outputs[k]) for k in rows]
    M = np.concatenate(moved)
    A = M[:, : len(planes)]
    take = np.linalg.pinv(A) @ M[:, :n]  # what the masses have to undo, in their planes
    correction, half = -take @ u.value[:n], _through(take, u.part(u.names[:n])[1])
    left = M @ u.value + A @ correction
    sd = [float(np.linalg.norm(_through(row[None, :], u.half), 2)) for row in M]  # masses that stay as they are
    return {
        "influence": influence,
        "balancing": {
            "correction": {p: polar(complex(correction[j]), half[[j, len(planes) + j]]) for j, p in enumerate(planes)},
            "vibration": [
                {
                    "record": record, "sensor": role,
                    "before": float(abs(M[k] @ u.value)), "after": float(abs(left[k])),
                    "at_most": float(abs(left[k]) + _CIRCLE_95 * sd[k]),
                }
                for k, (record, role) in enumerate(roles)
            ],
        },
    }  # fmt: skip


def _through(L: Complex, half: Array) -> Array:
    """Return half of the covariance of L u, from that of u, both as real over imaginary parts."""
    return np.asarray(_real_rows(L) @ half)


def _hint(unseen: Sequence[str], u: Unbalance, machine: Machine, *, marked: bool, records: int) -> str:
    """Say what stands against the numbers; empty where nothing does."""
    if unseen and machine.beyond:
        return (
            f"unbalance in {', '.join(unseen)}, what bending modes see and runout cannot be separated: take records "
            "at more speeds, or give the planes in which it stands ([unbalance.X], with [shaft])"
        )
    if unseen:
        more = "a second record at another speed" if records == 1 else "a record at a speed further off"
        return (
            f"unbalance in {', '.join(unseen)} and runout of the sensors cannot be separated: take {more}, log the "
            "voltages, or give the runout in the rig"
        )
    if u.freedom and (u.misfit - 1.0) * np.sqrt(u.freedom / 2.0) > _FAR:
        return (
            f"unbalance and runout leave {u.misfit:.3g} times the noise of the synchronous response: speed, planes or "
            "modes may be wrong, or another force turns with the rotor"
        )
    return "" if marked else "phases count from the first sample: log the angle or pulses to know where the mass is"


# --- trial weights --------------------------------------------------------------------------------------------------


def balance_by_trials(
    base: Mapping[str, Any], trials: Mapping[str, tuple[Mapping[str, Any], float, float]]
) -> dict[str, Any]:
    """Balance a rotor by trial weights: from how each one changed the synchronous motion, without any model.

    Influence coefficients are a = (y_trial - y_base)/u_trial; the correction is the least-squares solution of
    y_base + a u = 0 (Goodman 1964, J. Eng. Ind. 86, 273). Runout is in these motions and is balanced as if it were
    motion: far below a critical speed, take it off before.

    Parameters
    ----------
    base : Mapping
        Entry of ``synchronous["records"]`` of an estimate, without trial weight.
    trials : Mapping of str to (Mapping, float, float)
        By plane such an entry at the same speed, mass times radius in kg m of the trial weight, and its angle in rad.

    Returns
    -------
    dict
        ``influence`` and ``balancing`` as in `RotorEstimate.synchronous`.

    Raises
    ------
    EstimationError
        If the speeds differ by more than 1 %, or the records have no position in common.

    Examples
    --------
    >>> def run(amplitude, phase):
    ...     seen = {"amplitude": [amplitude], "phase": [phase], "sd": [1e-9]}
    ...     return {"record": 0, "speed": 1e3, "orders": [1], "response": {"ax_position": seen}}
    >>> found = balance_by_trials(run(4e-6, 0.0), {"A": (run(6e-6, 0.0), 1e-6, 0.0)})
    >>> add = found["balancing"]["correction"]["A"]
    >>> f"{1e6 * add['value']:.3f} g mm at {add['phase']:.3f} rad"
    '2.000 g mm at 3.142 rad'
    """
    runs = [base, *(run for run, _, _ in trials.values())]
    if any(abs(run["speed"] / base["speed"] - 1.0) > _SAME_SPEED for run in runs):
        speeds_text = ", ".join(f"{run['speed'] * 30.0 / np.pi:.5g}" for run in runs)
        raise EstimationError(
            f"the runs are at {speeds_text} rpm; influence holds at one speed. Repeat them at the same speed"
        )
    roles = [x for x in base["response"] if "_position" in x and all(x in run["response"] for run in runs)]
    if not roles:
        raise EstimationError("the runs have no position in common. Take them with the same sensors")
    weights = np.array([size * np.exp(1j * phase) for _, size, phase in trials.values()])
    responses = [[run["response"][role] for role in roles] for run in runs]
    Y = np.array([[x["amplitude"][0] * np.exp(1j * x["phase"][0]) for x in row] for row in responses])
    sd = np.array([[x["sd"][0] for x in row] for row in responses])

    def solve(Y: Complex) -> tuple[Complex, Complex, Complex]:
        A = ((Y[1:] - Y[0]) / weights[:, None]).T
        add = -np.linalg.pinv(A) @ Y[0]
        return A, add, Y[0] + A @ add

    A, add, left = solve(Y)
    steps = [(k, 1j**part) for k in np.ndindex(Y.shape) for part in (0, 1)]
    slopes = []  # what one standard deviation of each measured number does to the correction
    for k, way in steps:
        moved = Y.copy()
        moved[k] += way * sd[k]
        slopes.append(solve(moved)[1] - add)
    D = np.array(slopes).T
    half = np.concatenate([D.real, D.imag])
    spread = [float(np.linalg.norm(_through(row[None, :], half), 2)) for row in A]
    return {
        "influence": [
            {
                "record": base["record"], "plane": plane,
                "sensors": {
                    role: {"value": float(abs(A[k, j])), "phase": float(np.angle(A[k, j]))}
                    for k, role in enumerate(roles)
                },
            }
            for j, plane in enumerate(trials)
        ],
        "balancing": {
            "correction": {p: polar(complex(add[j]), half[[j, len(trials) + j]]) for j, p in enumerate(trials)},
            "vibration": [
                {
                    "record": base["record"], "sensor": role, "before": float(abs(Y[0, k])),
                    "after": float(abs(left[k])), "at_most": float(abs(left[k]) + _CIRCLE_95 * spread[k]),
                }
                for k, role in enumerate(roles)
            ],
        },
    }  # fmt: skip
