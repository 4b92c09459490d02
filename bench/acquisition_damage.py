"""Damage into the running firmware while it levitates, and what becomes of it."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from table import Table
from tests.bars import damage
from tests.bars.host import prototype

SCALE = float(os.environ.get("ACQUISITION_DAMAGE", "1"))
GROUP = "Acquisition: damage into the levitating firmware (emulated)"
COLUMNS = (
    "what", "bytes", "damaged frames sent", "counted", "bytes that found no room", "sound frames among them",
    "faults", "at the end", "pulse width", "largest motion", "anything wrong",
)  # fmt: skip


def damage_tables() -> Iterator[Table]:
    """One table over the kinds of damage."""
    rng, rig, rows, data = np.random.default_rng(5), prototype(), [], {}
    n = round(1000 * SCALE)
    kinds: dict[str, Callable[[Path], damage.Survived]] = {
        "random bytes between pings": lambda f: damage.random_bytes(rig, f, rng, 100 * n),
        "random bytes alone": lambda f: damage.random_bytes(rig, f, rng, 100 * n, pings=False),
        f"{n} mutated commands": lambda f: damage.mutated(rig, f, rng, n),
        f"{n} sound frames of senseless commands": lambda f: damage.senseless(rig, f, rng, n),
    }
    for name, attack in kinds.items():
        with tempfile.TemporaryDirectory() as folder:
            found = attack(Path(folder))
        faults = ", ".join(f"{n} {cause}" for cause, n in Counter(found.faults).items()) or "none"
        rows.append(
            (
                name, str(found.sent), str(found.expected), str(found.counted), str(found.rx_lost),
                str(found.carried_out), faults, found.state, f"{found.duty[0]} to {found.duty[1]} of {found.limits}",
                f"{1e3 * found.largest_m:.2f} mm", "; ".join(found.wrong) or "nothing",
            )
        )  # fmt: skip
        data[name] = asdict(found)
        print("; ".join(rows[-1]), flush=True)
    before = (
        "Damaged frames as the host's own decoder counts them in the same bytes, and as the controller counted them;"
        " the receive buffer of the controller overflows where senseless bytes fill the line, and counts that. Pulse"
        " width: the real one while ENABLE was high, with the limits in force. Random bytes alone are no sign of life:"
        " the safe state is right. Senseless commands: fields at random, gains from none to 1.5 times the sound ones;"
        " after each one the rotor is lifted again where it was let down; motion until the first time."
    )
    yield Table(group=GROUP, columns=COLUMNS, rows=tuple(rows), before=before, data=data)
