"""The very firmware, its binary run by ``firmware/build/amb_bench`` (libsimavr) of a checkout, no part of the installed
package, before a simulated bearing, behind a pseudo-terminal: a process found, built, started and always ended.
"""

from __future__ import annotations

import atexit
import json
import os
import select
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from ambid.acquisition.devices.benches import bench_of, plant_text
from ambid.acquisition.devices.controller import Port, PortEnded, open_port
from ambid.acquisition.devices.line_device import LineDevice
from ambid.acquisition.devices.played import Pace, check_pace
from ambid.acquisition.settings import is_made_up, with_default_daq
from ambid.errors import DeviceError
from ambid.physics.presets import Preset
from ambid.rig.rig import Rig

INSTALL = "apt-get install gcc-avr avr-libc libsimavr-dev"
"""What a Debian machine needs besides a C compiler and make."""

_PREFIX = "ambid-emulated-"
_ANSWER_S = 2.0  # a busy machine may hold the emulator up
_UNREAD_S = 0.25  # of the controller's time
_LOOK_S = 0.001
_GONE_S = 1.0  # between the end of a line and that of its program
_START_S = 60.0  # only ends a hang; a loaded machine may be slow
_END_S = 10.0
_AVR = b"\x53\x00"  # machine of an ELF file, little-endian


def find_program() -> Path:
    """Return what ``AMBID_BENCH`` names, else ``firmware/build/amb_bench``, built first where its sources are newer."""
    return _find("AMBID_BENCH", "amb_bench", "bench", ("bench",))


def find_firmware() -> Path:
    """Return the ELF file in ``AMBID_FIRMWARE``, else ``firmware/build/amb_daq.elf``, built first where sources are
    newer.
    """
    return _find("AMBID_FIRMWARE", "amb_daq.elf", "firmware", ("amb_daq",))


