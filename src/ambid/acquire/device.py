"""What stands at the other end: the contract of all devices, and the values that pass between them and the host.

The host requests, the controller decides: a device may refuse what it is asked, and goes to its safe state by itself.
Four implementations keep to this contract: serial hardware, the emulated controller, a simulated bench, a replayed
record; ``tests/acquire/test_conformance.py`` holds each to it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType, TracebackType
from typing import Literal, Protocol, Self

from ambid.track.stream.block import Frame

Mode = Literal["sample", "drive", "levitate"]
State = Literal["idle", "sampling", "driving", "levitating", "fault"]
Kind = Literal["none", "step", "prbs", "table"]
_NO_NUMBERS: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """One column of what a device samples.

    Attributes
    ----------
    name : str
        As it stands in the record: the rig's column of that role.
    role : str
        ``voltage``, ``current``, ``position``, ``extra``, ``excitation``, ``reference``.
    unit : str
        ``"1"`` for counts of the controller, else an SI unit.
    span : (float, float) or None
        Least and largest value that the converter can give: at them it is saturated. None: not known.
    """

    name: str
    role: str
    unit: str
    span: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceInfo:
    """Who is there.

    Attributes
    ----------
    kind : {"serial", "emulated", "simulated", "replay"}
    port : str
        Where: a port, a file, or the name of the bench.
    rate_hz : float
        Samples in one second.
    columns : tuple of Column
        In the order of a block's values.
    identity : Mapping of str to int
        What the controller says of itself (message ``identity``); empty where there is none.
    """

    kind: Literal["serial", "emulated", "simulated", "replay"]
    port: str
    rate_hz: float
    columns: tuple[Column, ...]
    identity: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """An excitation as a controller plays it; `acquire.program` makes one from a name, an amplitude and a band.

    Attributes
    ----------
    kind : {"none", "step", "prbs", "table"}
    amplitude : float
        Peak, in V at the coil.
    hold : int
        Ticks per element.
    length : int
        Elements of the table, or bits of the shift register.
    cycles : int
        How often it is played; 0: until it is ended.
    seed : int
        Start of the shift register.
    table : tuple of int
        Elements, -127 to 127.
    """

    kind: Kind
    amplitude: float = 0.0
    hold: int = 1
    length: int = 1
    cycles: int = 0
    seed: int = 1
    table: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceEvent:
    """Something that a device told beside its samples.

    Attributes
    ----------
    kind : {"fault", "state", "lost", "damaged", "link"}
        A fault with its safe state, another change of state, samples that never came, frames whose check value was
        wrong, or the state of the line.
    sample : int or None
        Number of the sample at which it happened, where that is known.
    what : str
        For a fault the cause (enum ``cause``), for a state its name; else one line for a person.
    count : int
        Samples or frames concerned.
    """

    kind: Literal["fault", "state", "lost", "damaged", "link"]
    sample: int | None
    what: str
    count: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Counters:
    """What went over the line since the device was opened. Nothing is lost without being counted here.

    Attributes
    ----------
    samples, lost : int
        Samples received; samples of which nothing or not all came.
    damaged : int
        Frames with a wrong CRC, length or code.
    discarded_bytes : int
        Bytes that belonged to no sound frame.
    overruns : int
        Blocks that the host itself had no room for.
    resent : int
        Commands that were sent again for want of an answer.
    controller : Mapping of str to float
        What the controller counted: ``overruns``, ``dropped``, ``rx_errors``, ``rx_lost``, ``busy_us``, ``supply_mv``.
    drift : float
        Of the controller's clock against the host's, relative; NaN while unknown.
    drift_sd : float
        Its standard deviation.
    """

    samples: int = 0
    lost: int = 0
    damaged: int = 0
    discarded_bytes: int = 0
    overruns: int = 0
    resent: int = 0
    controller: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)
    drift: float = float("nan")
    drift_sd: float = float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfTest:
    """What a device found in itself.

    Attributes
    ----------
    failed : tuple of str
        One line for each thing that is not as it should be; empty: passed.
    numbers : Mapping of str to float
        What was measured, e.g. ``supply_mv``, ``position``, ``current`` (counts).
    """

    failed: tuple[str, ...]
    numbers: Mapping[str, float] = field(default_factory=lambda: _NO_NUMBERS)


class Device(Protocol):
    """A bench that can be asked for samples. Made ready by its constructor's arguments; a context opens and closes it.

    Closing always leaves the bench in its safe state, whatever happened before. All methods raise `DeviceError` where
    the device refuses or the line is lost, with what, where, rule and remedy. A replay has mode ``sample`` alone, and
    refuses every excitation. Every other device has all modes.
    """

    @property
    def info(self) -> DeviceInfo:
        """Who is there; after opening."""
        ...

    @property
    def state(self) -> State:
        """The state as last heard."""
        ...

    def __enter__(self) -> Self:
        """Open, identify and configure."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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

    def excite(self, program: Program | None) -> None:
        """Play an excitation from the next tick on, in place of one that is played; driving or levitating.

        Parameters
        ----------
        program : Program or None
            None ends it; harmless where none is played.
        """
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
