"""The frequency-domain job: one record in, one measured frequency response out, with a model fitted to it if wanted.

Read -> cut -> measure -> fit -> Measured. With a rig, columns are its roles and physical parameters come out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from ambid.arrays import Array
from ambid.bearing.frequency import FrequencyEstimate
from ambid.bearing.measured import Measured
from ambid.blackbox.data import IOData, Orders, orders_of
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.mode_starts import MOST_DAMPED
from ambid.blackbox.model import Offsets
from ambid.blackbox.modes import find_modes
from ambid.errors import EstimationError
from ambid.estimation.linear import one_thread
from ambid.estimation.modes import Modal, plant_modes
from ambid.estimation.progress import Tick, silent
from ambid.job.data import Channels, Clock, Names, RigSource, Source
from ambid.job.results import load_result, rig_of
from ambid.physics.linear_model import model
from ambid.record import Channel, GapPolicy, Record
from ambid.rig import Rig, bench_record
from ambid.settings.caller import check_band, setting
from ambid.settings.calls import of_job
from ambid.signals.frf import Method, frequency_response, repeats
from ambid.signals.response import FrequencyResponse, Hold
from ambid.signals.response_files import is_response_file, read_response
from ambid.units import UNKNOWN, parse_unit

Delay = float | Literal["auto"]


@of_job("frf")
def frf(
    record: Source,
    input: Names | None = None,  # noqa: A002 - the words of the command
    output: Names | None = None,
    *,
    reference: Names | None = None,
    rig: RigSource | None = None,
    open_loop: bool = False,
    method: Method = "auto",
    hold: Hold | None = None,
    band: tuple[float, float] | None = None,
    orders: Orders | str | None = None,
    state_space: int | Literal["auto"] | None = None,
    feedthrough: bool = False,
    modes: int | Literal["auto"] | None = None,
    estimate: Any = None,
    domain: Literal["s", "z"] | None = None,
    delay: Delay | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: GapPolicy | None = None,
    units: Mapping[str, str] | None = None,
    layout: Mapping[str, str] | None = None,
    tick: Tick | None = None,
) -> Measured:
    """Measure a frequency response from one record, and fit models to it; find the modes of vibration.

    Parameters
    ----------
    record : file, Record, DataFrame, Dataset or dict of arrays
        Or a file of frequency responses: UFF/UNV dataset 58, or CSV whose first column is a frequency.
    input, output, reference : str or sequence of str, optional
        Names of channels. With references (the loop's outer excitation) the joint method is used, which feedback does
        not bias.
    rig : Rig, path, dict or TOML text, optional
        Names and calibrates the channels; physical parameters of its model are estimated.
    open_loop : bool, optional
        Declare the record open loop.
    method : {"auto", "periodic", "random", "local"}, optional
        As in `ambid.signals.frequency_response`. Periodic: leading periods with a transient are left out, and said so.
    hold : {"zoh", "band-limited"}, optional
        What the inputs do between samples. Default zoh; band-limited, as a continuous plant, for a file of responses.
    band : (float, float), optional
        Lines that are kept, in Hz.
    orders : str or Mapping[str, int, "auto" or tuple of int], optional
        ``nf`` and ``nb`` of transfer functions (``"nf=4,nb=3"``), fitted by maximum likelihood.
    state_space : int or "auto", optional
        Order of a state space, fitted by subspace with the Laguerre operator. Not together with `orders`.
    feedthrough : bool, optional
        Whether that state space has a direct path D; in z, one within a sample.
    modes : int or "auto", optional
        Find so many modes, or all that the record shows: poles common to all outputs, by maximum likelihood on the
        record's own spectrum. Without `band`, those where the input has power.
    estimate : result, str or Path, optional
        With `modes`: a physical estimate whose modes stand beside those found, with the modal assurance criterion.
    domain : {"s", "z"}, optional
        Of that model; default z for transfer functions of a held input, else s.
    delay : float or "auto", s, optional
        Of the inputs. Default: 0 for the black-box models, the rig's for physical parameters. "auto" estimates it (not
        for a state space).
    from_s, to_s, rate_hz, gaps, units, layout : optional
        As `ambid.identify`.
    tick : callable, optional
        Called with the name of the present stage; may raise to interrupt.

    Returns
    -------
    Measured

    Raises
    ------
    AmbidError
        If record, rig, channels or orders break a rule.
    EstimationError
        If the response cannot be measured, or a model not be fitted to it.
    """
    say, clock, channels = tick or silent, Clock(), Channels.of(
        input=input, output=output, reference=reference, open_loop=open_loop, rate_hz=rate_hz, gaps=gaps, units=units,
        rig=rig, layout=layout,
    )  # fmt: skip
    check_band(band)
    bench, wanted = channels.rig, orders_of(orders)
    if bench is not None and bench.rotor is not None:
        raise EstimationError(
            f"{setting('rig')} of a rotor on many axes is for 'ambid identify', not for a frequency response. Name "
            "columns by "
            f"{setting('input')} and {setting('output')} instead"
        )
    if orders is not None and wanted is None:
        raise EstimationError(
            f"{setting('orders', 'auto')}: a transfer function needs its degree. Give nf=2, or "
            f"{setting('state_space', 'auto')}"
        )
    _check(wanted, state_space, feedthrough, domain, delay, bench)
    _check_modes(modes, estimate)
    known = None if estimate is None else _plant_of(estimate)
    if is_response_file(record):
        for word, given in (
            ("method", method != "auto"), ("modes", modes is not None), ("from_s", from_s is not None),
            ("to_s", to_s is not None), ("gaps", gaps is not None), ("units", units is not None),
        ):  # fmt: skip
            if given:
                raise EstimationError(
                    f"{setting(word)} is for records in time; {record} holds frequency responses. Omit it"
                )
        say("measure")
        response, about = _from_file(Path(str(record)), channels, hold or "band-limited")
        response = response if band is None else response.between(*band)
        clock.lap("read")
        offsets = Offsets(u=np.zeros(response.n_inputs), y=np.zeros(response.n_outputs))
        return _judged(
            response, channels, about, offsets, clock, say, wanted, state_space, feedthrough, domain, delay, modal=None
        )
    if bench is None and not channels.inputs:
        raise EstimationError(f"no input was named; a response needs at least one. Give {setting('input', 'COLUMN')}")
    data = channels.read(record, (from_s, to_s))
    clock.lap("read")
    modal: Modal | None = None
    if modes is not None:
        modal = _beside(find_modes(data, modes, band=band, tick=say), known)
        clock.lap("modes")
        band = modal.band_hz
    say("measure")
    response = _measure(data, method, hold or "zoh", band, leave_out=modes is not None)
    clock.lap("measure")
    offsets = Offsets(u=data.u.mean(axis=0), y=data.y.mean(axis=0))
    told = replace(channels, references=data.references, open_loop=data.open_loop)
    return _judged(
        response, told, data.record, offsets, clock, say, wanted, state_space, feedthrough, domain, delay, modal=modal
    )


def _judged(
    response: FrequencyResponse, channels: Channels, record: Mapping[str, object], offsets: Offsets, clock: Clock,
    say: Tick, orders: Orders | None, state_space: int | Literal["auto"] | None, feedthrough: bool,
    domain: Literal["s", "z"] | None, delay: Delay | None, *, modal: Modal | None,
) -> Measured:  # fmt: skip
    """Fit the wanted models to a response, and put the result together."""
    found: BlackBoxFit | None = None
    physical: FrequencyEstimate | None = None
    if orders is not None or state_space is not None:
        say("fit")
        late = 0.0 if delay is None else delay
        found = _fit_model(response, record, offsets, orders, state_space, feedthrough, domain, late)
        clock.lap("fit")
    if channels.rig is not None:
        say("identify")
        physical = _identify(response, channels.rig, delay)
        clock.lap("identify")
    return Measured(
        response=response, references=channels.references, open_loop=channels.open_loop, fit=found, estimate=physical,
        modal=modal, record=record, timing_s=clock.laps,
    )  # fmt: skip


def _from_file(path: Path, channels: Channels, hold: Hold) -> tuple[FrequencyResponse, dict[str, object]]:
    """Read a response from a file; with a rig it is named by role and calibrated, for which a gain is enough."""
    rig, words = channels.rig, {"references": channels.references, "layout": channels.layout, "hold": hold}
    rate = channels.rate_hz
    if rig is None:
        found, about = read_response(
            path,
            inputs=channels.inputs,
            outputs=channels.outputs,
            rate_hz=rate,
            **words,  # type: ignore[arg-type]
        )
        return found, about
    columns = {c.role: c for c in rig.channels}
    plant = rig.plant

    def named(wanted: Sequence[str], every: Sequence[str]) -> dict[str, str]:
        roles = {c.column: role for role, c in columns.items() if role in every} | {x: x for x in every}
        for name in wanted:
            if name not in roles:
                raise EstimationError(
                    f"{name!r} is no channel of the rig's model; it has {', '.join(every)}. Correct it"
                )
        return {columns[role].column: role for role in dict.fromkeys([roles[x] for x in wanted] or every)}

    inputs, outputs = named(channels.inputs, plant.inputs), named(channels.outputs, plant.outputs)
    words["layout"] = {**rig.record.layout, **(channels.layout or {})}
    found, about = read_response(
        path,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        rate_hz=rig.record.rate_hz if rate is None else rate,
        **words,  # type: ignore[arg-type]
    )
    names = inputs | outputs
    used = [columns[role] for role in names.values()]
    for c in used:
        if (c.calibration is not None and c.calibration.raw is not None) or (c.role in plant.outputs and c.delay != 0):
            raise EstimationError(
                f"channels.{c.role} has a table or a delay, which no response shows. Give a gain, or omit it"
            )
    ramp, told = np.arange(8.0), cast(Mapping[str, str], about["units"])
    lines = tuple(_ramp(x, told[x], ramp) for x in names)
    bench = bench_record(Record(rate_hz=found.rate_hz, channels=lines), replace(rig, channels=tuple(used)))
    gain = {c.name: float(np.ptp(bench[names[c.name]].values) / np.ptp(c.values)) for c in lines}
    rising = {c.name: float(np.sign(bench[names[c.name]].values[-1] - bench[names[c.name]].values[0])) for c in lines}
    scale = np.array([[rising[o] * gain[o] / (rising[i] * gain[i]) for i in found.inputs] for o in found.outputs])
    flat = scale.ravel()
    units = {role: bench[role].unit for role in names.values()}
    return replace(
        found, G=found.G * scale, covariance=found.covariance * flat[:, None] * flat[None, :], units=units,
        inputs=tuple(names[x] for x in found.inputs), outputs=tuple(names[x] for x in found.outputs),
    ), about  # fmt: skip


def _ramp(name: str, unit: str, ramp: Array) -> Channel:
    """Return a channel of which a rig shows its gain."""
    if unit == UNKNOWN:
        return Channel(name=name, unit=UNKNOWN, values=ramp, source_unit=UNKNOWN)
    known = parse_unit(unit)
    return Channel(name=name, unit=known.si, values=known.to_si(ramp), source_unit=known.symbol)


def _check(
    orders: object, state_space: object, feedthrough: bool, domain: str | None, delay: Delay | None, rig: object
) -> None:
    """Refuse what contradicts itself before the record is read."""
    if orders is not None and state_space is not None:
        raise EstimationError(
            f"both a transfer function and a state space were requested. Give {setting('orders')} or "
            f"{setting('state_space')}"
        )
    if state_space is not None and state_space != "auto" and (not isinstance(state_space, int) or state_space < 1):
        raise EstimationError(f"the state-space order is {state_space}; it must be at least 1, or 'auto'. Correct it")
    if orders is None and state_space is None and domain is not None:
        raise EstimationError(
            f"{setting('domain')} is for {setting('orders')} and {setting('state_space')}; neither was given. Omit it"
        )
    if feedthrough and state_space is None:
        raise EstimationError(
            f"{setting('feedthrough')} is for {setting('state_space')} ({setting('orders')} has it with nb = nf + "
            "1). Omit it"
        )
    if state_space is not None and delay == "auto":
        raise EstimationError(
            f"a state space needs a known delay, not 'auto'. Give {setting('delay', 'S')}; {setting('orders')} or "
            f"{setting('rig')} can find it"
        )
    if delay is not None and orders is None and state_space is None and rig is None:
        raise EstimationError(
            f"{setting('delay')} is for a model; none was requested. Give {setting('orders')}, "
            f"{setting('state_space')} or {setting('rig')} too"
        )
    if isinstance(delay, float | int) and not (np.isfinite(delay) and delay >= 0):
        raise EstimationError(
            f"the delay is {delay} s; it must be zero or positive, or 'auto'. Correct {setting('delay')}"
        )


def _plant_of(estimate: Any) -> Any:
    """Return an estimate that has a plant."""
    found = load_result(estimate) if isinstance(estimate, str | Path) else estimate
    if not (hasattr(found, "continuous") and hasattr(found, "fit")):
        raise EstimationError("the estimate has no plant whose modes could be compared. Give one of 'ambid identify'")
    return found


def _beside(modal: Modal, estimate: Any) -> Modal:
    """Put the modes of an estimate's plant beside those found, its outputs named as in the record."""
    if estimate is None:
        return modal
    names = list(estimate.fit)
    if not set(names) & set(modal.outputs):
        rig = rig_of(estimate, "the estimate")
        names = [rig.channel(role).column for role in names]
    plant = estimate.continuous
    return modal.beside(plant_modes(plant.A, plant.C, names, modal.band_hz, MOST_DAMPED))


