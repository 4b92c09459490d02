"""The job of recording: a port and a rig in, a record on the disk out, with callbacks for progress."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from ambid.acquisition.device import AxesProgram, Device, Mode
from ambid.acquisition.review import refuse_unstable, review
from ambid.acquisition.session import Acquired, Course, Progress
from ambid.acquisition.session import acquire as record_course
from ambid.acquisition.settings import controller_settings, default_daq_notes, law_trial, with_default_daq
from ambid.acquisition.trials import Trial, band_for, fitting_amplitude
from ambid.control.experiment import Experiment
from ambid.errors import AmbidError, DeviceError, counted
from ambid.estimation.progress import Tick, silent
from ambid.job.data import RigSource, known_rig
from ambid.job.results import experiment_of
from ambid.job.simulation import FRACTION, LEAST_PERIODS, bench_of_source, waves_of_axes
from ambid.physics.presets import Preset
from ambid.record.sampling import MIN_SAMPLES
from ambid.rig import Rig
from ambid.settings.caller import LARGEST, check_band, check_positive, check_whole, refuse_given, setting
from ambid.settings.calls import of_job
from ambid.simulation.rotor_bench import RotorBench

_TRIAL_S = 2.0  # of each trial of an amplitude
_PERIOD_S = 1.0  # of the excitation of a rotor, at most
_SAME_RATE = 1e-3  # a rate from a time column is rounded

Note = Callable[[str], object]


def _mute(_: object) -> None:
    """Say nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """Settings of a recording."""

    seconds: float = 10.0
    excitation: str | Path | Experiment | None = None  # None: nothing is played
    amplitude: float | None = None  # V; None: found by trials, small first
    band: tuple[float, float] | None = None  # Hz
    mode: Mode | None = None  # None: levitate where the rig has a loop
    settle: float | None = None  # s; None: 1 to levitate
    seed: int = 0
    arm: Rig | None = None  # whose loop is tried and kept once the rig's own levitates
    stopped: Callable[[], bool] = field(default=lambda: False)

    def trial(self, port: str, rig: Rig) -> Trial:
        """Check it against port and rig, and complete it."""
        mode = self.mode or _usual_mode(port, rig, self.excitation)
        settle_s = (1.0 if mode == "levitate" else 0.0) if self.settle is None else self.settle
        check_positive({"seconds": self.seconds, "amplitude": self.amplitude})
        if not 0 <= settle_s <= LARGEST:
            raise AmbidError(f"{setting('settle')} is {settle_s:g}; it must be a number, 0 to {LARGEST:g}. Correct it")
        check_whole({"seed": self.seed})
        check_band(self.band)
        named = {"amplitude": self.amplitude, "band": self.band}
        _check_excitation(port, mode, self.excitation, named)
        if (experiment := experiment_of(self.excitation)) is not None and rig.rotor is None:
            refuse_given(named, f"{setting('excitation')} is an experiment, which takes no {{}}. Omit {{}}")
            _ = experiment.program
        return Trial(
            name=str(self.excitation),
            band=self.band,
            mode=mode,
            settle_s=settle_s,
            seconds=self.seconds,
            seed=self.seed,
        )

    def measured(self, rig: Rig) -> Rig:
        """Return the rig with the loop that the record is made with."""
        return rig if self.arm is None else replace(rig, loop=self.arm.loop)

    def course(self, device: Device, rig: Rig, trial: Trial, *, note: Note, tick: Tick) -> Course:
        """Say what the device is to do; find the amplitude of its excitation where none is given."""
        rate_hz = device.info.rate_hz
        samples = max(1, round(trial.seconds * rate_hz))
        if samples < MIN_SAMPLES:
            raise AmbidError(
                f"{setting('seconds')} is {trial.seconds:g}: {counted(samples, 'sample')} at {rate_hz:g} Hz; a "
                "record needs "
                f"at least {MIN_SAMPLES}. Give {MIN_SAMPLES / rate_hz:.3g} or more"
            )
        if self.excitation is None:
            return Course(mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s)
        if rig.rotor is not None:
            return self._of_axes(rig, trial, rate_hz, note)
        if (experiment := experiment_of(self.excitation)) is not None:
            experiment.played(0, rate_hz, closed=trial.mode == "levitate")
            return Course(
                mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s, program=experiment.program
            )  # fmt: skip
        trial = replace(trial, band=band_for(trial, rate_hz))
        known = trial.course(1.0 if self.amplitude is None else self.amplitude, rate_hz)  # refused before all moves
        if self.amplitude is not None:
            return known
        tick("amplitude")
        brief = replace(trial, seconds=_TRIAL_S)
        try:
            brief.course(1.0, rate_hz)
        except AmbidError:  # an excitation of slow periods takes the whole record's length
            brief = trial
        try:
            found = fitting_amplitude(device, rig, brief, stopped=self.stopped)
        except AmbidError:
            if self.stopped():
                raise KeyboardInterrupt from None
            raise
        note(f"amplitude {found:.3g} V, found by trials")
        return trial.course(found, rate_hz)

    def _of_axes(self, rig: Rig, trial: Trial, rate_hz: float, note: Note) -> Course:
        """Return the course of a rotor: an excitation of all axes, of periods of a second, at least four."""
        bench, kind = RotorBench.of(rig, rate_hz, True), str(self.excitation)
        if (experiment := experiment_of(self.excitation)) is not None:
            wave, kind = experiment.played(experiment.period, rate_hz, closed=True), "experiment"
        else:
            if kind == "multisine":
                kind = "zippered"
                note("multisine: its lines are dealt out to the axes (zippered), so that each excites one")
            if kind == "orthogonal":
                raise AmbidError(f"{setting('excitation', kind)} is for several records. Give zippered")
            period = round(min(_PERIOD_S, trial.seconds / LEAST_PERIODS) * rate_hz)
            wave, _ = waves_of_axes(bench, kind, period, 1, None, self.band, self.seed)
            peak = self.amplitude
            if peak is None:
                peak = bench.largest(np.tile(wave, (2, 1)), self.seed, FRACTION)
                note(f"amplitude {peak:.3g} V, half of what the limits allow by the rig's own numbers")
            wave = peak * wave
        program = AxesProgram(
            kind=kind, amplitude=float(np.abs(wave).max()), wave=wave, unit=bench.model.units[bench.model.inputs[0]]
        )
        return Course(mode=trial.mode, seconds=trial.seconds, settle_s=trial.settle_s, program=program)


