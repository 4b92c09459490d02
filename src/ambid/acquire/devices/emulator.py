"""The emulated bench as a process: found, built where that is possible, started, and always ended.

The program is ``firmware/build/amb_bench`` of a checkout (libsimavr runs the firmware's own binary against a simulated
bearing, behind a pseudo-terminal); it is no part of the installed package.
"""

from __future__ import annotations

import atexit
import json
import os
import select
import shutil
import signal
import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from ambid.acquire.devices.plant_file import TemporaryFolder
from ambid.errors import DeviceError

INSTALL = "apt-get install gcc-avr avr-libc libsimavr-dev"
"""What a Debian machine needs besides a C compiler and make."""

_START_S = 60.0  # only ends a hang; a loaded machine may be slow
_END_S = 10.0
_AVR = b"\x53\x00"  # machine of an ELF file, little-endian


def find_program() -> Path:
    """Return the emulated bench's program, built first where its sources are newer.

    Returns what ``AMBID_BENCH`` names, else ``firmware/build/amb_bench`` of the checkout.
    """
    return _find("AMBID_BENCH", "amb_bench", "bench", ("bench",))


def find_firmware() -> Path:
    """Return the firmware's ELF file, built first where its sources are newer.

    Returns what ``AMBID_FIRMWARE`` names, else ``firmware/build/amb_daq.elf`` of the checkout.
    """
    return _find("AMBID_FIRMWARE", "amb_daq.elf", "firmware", ("amb_daq",))


class Emulator:
    """The firmware in an emulated controller before a simulated bench. A context: ended when it is left.

    `plant`: plant file, see `write_plant_file`; `firmware`: ELF file; None: see `find_firmware`; `program`: the bench's
    program; None: see `find_program`; `script`: what happens while it runs: the lines themselves, or a file; `pace`:
    emulated time as fast as it goes, or as the wall clock; `seed`: of all noise.

    `port`: the pseudo-terminal; after the start; `pid`: of the process; after the start.
    """

    def __init__(
        self,
        plant: Path,
        *,
        firmware: Path | None = None,
        program: Path | None = None,
        script: str | Path | None = None,
        pace: Literal["fastest", "real"] = "fastest",
        lockstep_ms: float = 100.0,
        seed: int = 0,
        folder: Path | None = None,
        trajectory: bool = False,
    ) -> None:
        self._plant, self._firmware, self._program, self._script = Path(plant), firmware, program, script
        self._options = ["--pace", pace, "--lockstep", repr(float(lockstep_ms)), "--seed", str(seed)]
        self._folder = folder
        self._temporary: TemporaryFolder | None = None
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
        command = [str(program), "--firmware", str(firmware), "--plant", str(self._plant), "--log", str(self.log_path)]
        command += [*self._options, *self._script_option(folder)]
        command += ["--trajectory", str(self.trajectory_path)] if self._trajectory else []
        atexit.register(self.close)
        with self._said_path().open("wb") as said:
            try:
                self._process = subprocess.Popen(
                    command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, start_new_session=True
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
        """End the process, wait for it, and remove the temporary folder.

        `keep`: leave the folder.
        """
        atexit.unregister(self.close)
        process, self._process = self._process, None
        if process is not None:
            _end(process)
            if process.stdout is not None:
                process.stdout.close()
        if self._temporary is not None and not keep:
            self._temporary.remove()
            self._folder = self._temporary = None

    def ended(self, timeout_s: float) -> str | None:
        """Return how the process ended by itself.

        `timeout_s`: how long to wait for its end, s. Returns words; None where it still runs, or was never started.
        """
        if self._process is None:
            return None
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return None
        return f"{_way(code)}: {said}" if (said := self.said()) else _way(code)

    def events(self, name: str | None = None) -> list[dict[str, Any]]:
        """Return what the log says so far.

        `name`: only events of that name: ``start``, ``host``, ``enable``, ``script``, ``stop``, ``reset``, ``end``.
        Returns each with ``t`` in s of emulated time and ``event``.
        """
        if self._folder is None or not self.log_path.exists():
            return []
        lines = self.log_path.read_text(encoding="utf-8").splitlines(keepends=True)
        found = [json.loads(line) for line in lines if line.endswith("\n")]
        return [e for e in found if name is None or e["event"] == name]

    def said(self) -> str:
        """Return what the program wrote on its standard error.

        Returns empty if nothing.
        """
        path = self._said_path()
        return path.read_text(encoding="utf-8", errors="replace").strip() if path.exists() else ""

    def _place(self) -> Path:
        if self._folder is None:
            self._temporary = TemporaryFolder()
            self._folder = self._temporary.path
        return self._folder

    def _said_path(self) -> Path:
        return self._place() / "bench.err"

    def _script_option(self, folder: Path) -> list[str]:
        if self._script is None:
            return []
        if isinstance(self._script, Path):
            return ["--script", str(self._script)]
        path = folder / "script.txt"
        path.write_text(self._script + "\n", encoding="utf-8")
        return ["--script", str(path)]

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
    given = os.environ.get(variable)
    if given:
        path = Path(given)
        if not path.is_file():
            raise DeviceError(f"emulated bench: {variable} names {given}; there is no such file. Correct or unset it")
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
