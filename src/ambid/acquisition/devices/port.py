"""The port: a serial line that is ours alone, opened with a remedy in each refusal.

Whoever can read and write bytes is a port; the rest of the link does not know what is behind it.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Protocol

from ambid.errors import DeviceError, nearest

if TYPE_CHECKING:
    import serial

_WAIT_S = 0.005  # a read ends after this with what is there: bytes are taken in bundles, not one by one
_WRITE_S = 2.0  # a line that takes no bytes for so long is lost
_LARGEST = 65536  # bytes of one read
_PSEUDO = ("/dev/pts/", "/dev/ttys0", "/dev/pty")  # terminals without a board behind them


class PortEnded(OSError):
    """What stood behind a port has ended, and no cable brings it back; its text says all."""


class Port(Protocol):
    """A line of bytes in both directions. All methods but `read` and `write` may be called from any thread."""

    @property
    def name(self) -> str:
        """Where it is."""
        ...

    def read(self) -> bytes:
        """Return the bytes that have come; none if none came within some milliseconds. `OSError`: the line is lost."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; one thread at a time. `OSError`: the line is lost."""
        ...

    def close(self) -> None:
        """Let go; again is harmless."""
        ...


class SerialPort:
    """A serial port or pseudo-terminal through pyserial.

    `line`: open; `name`: where it is.
    """

    def __init__(self, line: serial.Serial, name: str) -> None:
        self._line, self._name = line, name

    @property
    def name(self) -> str:
        """Where it is."""
        return self._name

    def read(self) -> bytes:
        """Return the bytes that have come.

        Returns empty if none came within some milliseconds.
        """
        try:
            return bytes(self._line.read(_LARGEST))
        except (TypeError, ValueError) as failure:  # pyserial's answer to a descriptor that was closed meanwhile
            raise OSError(errno.EBADF, f"closed while reading: {failure}") from None

    def write(self, data: bytes) -> None:
        """Send bytes."""
        try:
            self._line.write(data)
        except (TypeError, ValueError) as failure:
            raise OSError(errno.EBADF, f"closed while writing: {failure}") from None

    def close(self) -> None:
        """Let go; again is harmless."""
        with suppress(OSError):  # the line is gone: there is nothing left to let go
            self._line.close()


def open_port(name: str, *, baud: int, boot_s: float | None = None) -> SerialPort:
    """Open a serial port for this program alone.

    `name`: such as ``/dev/ttyACM0`` or ``COM3``; `baud`: bits per second. Returns ready; bytes from before are
    discarded.
    """
    try:
        import serial
    except ImportError:
        raise DeviceError(
            f"port {name}: the package pyserial is not installed, and serial ports need it."
            " Install it with: pip install 'ambid[daq]'"
        ) from None
    line = serial.Serial()
    try:
        line.port, line.baudrate = name, baud
        line.timeout, line.write_timeout, line.exclusive = _WAIT_S, _WRITE_S, True
        line.open()
    except _lost(ValueError) as failure:  # SerialException is an OSError
        line.close()
        raise DeviceError(_refusal(name, baud, failure)) from None
    try:
        _hurry(line)
        wait = (0.0 if name.startswith(_PSEUDO) else 2.0) if boot_s is None else boot_s
        _sit_out(line, wait)
    except _lost() as failure:
        line.close()
        raise DeviceError(f"port {name} was lost while its board started ({failure}). Plug it in again") from None
    except BaseException:
        line.close()
        raise
    return SerialPort(line, name)


def candidate_ports() -> Sequence[str]:
    """Return the serial ports of this machine that have a device behind them, those of USB first.

    Returns name and description of each; empty without pyserial.
    """
    try:
        from serial.tools import list_ports
    except ImportError:
        return ()
    found = sorted(list_ports.comports(), key=lambda p: (p.vid is None, p.device))
    # A PC announces serial ports that have no connector: they have no hardware id.
    return tuple(f"{p.device} ({p.description})" for p in found if p.vid is not None or p.hwid not in (None, "n/a"))


def _lost(*others: type[Exception]) -> tuple[type[Exception], ...]:
    """What a line that is gone raises: on POSIX also termios.error, which is no OSError."""
    try:
        import termios
    except ImportError:
        return (OSError, *others)
    return (OSError, termios.error, *others)


def _hurry(line: Any) -> None:
    """Ask the driver not to collect bytes for 16 ms; many have no such setting, and go well without."""
    with suppress(OSError, ValueError, AttributeError, NotImplementedError):
        line.set_low_latency_mode(True)


def _sit_out(line: Any, boot_s: float) -> None:
    """Wait in silence: a boot loader that hears bytes stays longer."""
    end = time.monotonic() + boot_s
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(left, 0.1))
    line.reset_input_buffer()


def _refusal(name: str, baud: int, failure: Exception) -> str:
    """Turn the operating system's refusal into what, rule and remedy."""
    code, text = getattr(failure, "errno", None), str(failure)
    if code == errno.EACCES or "PermissionError" in text or "Permission denied" in text or "Access is denied" in text:
        return (
            f"port {name} may not be opened by this user, or another program has it; a serial port belongs to the group"
            " that owns it. On Linux: sudo usermod -a -G dialout $USER, then log in again; elsewhere close the other"
            " program"
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text or "busy" in text.lower():
        return (
            f"port {name} is busy: another program has it open, and a controller obeys one host alone. Close the other"
            " program, e.g. a serial monitor"
        )
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or "FileNotFoundError" in text:
        known = candidate_ports()
        meant = "" if "/" in name else nearest(name.lower(), ("emulated", "simulated", "replay:FILE"))
        if not known:
            return f"port {name} does not exist; no serial port with a device is there.{meant} Plug the board in"
        return (
            f"port {name} does not exist; there are {'; '.join(known)}.{meant} Plug the board in, or give one of these"
        )
    if isinstance(failure, ValueError) or "baud" in text.lower():
        return f"port {name} cannot go at {baud} baud ({text}). Give the daq.baud of the firmware, or another adapter"
    return f"port {name} cannot be opened ({text}). Check the name and the cable"
