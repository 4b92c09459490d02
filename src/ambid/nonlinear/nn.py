"""State-space network from records (thesis eqs 5.1-5.2, fig. 5.9): its weights are A and B, beside a network G(x, u).

Delay -> subspace start -> the thesis's training and Gauss-Newton (learning curves) -> Levenberg-Marquardt on simulation
errors -> hidden layer (option) -> predictor gain for coloured errors -> covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.progress import Tick, part_of, portions
from ambid.nonlinear.fit import NonlinearFit, Settings, choice, read_settings, whole
from ambid.nonlinear.records import scaled_records
from ambid.nonlinear.state_start import (
    LARGEST,
    NO_START,
    SHORT,
    find_delay,
    first_network,
    guess_delay,
    matrices_json,
    train_one_step,
)  # fmt: skip
from ambid.nonlinear.state_training import (
    Fitting,
    State,
    add_gain,
    add_units,
    finish,
    is_white,
    misfit,
    train,
    train_each,
)  # fmt: skip

_USUAL: Mapping[str, object] = {"neurons": 0, "starts": 3}
_UNITS = {"m": 0, "m/s": 1, "A": 2}
_LONG = (20, 30)  # samples of past for the first model of plants that a short one does not show
_MORE = 2  # states beyond the outputs, for the delay
_LARGEST = 5  # states beyond the outputs that are tried
_PATIENCE = 2  # states beyond the best, after which no more are tried
_DELAY, _TRAINING = (0.0, 0.15), (0.15, 1.0)  # shares of the time


@dataclass(frozen=True, slots=True, kw_only=True)
class NnSettings:
    """Settings of a state-space network."""

    form: str = choice(
        "one-axis (entries of thesis eq. 4.8), free, auto (one-axis where units are V, m, A); auto",
        *("auto", "one-axis", "free"),
    )
    states: int | None = whole("of the form free; chosen by Bayes' criterion. one-axis has 3", 1, 20)
    delay: int | None = whole(
        "delay of the inputs in samples; auto (0 to 20, by the errors of short trainings)", 0, 1000
    )
    neurons: int | None = whole("hidden units of G(x, u); 0", 0, 40)
    starts: int | None = whole("random starts of G; 3", 1, 20)
    noise: str = choice(
        "output, innovations (predictor gain), auto (gain where errors are not white); auto",
        *("auto", "output", "innovations"),
    )
    descent: int = whole("iterations of the thesis's steepest descent, for comparison; 10", 0, 10_000, 10)
    iterations: int = whole("of each training, at most; 50", 1, 2000, 50)
    uncertainty: str = choice(
        "laplace, sandwich (coloured errors), none, auto (sandwich if not white); auto",
        *("auto", "laplace", "sandwich", "none"),
    )


Linear = Callable[[IOData, int], "Mapping[str, float] | None"]
"""From a record and the delay of its input to the weights of thesis eq. 4.8 and the predictor gain by name, SI, as
another method finds them.
"""


def nn(
    records: Sequence[IOData], settings: Settings, *, seed: int = 0, tick: Tick | None = None,
    linear: Linear | None = None,
) -> NonlinearFit:  # fmt: skip
    """Train a state-space network whose weights are A and B (thesis eqs 5.1-5.2, fig. 5.9; with G(x, u): eq. 4.9),
    consistent under feedback as far as the predictor gain holds the noise. In the form ``one-axis`` (position, current
    and perhaps velocity from a voltage) they are entries of thesis eq. 4.8;
    states of ``free``, started from subspace models of several horizons, have no fixed meaning, and nothing bounds the
    entries. Of the form ``one-axis`` a `linear` estimate is one more start, as a local minimum may have nearly the
    right errors.
    """
    chosen = {k: v for k, v in asdict(read_settings(NnSettings, "nn", settings)).items() if v is not None}
    s: dict[str, Any] = {**_USUAL, **chosen}
    data = scaled_records("nn", records, lag=40 + int(s.get("delay", 0)))
    requested, first = str(s["form"]), records[0]
    units = [first.units.get(x) for x in first.outputs]
    fits = (
        [first.units.get(x) for x in first.inputs] == ["V"]
        and {"m", "A"} <= set(units) <= set(_UNITS)
        and len(set(units)) == len(units)
    )
    if requested == "one-axis" and not fits:
        raise EstimationError(
            "nn: form one-axis needs one input in V and outputs in m and A (and m/s); here "
            f"{', '.join(f'{x} [{first.units.get(x)}]' for x in (*first.inputs, *first.outputs))}. Choose form free"
        )
    s["form"] = "one-axis" if fits and requested != "free" else "free"
    fitting = Fitting(structure="nn", records=records, settings=s, seed=seed, whole=data, data=data)
    reason = NO_START
    try:
        reason = _start(fitting, tick)
        if not reason:
            _train_all(fitting, part_of(tick, *_TRAINING))
            if linear is not None and s["form"] == "one-axis" and not s["neurons"]:
                _train_again(fitting, linear)
        _caution(fitting)
    except KeyboardInterrupt:
        fitting.interrupt()
        if reason in ("", NO_START):
            reason = "interrupted before there was a network"
    except np.linalg.LinAlgError as error:
        reason = f"the training failed: {error}"
        fitting.state = None
    state = fitting.state
    if state is not None and s["form"] == "free":
        m = state.layout.matrices(state.theta)
        fitting.details["continuous"] = matrices_json(state.layout, m.A, m.B, sampled=True)
    return finish(fitting, reason)


def _heads(fitting: Fitting) -> tuple[int, ...]:
    first = fitting.records[0]
    return tuple(_UNITS[first.units[x]] for x in first.outputs)


# --- start -----------------------------------------------------------------------------------------------------------


def _start(fitting: Fitting, tick: Tick | None) -> str:
    """Find the delay and a first network; return the reason where there is none."""
    requested = fitting.settings.get("delay")
    with fitting.stage("start"):
        fitting.shift(guess_delay(fitting.whole) if requested is None else int(requested))
        reason = _find_first(fitting)
    if requested is not None or fitting.state is None:
        return reason
    with fitting.stage("delay"):
        begun: State | str = fitting.state
        if fitting.counts_states:  # more than are needed: fewer would pass for a delay
            begun = first_network(fitting.data, fitting.dt, fitting.data.n_outputs + _MORE)
        if isinstance(begun, str):
            return reason
        before = fitting.delay
        _find_delay(fitting, begun, part_of(tick, *_DELAY))
        if fitting.delay != before:
            fitting.state = None
            reason = _find_first(fitting)
    return reason


def _find_delay(fitting: Fitting, state: State, tick: Tick | None) -> None:
    """Find the delay by short trainings from a first network."""
    fitting.shift(find_delay(state, fitting.whole, fitting.delay, tick, rather_late=fitting.counts_states))
    if fitting.delay == LARGEST:
        fitting.warnings.append(
            f"the delay that fits best is the largest looked for, {LARGEST} samples: give delay if inputs act later"
        )


def _find_first(fitting: Fitting) -> str:
    """Find a first network; return the reason where there is none."""
    reason, data, s = "", fitting.data, fitting.settings
    for past in (SHORT, *_LONG):
        heads = _heads(fitting) if s["form"] == "one-axis" else ()
        network = first_network(data, fitting.dt, 3 if heads else s.get("states") or data.n_outputs, heads, past)
        if isinstance(network, str):
            reason = reason or network
            continue
        if fitting.state is None or network.score < fitting.state.score:
            fitting.state = network
        if network.widen(gain=False).simulates(data):
            break
        reason = reason or NO_START
    return "" if fitting.state is not None else reason


# --- training --------------------------------------------------------------------------------------------------------


def _train_all(fitting: Fitting, tick: Tick | None) -> None:
    """Train the first network: number of states, the thesis's `descent`, physics, hidden layer, gain."""
    s, data = fitting.settings, fitting.data
    most = int(s["iterations"])
    choice, physics, hidden, gain = portions(
        tick, (_LARGEST * fitting.counts_states, 3, 3 * int(s["starts"]) * (s["neurons"] > 0), 3)
    )
    assert fitting.state is not None
    if fitting.counts_states:
        p = data.n_outputs
        starts = {n: first_network(data, fitting.dt, n) for n in range(p, p + _LARGEST + 1)}
        fitting.state = _choose_states(fitting, starts, choice) or fitting.state
    first = fitting.state
    if s["descent"]:
        with fitting.stage("one-step training"):
            curves, fitting.details["one_step_training"] = train_one_step(first, data, int(s["descent"]))
            fitting.curves.extend(curves)
    with fitting.stage("training"):
        if s["noise"] == "output" or (s["noise"] == "auto" and first.stable):
            bare = first.widen(gain=False)
            train(bare, data, stage="simulation errors", iterations=most, tick=physics, fitting=fitting)
        if s["neurons"]:
            neurons = int(s["neurons"])
            begun = [add_units(fitting.state, neurons, [fitting.seed, k]) for k in range(int(s["starts"]))]
            trained = train_each(begun, data, hidden, stage="hidden layer", iterations=most, fitting=fitting)
            fitting.rivals = [x.state for x in trained]
        _train_gain(fitting, first, gain)


