"""The estimator of a rotor from periodic excitation: rigid start, modes one after the other, noise, feedback (theory.md
sec. 10).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.linear import Directions, directions
from ambid.estimation.progress import Tick, silent
from ambid.estimation.search import Status
from ambid.physics.linear_model import Parameter
from ambid.physics.rotor_model import RotorModel
from ambid.rig.rotor import RigModes
from ambid.rotor.likelihood import Experiment, Likelihood, Point, Weight, minimise, noise_weight, rough_weight
from ambid.rotor.modes import Candidate, scan
from ambid.rotor.scores import other_gain
from ambid.rotor.spectra import joined
from ambid.rotor.start import rigid_start
from ambid.rotor.unknowns import Unknowns

_RELATIVE = 0.03  # error of the model beside noise while it is incomplete
_REFINED = 0.01  # the same, of a model that is complete but for small modes
_UNFIT = 1.3  # mean square of its residuals from which modes are missing
_CLEARLY = 5.0  # times what a mode costs, that it must explain to be clearly there
_FITS = 1.6  # mean square of residuals up to which a band is explained
_WIDER = 1.5  # by which the band grows
_ABOVE = 1.5  # how far above the band a mode may be that shows in it
_CLEAR = 0.5  # part of the residuals that a mode explains, from which no sensor is asked
_FAR_ABOVE = 2.0
_BESIDE = 1.05  # how far a mode may stand from where the rig says, or from the highest line
_LEAST_LINES = 24
_NO_NOISE = 1e-200  # variance below that of any noise, so that none is no division by 0
_MOVES = 1.5  # power of a position at the excited lines, over that of its noise, from which it is moved
_MOST_MODES = 9
_WHOLE = 1e-4  # samples by which a delay may miss a whole number however exact it is: R hardly moves by that
_SAME_SPEED = 0.01  # relative difference of speeds that count as one for the start
_POLAR = np.concatenate([[1e-6], np.geomspace(0.01, 2.0, 32)])  # of Ip over Id, and of gyroscopic terms over w/W
_EDDY_STARTS = tuple(2.0 * np.pi * f for f in (300.0, 1000.0, 3000.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ending:
    """Where a search ended, whichever criterion it was made with."""

    unknowns: Unknowns
    base: Point  # what did not move
    vector: Array
    status: Status
    triangle: Array  # of [J | r], priors included
    band_hz: tuple[float, float]
    speeds: tuple[float, ...]  # of the records, rad/s

    @property
    def model(self) -> RotorModel:
        """The model with its modes."""
        return self.unknowns.model

    @property
    def point(self) -> Point:
        """Numbers by name and delays."""
        theta, delays = self.unknowns.unpack(self.vector, self.base.theta, self.base.delays)
        return Point(theta=theta, delays=delays)

    @property
    def seen(self) -> Directions:
        """Singular directions of the information, priors included."""
        return directions(self.triangle[:, :-1])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RotorFit(Ending):
    """Where the search on period spectra ended."""

    problem: Likelihood
    cost: float


def estimate_rotor(
    experiments: Sequence[Experiment],
    model: RotorModel,
    parameters: Sequence[Parameter],
    *,
    delays: Sequence[float | None],
    modes: RigModes = RigModes(),  # noqa: B008 - a frozen value
    tick: Tick = silent,
) -> RotorFit:
    """Estimate a rotor from records with periodic excitation, the slowest first: their lines together give the start.
    `delays`: of inputs in samples, None: searched; `modes`: how many and where; left open, the likelihood decides.

    A rigid rotor is fitted below the first mode, by linear least squares in the widest band that fits; the band grows,
    and where the fit breaks a scan says which mode is missing (`modes.scan`). On all lines the noise model takes over,
    the likelihood decides on further modes, the feedback is corrected for (`Likelihood.corrected`). Delays that agree
    with whole samples are held there, and the last search is repeated.
    """
    ordered = sorted(experiments, key=lambda e: abs(e.speed))
    if idle := _idle(ordered, model):
        names = ", ".join(idle)
        raise EstimationError(
            f"{names} move no more than their noise, and at rest no other axis moves them. Excite them too, or omit "
            "them from the rig: the others are identified without"
        )
    work = Work(model=model, parameters=parameters, delays=delays, modes=modes, tick=tick)
    return work.finish(ordered, *work.start(ordered))


def unknowns_at(model: RotorModel, parameters: Sequence[Parameter], at: Point, free: Sequence[int]) -> Unknowns:
    """Return the unknowns of a model; sizes of numbers are those of the point; `free`: inputs with unknown delay."""
    span = model.span(at.theta)
    lengths = {p.name for p in model.parameters if p.unit == "m"}
    gyro = {p.name for p in model.mode_parameters if p.name.startswith("gyro.")}
    scales = {n: span if n in lengths else 0.1 if n in gyro else max(abs(x), 1e-9) for n, x in at.theta.items()}
    return Unknowns(model=model, known=tuple(parameters), scales=scales, free_delays=tuple(free))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Work:
    """The steps to an estimate, of which the predictor takes those to start values."""

    model: RotorModel
    parameters: Sequence[Parameter]
    delays: Sequence[float | None]  # of each input in samples, None where it is searched
    modes: RigModes
    tick: Tick

    def rough_start(self, experiments: Sequence[Experiment]) -> tuple[RotorModel, Point]:
        """Return the model with the modes that are clearly there, and its numbers: of spectra whose noise is known."""
        ordered = sorted(experiments, key=lambda e: abs(e.speed))
        return self.refine(ordered, *self.start(ordered))

    def one_more(self, e: Experiment, model: RotorModel, at: Point) -> tuple[RotorModel, Point] | None:
        """Return model and numbers with one mode more, None where the spectra do not ask for it."""
        try:
            at, cost = self.rough([e], model, at, relative=_REFINED)
            more = self.candidate([e], model, at, cost)
        except np.linalg.LinAlgError:  # ran off
            return None
        return None if more is None else _in_order(*more[:2])

    def problem(
        self, experiments: Sequence[Experiment], model: RotorModel, at: Point, weights: Sequence[Weight]
    ) -> Likelihood:
        """Return the criterion at a model."""
        free = tuple(k for k, d in enumerate(self.delays) if d is None)
        unknowns = unknowns_at(model, self.parameters, at, free)
        return Likelihood(unknowns=unknowns, base=at, experiments=experiments, weights=weights)

    def rough(
        self,
        experiments: Sequence[Experiment],
        model: RotorModel,
        at: Point,
        most: int = 25,
        relative: float = _RELATIVE,
    ) -> tuple[Point, float]:
        """Search with a relative error; return the point, and the mean square of the residuals."""
        cost = np.inf
        for _ in range(2):  # the weights follow the scatter at the model
            weights = [rough_weight(e, model, at, relative) for e in experiments]
            problem = self.problem(experiments, model, at, weights)
            at, end = minimise(problem, at, most=most, tolerance=1e-3)
            cost = end.cost / problem.n_real
        return at, cost

    def start(self, ordered: Sequence[Experiment]) -> tuple[RotorModel, Point]:
        """Return model and numbers from the slowest records, then from the others."""
        slowest, slow = _slowest(ordered), replace(self, model=self.model.at_speed(ordered[0].speed))
        first = [_together(slowest)]
        current, at = slow.grow(first, *slow.begin(first))
        if len(ordered) > len(slowest):
            at = self.turn(ordered[len(slowest) :], current, at)
        return current, at

    def begin(self, experiments: Sequence[Experiment]) -> tuple[float, Point]:
        """Return the band in Hz that a rigid rotor explains, and its numbers."""
        f = np.sort(experiments[0].spectra.frequency_hz)
        edges = sorted(
            {float(f[min(_LEAST_LINES, f.size - 1)]), *np.geomspace(f[min(_LEAST_LINES, f.size - 1)], f[-1], 7)}
        )
        tried: list[tuple[float, float, Point]] = []
        eddies = _EDDY_STARTS if "a" in self.model.extras else (None,)
        for edge in edges:
            band = [e.between(0.0, edge * (1.0 + 1e-9)) for e in experiments]
            for eddy in eddies:
                start = rigid_start(band[0], self.model, self.parameters, eddy=eddy)
                delays = [s if d is None else d for d, s in zip(self.delays, start.delays, strict=True)]
                start = replace(start, delays=np.array(delays, dtype=np.float64))
                at, cost = self.rough(band, self.model, start, most=8)
                if np.isfinite(cost):
                    tried.append((edge, cost, at))
            if tried and tried[-1][1] > 30.0 * min(c for _, c, _ in tried):
                break  # far beyond the first mode
        if not tried:
            raise EstimationError(
                "no rigid rotor explains the lowest lines of the record. Check columns, signs, units and planes"
            )
        fits = [t for t in tried if t[1] < _FITS] or [min(tried, key=lambda t: t[1])]
        widest = max(edge for edge, *_ in fits)
        edge, _, at = min((t for t in fits if t[0] == widest), key=lambda t: t[1])
        return edge, at

    def grow(self, experiments: Sequence[Experiment], edge: float, at: Point) -> tuple[RotorModel, Point]:
        """Widen the band to all lines; where the fit breaks, add the mode that the residuals show."""
        model, last = self.model, float(experiments[0].spectra.frequency_hz.max())
        while True:
            band = [e.between(0.0, edge * (1.0 + 1e-9)) for e in experiments]
            self.tick("modes", min(1.0, edge / last))
            at, cost = self.rough(band, model, at)
            while cost > _FITS:
                weight = rough_weight(band[0], model, at, _RELATIVE)
                missing = self.missing(band[0], model, at, weight, _ABOVE, last)
                if missing is None:
                    break
                unclear = missing.gain < _CLEAR * cost * 2 * band[0].spectra.mean_y.size
                if unclear and self._sensors(band, model, at, [weight]) > missing.gain:
                    break
                more = model.with_modes(model.n_modes + 1)
                trial = replace(at, theta=_with_mode(at.theta, more, missing.named(more.n_modes)))
                trial, lower = self.rough(band, more, trial)
                if not lower < 0.9 * cost or _below(trial, band):
                    break
                model, at, cost = more, trial, lower
            if edge >= last:
                return _in_order(model, at)
            above = [r for r in range(1, model.n_modes + 1) if at.theta[f"mode{r}.omega"] > 2.0 * np.pi * edge]
            edge = min(edge * _WIDER, last)
            model, at = _without(model, at, above)  # what was seen from below is found again from within

    def refine(self, experiments: Sequence[Experiment], model: RotorModel, at: Point) -> tuple[RotorModel, Point]:
        """Add the modes without which nothing fits even with a smaller relative error."""
        at, cost = self.rough(experiments, model, at, relative=_REFINED)
        while cost > _UNFIT:
            more = self.candidate(experiments, model, at, cost, _CLEARLY)
            if more is None:
                break
            model, at, cost = more
        return _in_order(model, at)

    def candidate(
        self, experiments: Sequence[Experiment], model: RotorModel, at: Point, cost: float, price: float = 1.0
    ) -> tuple[RotorModel, Point, float] | None:
        """Return the model with the mode that the residuals ask for most, None where it is not worth its `price`."""
        slowest = _together(_slowest(experiments))
        spectra, n_real = slowest.spectra, sum(2 * e.spectra.mean_y.size for e in experiments)
        price *= float(np.log(n_real)) * (3 + len(model.places))
        weight, last = rough_weight(slowest, model, at, _REFINED), float(spectra.frequency_hz.max())
        missing = self.missing(slowest, model, at, weight, _ABOVE, last)
        if missing is None or missing.gain < price:
            return None
        more = model.with_modes(model.n_modes + 1)
        trial = replace(at, theta=_with_mode(at.theta, more, missing.named(more.n_modes)))
        try:
            trial, lower = self.rough(experiments, more, trial, relative=_REFINED)
        except np.linalg.LinAlgError:  # ran off
            return None
        return (more, trial, lower) if (cost - lower) * n_real > price and not _below(trial, experiments) else None

    def turn(self, fast: Sequence[Experiment], model: RotorModel, at: Point) -> Point:
        """Find polar inertia and gyroscopic terms of records at higher speeds by scans of the criterion."""
        theta = dict(at.theta)
        theta.setdefault("Ip", 0.2 * theta["Id"])
        theta |= {p.name: theta.get(p.name, 0.0) for p in model.at_speed(1.0).mode_parameters}
        at, W = replace(at, theta=theta), abs(fast[-1].speed)
        sizes = {} if any(p.name == "Ip" and p.role == "fixed" for p in self.parameters) else {"Ip": theta["Id"]}
        sizes |= {f"gyro.{r}{r}": theta[f"mode{r}.omega"] / W for r in range(1, model.n_modes + 1)}
        for name, size in list(sizes.items()) * 2:
            problem = self.problem(fast, model, at, [rough_weight(e, model, at, _RELATIVE) for e in fast])
            trials = [replace(at, theta={**at.theta, name: float(x * size)}) for x in _POLAR]
            at = min(trials, key=lambda t: replace(problem, base=t).cost(problem.pack(t)))
        return at

    def finish(self, experiments: Sequence[Experiment], model: RotorModel, at: Point) -> RotorFit:
        """Search on all lines with the noise model, decide on further modes, settle the delays."""
        if len(experiments) > 1:  # the start knows the slowest alone
            model = model.at_speed(max((e.speed for e in experiments), key=abs))
            at, _ = self.rough(experiments, model, at)
        fit = self.likely(experiments, model, at)
        while True:
            more = self._one_more(experiments, fit)
            if more is None:
                break
            fit = more
        whole = self._whole(fit)
        if whole is not None:
            delays = tuple(float(x) for x in whole)
            fit = replace(self, delays=delays).likely(
                experiments, fit.model, replace(fit.point, delays=np.array(delays)), fit
            )
        return fit

    def likely(
        self, experiments: Sequence[Experiment], model: RotorModel, at: Point, before: RotorFit | None = None
    ) -> RotorFit:
        """Search with the noise model, which follows it, and correct for feedback; `before`: at a point nearby."""
        self.tick("fit", 0.0)
        converged, cost = False, np.inf if before is None else before.cost
        earlier: Sequence[Weight | None] = [None] * len(experiments) if before is None else before.problem.weights
        for k in range(3):
            weights = [noise_weight(e, model, at, w) for e, w in zip(experiments, earlier, strict=True)]
            earlier = weights
            problem = self.problem(experiments, model, at, weights)
            self.tick("fit", 0.3 * (k + 1))
            at, end = minimise(problem, at, most=40, tolerance=1e-7)
            changed = abs(end.cost / cost - 1.0) if np.isfinite(cost) else np.inf
            converged, cost = end.converged, end.cost
            if changed < 1e-3:
                break
        v, triangle, last = problem.corrected(problem.pack(at))
        f = [e.spectra.frequency_hz for e in experiments]
        return RotorFit(
            unknowns=problem.unknowns, base=problem.base, problem=problem, vector=v, cost=cost,
            status="converged" if converged and last < 0.1 else "stalled",
            triangle=triangle, band_hz=(min(float(x[0]) for x in f), max(float(x[-1]) for x in f)),
            speeds=tuple(e.speed for e in experiments),
        )  # fmt: skip

    def _one_more(self, experiments: Sequence[Experiment], fit: RotorFit) -> RotorFit | None:
        """Return the fit with the mode that the residuals ask for most, None where the likelihood does not want it."""
        slowest = _slowest(experiments)
        e = _together(slowest)
        w = Weight(whiten=np.concatenate([w.whiten for w in fit.problem.weights[: len(slowest)]]))
        missing = self.missing(e, fit.model, fit.point, w, _FAR_ABOVE, float(e.spectra.frequency_hz.max()))
        price = np.log(fit.problem.n_real) * (3 + len(fit.model.places))
        if missing is None or missing.gain < max(price, other_gain(fit.problem, fit.vector)):
            return None
        more = fit.model.with_modes(fit.model.n_modes + 1)
        theta = _with_mode(fit.point.theta, more, missing.named(more.n_modes))
        try:
            trial = self.likely(experiments, *_in_order(more, replace(fit.point, theta=theta)), fit)
        except np.linalg.LinAlgError:  # ran off
            return None
        # Weights follow the model: both are judged by those of the larger one.
        before = replace(fit.problem, weights=trial.problem.weights)
        wanted = before.cost(fit.vector) - trial.cost > price and not _below(trial.point, experiments)
        return trial if wanted else None

    def _sensors(self, band: Sequence[Experiment], model: RotorModel, at: Point, weights: Sequence[Weight]) -> float:
        """Return what a sensor at fault would explain, which no bending mode is to stand in for."""
        problem = self.problem(band[:1], model, at, weights)
        return other_gain(problem, problem.pack(at))

    def _whole(self, fit: RotorFit) -> Array | None:
        """Return the delays where all that are searched agree with whole samples."""
        free = fit.problem.unknowns.free_delays
        if not free:
            return None
        sd = np.sqrt(np.sum(fit.seen.root() ** 2, axis=1))[-len(free) :]
        delays = fit.point.delays
        near = np.abs(delays - np.round(delays))[list(free)]
        return np.round(delays) if np.all(near <= np.maximum(3.0 * sd, _WHOLE)) and np.all(sd < 0.1) else None

    def missing(
        self, e: Experiment, model: RotorModel, at: Point, weight: Weight, above: float, last: float
    ) -> Candidate | None:
        """Return the mode that the residuals ask for, up to `above` times the highest line; first where the rig hints.

        Where as many modes as the rig says are within the excited band, up to `last` Hz, only those above are sought:
        they stand for the rest of the shaft.
        """
        frequencies = [at.theta[f"mode{r}.omega"] / (2.0 * np.pi) for r in range(1, model.n_modes + 1)]
        low, high = float(e.spectra.frequency_hz.min()), above * float(e.spectra.frequency_hz.max())
        if self.modes.count is not None and sum(f <= last for f in frequencies) >= self.modes.count:
            low = max(low, _BESIDE * last)
        if low >= high or model.n_modes >= _MOST_MODES:
            return None
        for f in self.modes.frequency_hz:
            if low <= f <= high and not any(f / _BESIDE < x < f * _BESIDE for x in frequencies):
                candidate = scan(e, model, at, weight, (f / _BESIDE, f * _BESIDE))
                if candidate is not None:
                    return candidate
        return scan(e, model, at, weight, (low, high))


def _below(at: Point, experiments: Sequence[Experiment]) -> bool:
    """Whether a mode ran below the lowest line: nothing of it shows there, and it stands in for something else."""
    low = min(float(e.spectra.omega.min()) for e in experiments)
    return any(x < low for name, x in at.theta.items() if name.startswith("mode") and name.endswith(".omega"))


def _idle(experiments: Sequence[Experiment], model: RotorModel) -> list[str]:
    """Return the axes of the planes that stand still but for noise in all experiments; none where the rotor turns."""
    if any(model.at_speed(e.speed).turning for e in experiments):
        return []
    spectra = [e.spectra for e in experiments]
    noise = [np.maximum(s.scatter[1], _NO_NOISE) / s.n_periods for s in spectra]
    over = np.max([np.mean(np.abs(s.mean_y) ** 2 / n, axis=0) for s, n in zip(spectra, noise, strict=True)], axis=0)
    plane = np.array([p for _, p in model.placed])
    moved = {int(plane[j]) for k, (j, _) in enumerate(model.sensors) if over[k] > _MOVES}
    return [axis for axis, p in zip(model.axes, plane, strict=True) if p not in moved] if moved else []


def _slowest(ordered: Sequence[Experiment]) -> list[Experiment]:
    """Return the first of the experiments, and those at its speed."""
    speed = abs(ordered[0].speed)
    return [e for e in ordered if abs(e.speed) - speed <= _SAME_SPEED * speed]


def _together(experiments: Sequence[Experiment]) -> Experiment:
    """Return experiments at one speed as one."""
    return replace(experiments[0], spectra=joined([e.spectra for e in experiments]))


def _with_mode(theta: Mapping[str, float], model: RotorModel, numbers: Mapping[str, float]) -> dict[str, float]:
    """Return the numbers with those of one more mode; gyroscopic terms with others begin at zero."""
    missing = {p.name: 0.0 for p in model.mode_parameters if p.name not in theta}
    return {**theta, **missing, **{n: x for n, x in numbers.items() if n in missing}}


def _in_order(model: RotorModel, at: Point) -> tuple[RotorModel, Point]:
    """Return the same machine with its modes in order of frequency."""
    order = sorted(range(1, model.n_modes + 1), key=lambda r: at.theta[f"mode{r}.omega"])
    return model, _kept(at, order)


def _without(model: RotorModel, at: Point, modes: Sequence[int]) -> tuple[RotorModel, Point]:
    """Return the machine without some of its modes."""
    order = [r for r in range(1, model.n_modes + 1) if r not in modes]
    return model.with_modes(len(order)), _kept(at, order)


def _kept(at: Point, order: Sequence[int]) -> Point:
    new = {0: 0, **{r: k for k, r in enumerate(order, 1)}}
    theta = {n: x for n, x in at.theta.items() if not n.startswith(("mode", "gyro."))}
    for r in order:
        for n, x in at.theta.items():
            if n.startswith(f"mode{r}."):
                theta[f"mode{new[r]}.{n.split('.', 1)[1]}"] = x
        for s in [0, *order]:
            old = f"gyro.{min(r, s)}{max(r, s)}"
            if old in at.theta:
                theta[f"gyro.{min(new[r], new[s])}{max(new[r], new[s])}"] = at.theta[old]
    return replace(at, theta=theta)