@of_job("acquire")
def acquire(
    port: str,
    rig: RigSource,
    out: str | Path,
    *,
    seconds: float = 10.0,
    excitation: str | Path | Experiment | None = None,
    amplitude: float | None = None,
    band: tuple[float, float] | None = None,
    mode: Mode | None = None,
    settle: float | None = None,
    bench: str | Path | Rig | Preset | None = None,
    pace: Literal["fastest", "real-time"] = "fastest",
    seed: int = 0,
    arm: RigSource | None = None,
    force: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    on_note: Note = _mute,
    on_progress: Callable[[Progress], object] = _mute,
    on_trouble: Callable[[DeviceError], object] = _mute,
    tick: Tick | None = None,
) -> Acquired:
    """Record what a controller samples: it keeps the rotor levitated, plays the excitation and protects the bench.

    Parameters
    ----------
    port : str
        A serial port, ``"emulated"`` (the firmware on an emulated controller before a simulated bench),
        ``"simulated"`` (a simulated bench alone, or a rotor in its bearings), or ``"replay:FILE"``.
    rig : Rig, path, dict or TOML text
        Calibrations, ``[loop]``, ``[daq]``.
    out : str or Path
        Record to write: .h5, .hdf5, .csv or .csv.gz. A journal beside it holds what came so far.
    seconds : float, optional
        Length of the record in s.
    excitation : {"multisine", "schroeder", "prbs", "steps"}, Path or Experiment, optional
        Signal that the controller adds to its output; default none. Or what `ambid.design_experiment` designed for a
        rig with ``[daq]`` or a rotor, or its file. Of a simulated rotor, as of `ambid.simulate`: ``multisine`` is then
        ``zippered``.
    amplitude : float, optional
        Peak of the excitation in V; default: found by trials, smallest first; of a simulated rotor half of what the
        limits allow.
    band : (float, float), optional
        Band of the excitation in Hz; default: where the rotor moves, or what the controller can play.
    mode : {"sample", "drive", "levitate"}, optional
        Output off; excitation without feedback; position loop on the controller. Default levitate where the rig has a
        loop, sample a replay.
    settle : float, optional
        Time after the start that is not recorded, in s; default 1 to levitate.
    bench : str, Path, Rig or Preset, optional
        Plant behind an emulated or simulated controller; default daq.bench of the rig, or its own values.
    pace : {"fastest", "real-time"}, optional
        Speed of an emulated, simulated or replayed device.
    seed : int, optional
        Seed of excitation and simulated noise.
    arm : Rig, str or Path, optional
        Whose ``[loop]`` the controller is to try, once it levitates by that of `rig`, and to keep: the record is made
        with it. Where the rotor moves more than half way to a trip meanwhile, the controller returns to what it ran.
    force : bool, optional
        Overwrite an existing record, and close a loop that is predicted unstable.
    stopped : callable, optional
        Called now and then; the run ends when it returns True.
    on_note, on_progress, on_trouble, tick : callable, optional
        Called with a remark, with the progress, with trouble of the disk, and with the name of the present stage.

    Returns
    -------
    Acquired
        Its `record` is what was written, also when a fault ended the run early (see ``run.fault``).

    Raises
    ------
    AmbidError
        If port, rig or settings break a rule, a loop is predicted unstable, or the device or the disk fails.

    Examples
    --------
    >>> import ambid
    >>> done = ambid.acquire("simulated", "bench.toml", "run.h5", seconds=5.0, excitation="prbs")  # doctest: +SKIP
    >>> ambid.identify(done.record, "bench.toml")  # doctest: +SKIP
    """
    known, path = known_rig(rig), Path(out)
    wanted = Request(
        seconds=seconds, excitation=excitation, amplitude=amplitude, band=band, mode=mode, settle=settle, seed=seed,
        stopped=stopped, arm=None if arm is None else known_rig(arm),
    )  # fmt: skip
    wanted.trial(port, known)
    if (path.exists() or path.is_symlink()) and not force:
        raise AmbidError(
            f"{setting('out')} {path} already exists. Choose another name, or give {setting('force', True)}"
        )
    with ready(port, known, wanted, bench=bench, pace=pace, force=force, note=on_note, tick=tick) as (device, course):
        return record_course(
            device,
            wanted.measured(known),
            path,
            course,
            force=force,
            on_progress=on_progress,
            on_trouble=on_trouble,
            stopped=stopped,
        )


