"""What the user of ``ambid acquire`` asks for, and what is refused before a device is opened."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from ambid.cli.options import LARGEST, check_positive
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.acquire.device import Mode
    from ambid.estimation.estimate import Estimate
    from ambid.rig import Rig


@dataclass(frozen=True, slots=True, kw_only=True)
class Wish:
    """What the user asks for; refused when it is made, where it does not go together."""

    port: str
    rig: Rig
    record: Path
    mode: Mode
    seconds: float  # length of the record, and time before it, s
    settle_s: float
    name: str | None  # of the excitation
    amplitude: float | None  # peak in V; None: found by trials
    band: tuple[float, float] | None  # in Hz
    seed: int
    force: bool  # whether a record that exists may be written over

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        check_positive({"--seconds": self.seconds, "--amplitude": self.amplitude})
        if not 0 <= self.settle_s <= LARGEST:
            raise AmbidError(f"--settle is {self.settle_s:g}; it must be a number, 0 to {LARGEST:g}. Correct it")
        if self.name is None:
            for option, y in (("--amplitude", self.amplitude), ("--band", self.band)):
                if y is not None:
                    raise AmbidError(
                        f"{option} is of an excitation, and none is named. Give --excitation, or leave it out"
                    )
        elif self.port.startswith("replay:"):
            raise AmbidError("--excitation cannot be played to a record that is replayed. Leave it out")
        elif self.mode == "sample":
            raise AmbidError(
                "--mode sample has its output off: nothing can be excited. Leave --excitation out, or --mode drive"
            )
        if (self.record.exists() or self.record.is_symlink()) and not self.force:
            raise AmbidError(f"-o {self.record} exists already. Choose another name, or give --force")

    def check_length(self, rate_hz: float) -> None:
        """Refuse a record that would be too short to be read.

        `rate_hz`: of the device.
        """
        from ambid.record.sampling import MIN_SAMPLES

        samples = max(1, round(self.seconds * rate_hz))
        if samples < MIN_SAMPLES:
            raise AmbidError(
                f"--seconds is {self.seconds:g}: {samples} samples at {rate_hz:g} Hz; a record has {MIN_SAMPLES} at"
                f" least. Give {MIN_SAMPLES / rate_hz:.3g} or more"
            )


def start_of_track(track: str | None) -> Estimate | None:
    """Read the estimate that tracking is to begin with.

    `track`: as given: None, ``auto``, or a file. Returns none where none is named.
    """
    if track in (None, "auto"):
        return None
    from ambid.estimation.estimate import Estimate
    from ambid.job.estimates import read_estimate

    found = read_estimate(str(track))
    if not isinstance(found, Estimate):
        raise AmbidError(
            f"--track {track} is a black-box fit or a nonlinear estimate; tracking follows linear physical parameters."
            " Give an estimate of 'ambid identify --json' without --nonlinear"
        )
    return found


def told(what: AmbidError) -> None:
    """Say on standard error what goes wrong while a recording goes on."""
    typer.echo(f"ambid: {what}", err=True)
