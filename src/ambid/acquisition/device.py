"""What stands at the other end: the contract of all devices (`tests/acquisition/test_conformance.py` holds each to it),
and the values that pass. The host requests, the device decides: it may refuse, and goes to its safe state by itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal, Protocol, Self

from ambid.acquisition.law_words import LawWords
from ambid.arrays import Array
from ambid.errors import DeviceError
from ambid.tracking.blocks import Frame

Mode = Literal["sample", "drive", "levitate"]
State = Literal["idle", "sampling", "driving", "levitating", "fault"]
Kind = Literal["none", "step", "prbs", "table"]
MODES: Mapping[Mode, State] = MappingProxyType({"sample": "sampling", "drive": "driving", "levitate": "levitating"})
"""State that each mode brings about."""
_NO_NUMBERS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column of what a device samples."""

    name: str  # as it stands in the record: the rig's column of that role
    role: str  # ``voltage``, ``current``, ``position``, ``extra``, ``excitation``, ``reference``
    unit: str  # ``"1"`` for counts of the controller, else an SI unit
    # least and largest value that the converter can give: at them it is saturated. None: not known.
    span: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceInfo:
    """Who is there."""

    kind: Literal["serial", "emulated", "simulated", "replay"]
    port: str  # where: a port, a file, or the name of the bench
    rate_hz: float  # samples in one second
    columns: tuple[Column, ...]  # in the order of a block's values
    # what the controller says of itself (message ``identity``); empty where there is none
    identity: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))
    # of an emulated or simulated bench: its linear parameters, SI; empty where nobody knows them
    plant: Mapping[str, float] = field(default_factory=dict)
    real: bool = True  # whether its time runs with the host's; else it goes as fast as possible


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """An excitation as a controller plays it; `acquire.program` makes one from a name, an amplitude and a band."""

    kind: Kind
    amplitude: float = 0.0  # peak, in V at the coil
    hold: int = 1  # ticks per element
    length: int = 1  # elements of the table, or bits of the shift register
    cycles: int = 0  # how often it is played; 0: until it is ended
    seed: int = 1  # start of the shift register
    table: tuple[int, ...] = ()  # elements, -127 to 127


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AxesProgram:
    """An excitation of a rotor, added to the outputs of the controllers of all axes, period after period."""

    kind: str
    amplitude: float  # peak, in the unit of the inputs
    wave: Array  # one period, (n_samples, n_axes)
    unit: str = "V"

    def __str__(self) -> str:
        n, axes = self.wave.shape
        return f"{self.kind} of {self.amplitude:.3g} {self.unit} on {axes} axes, {n} samples a period"


@dataclass(frozen=True, slots=True, kw_only=True)
class LawTrial:
    """A law that a controller is to try while it levitates; `acquisition.settings.law_trial` makes one from a rig."""

    law: LawWords
    low: int  # bounds of the position, counts: outside, the controller returns to what ran before
    high: int
    confirm_ms: int = 3000  # after so long without `Device.confirm` too
    seconds: float = 1.0  # for which it is watched before that


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceEvent:
    """Something that a device told beside its samples, or that stands among them in a recording."""

    # ``fault`` (with its safe state), ``state`` (another change of state), ``law`` (an armed one was
    # given up), ``lost`` (samples that never came),
    # ``damaged`` (frames whose check value was wrong), ``link`` (the line); in a recording ``excitation``, ``note`` too
    kind: str
    what: str  # for a fault the cause (enum ``cause``), for a state its name; else one line for a person
    sample: int | None = None  # number of the sample at which it happened, where that is known
    count: int = 0  # samples or frames concerned


@dataclass(frozen=True, slots=True, kw_only=True)
class Counters:
    """What went over the line since the device was opened. Nothing is lost without being counted here."""

    samples: int = 0  # samples received; samples of which nothing or not all came
    lost: int = 0
    damaged: int = 0  # frames with a wrong CRC, length or code
    discarded_bytes: int = 0  # bytes that belonged to no sound frame
    overruns: int = 0  # blocks that the host itself had no room for
    resent: int = 0  # commands that were sent again for want of an answer
    # what the controller counted: ``overruns``, ``dropped``, ``rx_errors``, ``rx_lost``, ``busy_us``, ``supply_mv``
    controller: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfTest:
    """What a device found in itself."""

    failed: tuple[str, ...]  # one line for each thing that is not as it should be; empty: passed
    # what was measured, e.g. ``supply_mv``, ``position``, ``current`` (counts).
    numbers: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)


class Device(Protocol):
    """A bench that can be asked for samples. Made ready by its constructor's arguments; a context opens and closes it.

    Closing always leaves the bench in its safe state. All methods raise `DeviceError` where the device refuses or the
    line is lost, with what, where, rule and remedy. A replay has mode ``sample`` alone and no excitation; all others
    have all.
    """

    @property
    def info(self) -> DeviceInfo:
        """Who is there; what a controller says of itself after opening."""
        ...

    @property
    def state(self) -> State:
        """The state as last heard."""
        ...

    def __enter__(self) -> Self:
        """Open, identify and configure."""
        ...

    def __exit__(self, kind: object, error: object, trace: object, /) -> None:
        """Stop, and let go."""
        ...

    def self_test(self) -> SelfTest:
        """Let the device look at itself; idle only.

        Returns
        -------
        SelfTest
        """
        ...

    def start(self, mode: Mode) -> None:
        """Begin; numbers of samples count from 0 at the first start out of idle, and on at each later one.

        Parameters
        ----------
        mode : {"sample", "drive", "levitate"}
            From idle; from sampling to one of the others, too.
        """
        ...

    def excite(self, program: Program | AxesProgram | None) -> None:
        """Play an excitation from the next tick on, in place of one that is played; driving or levitating.

        Parameters
        ----------
        program : Program, AxesProgram or None
            None ends it; harmless where none is played.
        """
        ...

    def load(self, program: Program | AxesProgram) -> None:
        """Give the device an excitation beforehand, so that `excite` with the very same begins at once; none is played.

        Parameters
        ----------
        program : Program or AxesProgram
        """
        ...

    def arm(self, trial: LawTrial) -> None:
        """Let another law levitate on trial, from the next tick on; levitating. A return to the old one is an event.

        Parameters
        ----------
        trial : LawTrial
        """
        ...

    def confirm(self) -> None:
        """Keep the law on trial."""
        ...

    def read(self, timeout_s: float) -> Frame | None:
        """Return the next block with its time of arrival, or None if none came in time or the stream has ended.

        ``Block.time_s`` is by the device's clock; a gap in ``Block.first`` is samples that were lost, each counted.
        Where the line is lost, what came before can still be read; then the error is raised.

        Parameters
        ----------
        timeout_s : float
            How long to wait for it, s.

        Returns
        -------
        Frame or None
        """
        ...

    @property
    def ended(self) -> bool:
        """True once nothing more will come: stopped and read to the end, or the replay's last row."""
        ...

    def events(self) -> Sequence[DeviceEvent]:
        """Return what was told since the last call, in its order."""
        ...

    def counters(self) -> Counters:
        """Return what was counted so far."""
        ...

    def stop(self) -> None:
        """Output off, no more samples; those on their way can still be read. Harmless when idle; a fault stays."""
        ...

    def clear(self) -> None:
        """Leave the safe state after a fault whose cause is gone: idle, no more samples."""
        ...


def check_mode(mode: str, where: str) -> None:
    """Refuse a mode that no device has."""
    if mode not in MODES:
        raise DeviceError(f"{where} has no mode {mode!r}; there are {', '.join(MODES)}. Give one of them")