def _check_modes(modes: object, estimate: object) -> None:
    if estimate is not None and modes is None:
        raise EstimationError(
            f"{setting('estimate')} is for {setting('modes')}; none were requested. Give {setting('modes', 'auto')} too"
        )
    if modes is not None and modes != "auto" and (isinstance(modes, bool) or not isinstance(modes, int) or modes < 1):
        raise EstimationError(
            f"{modes!r} modes were requested; it must be at least 1, or 'auto'. Correct {setting('modes')}"
        )


def _measure(
    data: IOData, method: Method, hold: Hold, band: tuple[float, float] | None, *, leave_out: bool
) -> FrequencyResponse:
    """Measure the response by the wanted method, in the wanted band."""
    r = data.reference if data.references else None
    if method == "auto":
        method = "periodic" if repeats(data.u if r is None else r) else "local"
    options: dict[str, object] = {"drop_periods": "auto"} if method == "periodic" else {}
    if method == "local":
        options["leave_out"] = leave_out
        if band is not None:
            options["band"] = band
    units = {x: data.units[x] for x in (*data.inputs, *data.outputs)}
    with one_thread():
        found = frequency_response(
            data.u, data.y, 1.0 / data.dt, r=r, method=method, open_loop=data.open_loop, hold=hold,
            inputs=data.inputs, outputs=data.outputs, units=units, **options,
        )  # fmt: skip
    return found if band is None else found.between(*band)


