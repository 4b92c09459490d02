"""The firmware's hardware-independent C, built for this machine with sanitizers and asked line by line."""

import subprocess
from dataclasses import dataclass
from pathlib import Path

from ambid.acquisition.protocol.codec import message, pack

HERE = Path(__file__).resolve().parent
FIRMWARE = HERE.parents[2] / "firmware" / "amb_daq"
FLAGS = ["-std=gnu99", "-O1", "-g", "-Wall", "-Wextra", "-Werror"]
SANITIZERS = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]

IDLE, SAMPLING, DRIVING, LEVITATING, FAULT = range(5)
LIMITS = {
    "position_low": 112,
    "position_high": 912,
    "current_low": 100,
    "current_high": 900,
    "duty_low": 40,
    "duty_high": 760,
    "duty_off": 400,
    "host_ms": 250,
    "lift_ms": 10,
}
GAINS = {
    "kp": 8000,
    "ki": 500,
    "kd": 20000,
    "pole": 20000,
    "kc": 4000,
    "setpoint": 512,
    "current_rest": 512,
    "duty_bias": 400,
}
EXCITATION = {"kind": 2, "amplitude": 20, "hold": 1, "length": 5, "cycles": 0, "seed": 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class Stand:
    """How the controller stands after a request."""

    state: int
    cause: int
    output: int
    duty: int
    ready: int
    playing: int
    ticking: int
    rx_errors: int
    ticks: int


_BUILT = {}


def build(compiler, folder, *flags):
    """Build the console, once for all tests of a process and for each choice of flags; returns its path."""
    if (compiler, *flags) in _BUILT:
        return _BUILT[compiler, *flags]
    program = folder / "console"
    sources = [str(p) for p in sorted(FIRMWARE.glob("*.c")) if p.name != "main.c"]
    sources += [str(p) for p in sorted(HERE.glob("*.c"))]
    paths = [f"-I{FIRMWARE}", f"-I{HERE}"]
    subprocess.run([compiler, *FLAGS, *SANITIZERS, *flags, *paths, "-o", str(program), *sources], check=True)
    _BUILT[compiler, *flags] = program
    return program


class Console:
    """Asks the console; each call is a run of its own, from reset."""

    def __init__(self, program):
        self._program = program

    def __call__(self, requests):
        """Return one line for each request."""
        done = subprocess.run(
            [str(self._program)],
            input="\n".join(requests) + "\n",
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        lines = done.stdout.split("\n")[1:-1]
        assert len(lines) == len(requests)
        return lines


def stand(line):
    """Read how the controller stands from the end of a line."""
    return Stand(**dict(zip(Stand.__slots__, map(int, line.split()[-9:]), strict=True)))


def command(name, number, *, values=(), **fields):
    """Return the request that carries out one command."""
    return "command " + pack(message(name, values=values, id=number, **fields)).hex()


def answer(line):
    """Return the bytes of an answer."""
    return bytes.fromhex(line.split()[0])


def code(line):
    """Return code and detail of an ack; (0, 0) for an answer of its own."""
    body = answer(line)
    return (body[2], int.from_bytes(body[3:5], "little")) if body[0] == 0x02 else (0, 0)


def ready(*, period=10, stream=0x0F, limits=None, gains=None):
    """Return the requests that make the controller ready for everything, with numbers from 1."""
    return [
        command("configure", 1, period=period, stream=stream),
        command("limits", 2, **(LIMITS | (limits or {}))),
        command("gains", 3, **(GAINS | (gains or {}))),
        command("excitation", 4, **EXCITATION),
    ]


def way_to(state):
    """Return the requests that lead from reset to a state."""
    start = {SAMPLING: 1, DRIVING: 2, LEVITATING: 3, FAULT: 3}
    requests = ready()
    if state != IDLE:
        requests += [command("start", 5, mode=start[state]), "tick 512 512 0 0"]
    if state == FAULT:
        requests += ["tick 512 1000 0 0", "tick 512 512 0 0"]
    return requests