class Emulator:
    """The firmware in an emulated controller before a simulated bench: a context, ended when it is left.

    `plant`: a file or its text, see `plant_text`; `script`: what happens meanwhile, lines or a file; `pace`: as fast as
    possible, or the wall clock. After the start, `port` is the pseudo-terminal and `pid` the process.
    """

    def __init__(
        self,
        plant: str | Path,
        *,
        firmware: Path | None = None,
        program: Path | None = None,
        script: str | Path | None = None,
        pace: Pace = "fastest",
        lockstep_ms: float = 100.0,
        seed: int = 0,
        folder: Path | None = None,
        trajectory: bool = False,
    ) -> None:
        self._plant, self._firmware, self._program, self._script = plant, firmware, program, script
        self._options = {"pace": pace, "lockstep": repr(float(lockstep_ms)), "seed": str(seed)}
        self._folder = folder
        self._temporary = folder is None
        self._trajectory = trajectory
        self._process: subprocess.Popen[bytes] | None = None
        self.port = ""
        self.pid = 0

    @property
    def log_path(self) -> Path:
        """The log: a JSON object per line, ``t`` in s of emulated time and ``event``."""
        return self._place() / "bench.jsonl"

    @property
    def trajectory_path(self) -> Path:
        """The trajectory, complete once the bench has ended."""
        return self._place() / "trajectory.csv"

    @property
    def running(self) -> bool:
        """True while the process lives."""
        return self._process is not None and self._process.poll() is None

    def __enter__(self) -> Self:
        """Start it."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End it, whatever happened."""
        self.close()

    def start(self) -> None:
        """Start the process and wait until its port is there."""
        if self._process is not None:
            return
        program, firmware = self._program or find_program(), self._firmware or find_firmware()
        _check_firmware(firmware)
        folder = self._place()
        folder.mkdir(parents=True, exist_ok=True)
        plant = _as_file(self._plant, folder / "plant.txt")
        options = {"firmware": str(firmware), "plant": str(plant), "log": str(self.log_path)} | self._options
        if self._script is not None:
            options["script"] = str(_as_file(self._script, folder / "script.txt"))
        if self._trajectory:
            options["trajectory"] = str(self.trajectory_path)
        command = [str(program), *(word for name, x in options.items() for word in (f"--{name}", x))]
        atexit.register(self.close)
        with self._said_path().open("wb") as errors:
            try:
                self._process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, start_new_session=True
                )
            except OSError as failure:
                raise DeviceError(
                    f"emulated bench: {program} cannot be started: {failure.strerror or failure}. Build it with 'make"
                    " firmware', or correct AMBID_BENCH"
                ) from None
        self.pid = self._process.pid
        try:
            self.port = self._read_port(self._process)
        except BaseException:
            self.close(keep=True)
            raise

    def close(self, *, keep: bool = False) -> None:
        """End the process, wait for it, and remove the temporary folder unless told to keep it."""
        atexit.unregister(self.close)
        process, self._process = self._process, None
        if process is not None:
            _end(process)
            if process.stdout is not None:
                process.stdout.close()
        if self._temporary and self._folder is not None and not keep:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def ended(self, timeout_s: float) -> str | None:
        """Return how the process ended by itself within `timeout_s`; None where it runs, or was never started."""
        if self._process is None:
            return None
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        return f"{_way(code)}: {errors}" if (errors := self.said()) else _way(code)

    def events(self, name: str | None = None) -> list[dict[str, Any]]:
        """Return what the log says so far, each with ``t`` in s of emulated time and ``event``, one of ``start``,
        ``host``, ``enable``, ``script``, ``stop``, ``reset``, ``end``: all, or those of a name.
        """
        if self._folder is None or not self.log_path.exists():
            return []
        lines = self.log_path.read_text(encoding="utf-8").splitlines(keepends=True)
        events = [json.loads(line) for line in lines if line.endswith("\n")]
        return [e for e in events if name is None or e["event"] == name]

    def said(self) -> str:
        """Return what the program wrote on its standard error."""
        path = self._said_path()
        return path.read_text(encoding="utf-8", errors="replace").strip() if path.exists() else ""

    def _place(self) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        return self._folder

    def _said_path(self) -> Path:
        return self._place() / "bench.err"

    def _read_port(self, process: subprocess.Popen[bytes]) -> str:
        """Return the port that the program tells in its one line, within the time limit."""
        assert process.stdout is not None
        text, last = b"", time.monotonic() + _START_S
        while not text.endswith(b"\n") and (left := last - time.monotonic()) > 0.0:
            if not select.select([process.stdout], [], [], left)[0]:
                break
            piece = os.read(process.stdout.fileno(), 4096)
            if not piece:
                break
            text += piece
        if not text.endswith(b"\n"):
            code = _end(process)
            raise DeviceError(
                f"emulated bench: it ended {_way(code)} before its port was there: {self.said() or 'without a word'}."
                " Correct what it names"
            )
        try:
            return str(json.loads(text)["pty"])
        except (ValueError, TypeError, KeyError):
            raise DeviceError(
                f"emulated bench: {process.args[0]!r} said {text[:80]!r} instead of its port; it is not the bench of"  # type: ignore[index]
                " this firmware. Correct AMBID_BENCH, or build it with 'make firmware'"
            ) from None


def _as_file(source: str | Path, path: Path) -> Path:
    """Return a file as it is given, or write its lines down."""
    if isinstance(source, Path):
        return source
    path.write_text(source + "\n", encoding="utf-8")
    return path


def _end(process: subprocess.Popen[bytes]) -> int:
    """Ask, wait, kill if need be, and take the process off the system's list."""
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    return process.returncode


def _way(code: int) -> str:
    """Say how a process ended."""
    if code >= 0:
        return f"with {code}"
    try:
        return f"by signal {-code} ({signal.Signals(-code).name})"
    except ValueError:
        return f"by signal {-code}"


def _check_firmware(path: Path) -> None:
    """Refuse a program of another machine, on which the emulator's library crashes; of other files it tells itself."""
    try:
        with path.open("rb") as file:
            head = file.read(20)
    except OSError:
        return
    if head[:4] == b"\x7fELF" and (len(head) < 20 or head[18:20] != _AVR):
        raise DeviceError(
            f"emulated bench: firmware {path} is a program, but not of an AVR controller. Build the firmware with 'make"
            " firmware', or correct AMBID_FIRMWARE"
        )