def _fit_model(
    response: FrequencyResponse,
    record: Mapping[str, object],
    offsets: Offsets,
    orders: Orders | None,
    state_space: int | Literal["auto"] | None,
    feedthrough: bool,
    domain: Literal["s", "z"] | None,
    delay: Delay,
) -> BlackBoxFit:
    """Fit the black-box model; its operating point is that of the record, which a response does not show."""
    from ambid.blackbox.frequency import frf_ml
    from ambid.blackbox.frequency_subspace import frf_subspace

    if orders is not None:
        found = frf_ml(response, orders, domain=domain, delay=delay)
    else:
        assert state_space is not None
        assert delay != "auto"
        found = frf_subspace(response, {"n": state_space}, domain=domain or "s", delay=delay, feedthrough=feedthrough)
    return replace(
        found,
        offsets=offsets,
        record={**record, **found.record},
        details={**found.details, "offsets": "means of the record; a frequency response does not contain them"},
    )


def _identify(response: FrequencyResponse, rig: Rig, delay: Delay | None) -> FrequencyEstimate:
    """Estimate the rig's parameters; a delay in s is so many samples."""
    from ambid.bearing.frequency import greybox_frf
    from ambid.estimation.calibration import left_out

    plant = model(rig.model)
    known: Delay = rig.channel(plant.inputs[0]).delay if delay is None else delay
    if delay is not None and known != "auto":
        known = float(known) * response.rate_hz
    found = greybox_frf(response, plant, rig.parameters, delay=known)
    return replace(found, warnings=(*found.warnings, *left_out(rig)))