@contextmanager
def ready(
    port: str,
    rig: Rig,
    wanted: Request,
    *,
    bench: str | Path | Rig | Preset | None,
    pace: Literal["fastest", "real-time"],
    force: bool,
    note: Note,
    tick: Tick | None,
    minded: Callable[[Device], AbstractContextManager[Device]] = nullcontext,
) -> Iterator[tuple[Device, Course]]:
    """Open a device, say what it is to do, and close it; arguments as those of `acquire`. `minded`: in which the device
    is used, trials of an amplitude too.
    """
    trial, say = wanted.trial(port, rig), tick or silent
    closes = trial.mode == "levitate" and not force
    if wanted.arm is not None and trial.mode != "levitate":
        raise AmbidError(
            f"{setting('arm')} tries a loop while the rotor levitates, and the mode is {trial.mode}. Omit "
            f"{setting('arm')}"
        )
    if wanted.arm is not None and port == "simulated":
        raise AmbidError(
            f"{setting('arm')} is tried by the firmware alone. Give {setting('port', 'emulated')}, or a serial port"
        )
    opening = opened(port, rig, bench=bench, pace=pace, seed=wanted.seed, closes=closes, note=note)
    with opening as bare, minded(bare) as device:
        course = wanted.course(device, rig, trial, note=note, tick=say)
        if wanted.arm is not None:
            complete = with_default_daq(rig) if port in ("emulated", "simulated") else rig
            course = replace(course, trial=law_trial(complete, wanted.arm))
            if closes:
                refuse_unstable(wanted.measured(rig), device.info)
        say("record")
        yield device, course


@contextmanager
def opened(
    port: str,
    rig: Rig,
    *,
    bench: str | Path | Rig | Preset | None,
    pace: Literal["fastest", "real-time"],
    seed: int,
    closes: bool,
    note: Note,
) -> Iterator[Device]:
    """Open a device, idle, and close it. `bench`, `pace`, `seed`: plant, pace and noise of one that is no hardware;
    `closes`: a loop is to be closed that has to be stable.
    """
    from ambid.acquisition.devices import open_device

    behind, invented = None if bench is None else bench_of_source(bench), port in ("emulated", "simulated")
    rotor = rig.rotor is not None
    complete = with_default_daq(rig) if invented and not rotor else rig
    for line in default_daq_notes(rig) if invented and not rotor else ():
        note(line)
    made = open_device(port, rig, bench=behind, pace="real" if pace == "real-time" else "fastest", seed=seed)
    if closes and rotor:
        RotorBench.of(rig, made.info.rate_hz, True).refuse_unstable()
    elif closes:
        refuse_unstable(rig, made.info)
    with made as device:
        if port.startswith("replay:"):
            notes = _replay_notes(device, rig)
        else:
            settings = None if rotor else controller_settings(complete)
            notes = () if settings is None else review(complete, settings, parameters=device.info.plant)
        for line in notes:
            note(line)
        yield device


def _usual_mode(port: str, rig: Rig, excitation: object) -> Mode:
    """Choose what a device does where the user does not say."""
    if port.startswith("replay:"):
        return "sample"
    if rig.rotor is not None or (rig.loop is not None and rig.loop.closed and not rig.open_loop):
        return "levitate"
    return "sample" if excitation is None else "drive"


def _check_excitation(port: str, mode: Mode, name: object, given: Mapping[str, object]) -> None:
    """Refuse an excitation that cannot be played, and what is `given` of one where none is named."""
    if name is None:
        refuse_given(given, f"{{}} is for an excitation, and none was named. Give {setting('excitation')}, or omit it")
    elif port.startswith("replay:"):
        raise AmbidError(f"{setting('excitation')} cannot act on a replayed record. Omit it")
    elif mode == "sample":
        raise AmbidError(
            f"{setting('mode', 'sample')} keeps the output off: nothing can be excited. Omit "
            f"{setting('excitation')}, or give {setting('mode', 'drive')}"
        )


def _replay_notes(device: Device, rig: Rig) -> tuple[str, ...]:
    """Say where a record that is replayed has another rate than the rig: it keeps its own."""
    rate = device.info.rate_hz
    wanted = rig.daq.rate_hz if rig.daq is not None else rig.record.rate_hz
    if device.info.kind != "replay" or wanted is None or math.isclose(rate, wanted, rel_tol=_SAME_RATE):
        return ()
    return (
        f"{device.info.port} was recorded at {rate:.6g} Hz, which is kept; the rig says {wanted:g} Hz. Make sure "
        "that both are of the same bench",
    )