def _find(variable: str, name: str, target: str, sources: tuple[str, ...]) -> Path:
    setting = os.environ.get(variable)
    if setting:
        path = Path(setting)
        if not path.is_file():
            raise DeviceError(f"emulated bench: {variable} names {setting}; there is no such file. Correct or unset it")
        return path
    firmware = Path(__file__).resolve().parents[4] / "firmware"
    built = firmware / "build" / name
    files = [p for s in sources for p in (firmware / s).glob("*.[ch]")]
    if not files:
        raise DeviceError(
            f"emulated bench: there is no {name} here, nor the sources to build it from; they are in a checkout of the"
            f" project, not in the installed package. Work in a checkout, or set {variable}"
        )
    newest = max(p.stat().st_mtime for p in [*files, firmware / "Makefile"])
    if built.is_file() and built.stat().st_mtime >= newest:
        return built
    _make(firmware, target)
    return built


def _make(firmware: Path, target: str) -> None:
    """Build a target, one process at a time."""
    import fcntl

    (firmware / "build").mkdir(exist_ok=True)
    if shutil.which("make") is None:
        raise DeviceError(f"emulated bench: it is to be built and there is no make. Install it: {INSTALL} make")
    with (firmware / "build" / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(["make", "-s", "-C", str(firmware), target], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line and not line.startswith("make")]
        what = lines[0] if lines else f"make ended with {done.returncode}"
        raise DeviceError(
            f"emulated bench: 'make -C firmware {target}' failed: {what}. If a tool is missing: {INSTALL}"
        )


class _EmulatedPort:
    """A port from which nothing is taken while nobody wants it, and that says how the bench behind it ended."""

    def __init__(self, port: Port, emulator: Emulator, paused: Callable[[], bool]) -> None:
        self._port, self._emulator, self._paused = port, emulator, paused

    @property
    def name(self) -> str:
        return self._port.name

    def read(self) -> bytes:
        if self._paused():
            time.sleep(_LOOK_S)
            return b""
        try:
            return self._port.read()
        except OSError as failure:
            raise self._why(failure) from None

    def write(self, data: bytes) -> None:
        try:
            self._port.write(data)
        except OSError as failure:
            raise self._why(failure) from None

    def _why(self, failure: OSError) -> OSError:
        how = self._emulator.ended(_GONE_S)
        return failure if how is None else PortEnded(f"the emulated bench ended {how}. Start again")

    def close(self) -> None:
        self._port.close()


class EmulatedDevice(LineDevice):
    """The firmware in an emulated controller. Everything but the copper is real: binary, converter, line, protocol.

    As fast as possible, its time is not the host's: it waits for a silent host and for a reader a quarter of a second
    behind. `bench`: the truth, by default daq.bench, else the rig's own numbers; `script`: see
    `Emulator`; `emulator`: the process while the device is open, whose log says what happened.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        bench: Preset | Rig | None = None,
        pace: Pace = "fastest",
        seed: int = 0,
        script: str | Path | None = None,
    ) -> None:
        check_pace(pace)
        full = with_default_daq(rig)
        super().__init__(
            full, kind="emulated", where="emulated", si=is_made_up(rig, full), real=pace == "real", answer_s=_ANSWER_S
        )
        self._bench, self._pace, self._seed, self._script = bench, pace, seed, script
        self._info = replace(self._info, plant=bench_of(full, bench).parameters)
        self.emulator: Emulator | None = None

    def _open(self) -> Port:
        plant = plant_text(self._rig, bench=self._bench)
        self.emulator = Emulator(plant, script=self._script, pace=self._pace, seed=self._seed)
        self.emulator.start()
        assert self._rig.daq is not None  # it was made up at the latest
        port = open_port(self.emulator.port, baud=self._rig.daq.baud, boot_s=0.0)
        return _EmulatedPort(port, self.emulator, self._paused)

    def _paused(self) -> bool:
        # Bytes that are not taken hold the emulator up. An answer that is waited for may stand behind them.
        controller = self._controller
        full = self._stream.frames.held > _UNREAD_S * self._info.rate_hz
        return not self._real and full and controller is not None and not controller.asking

    def _let_go(self) -> None:
        emulator, self.emulator = self.emulator, None
        if emulator is not None:
            emulator.close()