def _train_again(fitting: Fitting, linear: Linear) -> None:
    """Train the physics once more from another method's estimate, and keep what is likelier."""
    before, data = fitting.state, fitting.data
    weights = linear(max(fitting.records, key=lambda x: x.n_samples), fitting.delay)
    if before is None or weights is None:
        return
    bare = before.widen(gain=False)
    layout, size = bare.layout, np.array(bare.layout.scale)
    theta = np.array([weights.get(name, 0.0) for name in layout.names]) / layout.unit  # constants of no mean
    begun = State.of(layout, theta, data)
    if before.layout.gain:
        gains = [(i, j) for i in range(layout.n) for j in range(layout.p)]
        K = [weights.get(f"k{i + 1}{j + 1}", 0.0) * size[layout.heads[j]] / size[i] for i, j in gains]
        begun = replace(begun.widen(gain=True), theta=np.concatenate([theta, K]))
    with fitting.stage("training"):
        train(begun, data, stage="second start", iterations=int(fitting.settings["iterations"]), fitting=fitting)


def _train_gain(fitting: Fitting, first: State, tick: Tick | None) -> None:
    """Go on with a predictor gain where the simulation errors are not white (the simplest noise that does)."""
    state, data, noise = fitting.state, fitting.data, fitting.settings["noise"]
    assert state is not None
    if noise == "output" or (noise == "auto" and not state.layout.gain and is_white(state, data)):
        return
    wide = state if state.layout.gain else add_gain(state, data, first.K)
    if wide is None:
        fitting.warnings.append("no predictor gain was found that keeps the predictor finite")
        return
    most = int(fitting.settings["iterations"])
    train(wide, data, stage="prediction errors", iterations=most, tick=tick, fitting=fitting)


def _choose_states(fitting: Fitting, starts: Mapping[int, State | str], tick: Tick | None) -> State | None:
    """The network of the number of states best by Bayes' criterion; `starts`: by that number."""
    best: State | None = None
    values: list[dict[str, Any]] = []
    for (n, begun), own in zip(starts.items(), portions(tick, [1.0] * len(starts)), strict=True):
        trained = (
            train(begun, fitting.data, stage="choice of states", iterations=6, tick=own)
            if isinstance(begun, State)
            else None
        )
        if trained is None:
            continue
        at = trained.state
        values.append({"states": n, "bic": at.bic})
        if best is None or at.bic < best.bic:
            best = at
        elif n >= best.layout.n + _PATIENCE:
            break
    fitting.details["tried_states"] = values
    return best


def _caution(fitting: Fitting) -> None:
    """Warn where a linear regression finds more in the errors than chance puts there."""
    left = None if fitting.state is None else misfit(fitting.state, fitting.data)
    if left is None or not left.suspect:
        return
    fitting.warnings.append(
        f"{left}: the training ended in a local minimum, or the plant is more complex than this network. Check "
        "channels, their signs and units, and the delay; or take more starts or neurons"
    )
