"""Jobs that workers of a pool import."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from ambid.errors import AmbidError
from ambid.estimation.estimate import EstimatedParameter
from ambid.estimation.result import Result


def double(x):
    return 2 * x


def by_word(task):
    """Do what the second word says; tell the process by a file named after the task, one letter a run."""
    folder, number, what = task
    with (Path(folder) / str(number)).open("a") as runs:
        runs.write("x")
    if what == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if what == "exit":
        os._exit(3)
    if what == "hang":
        time.sleep(60)
    if what == "refuse":
        raise AmbidError("column 'current' is missing. Add it")
    if what == "defect":
        raise ZeroDivisionError("by\nzero")
    if what == "unsendable":
        return lambda: None
    if what == "slow":
        time.sleep(0.01)
    return number


def pid(_):
    time.sleep(0.005)
    return os.getpid()


def threads(_):
    return os.environ["OPENBLAS_NUM_THREADS"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Found(Result):
    """A result as small as can be."""

    parameters: tuple[EstimatedParameter, ...]
    model: str = "none"


def judge(record, rig, *, add=0.0):
    """Take the number that a file holds for an estimate; words end the worker, or are refused."""
    word = Path(record).read_text()
    if word == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if word == "hang":
        time.sleep(60)
    if not word.isdigit():
        raise AmbidError(f"record {record} holds {word!r}, and no number. Correct it")
    time.sleep(0.005)
    x = float(word) + add
    p = EstimatedParameter(
        name="m", unit="kg", value=x, sd=0.1, ci95=(x - 0.2, x + 0.2), role="free", identifiable=x < 30
    )
    return Found(parameters=(p,))


def count(record, rig):
    """Give numbers by name."""
    return {"n": len(record.names)}


def known_mass(record, rig):
    """Return what the rig still says of the mass and of a plane."""
    given = {p.name: p.value for p in rig.parameters}
    return {"m": 4.0 if given["m"] is None else 0.0, "ax.k_i": 30.0, "rows": record.n_samples}
