"""The columns that may be a role, as a picture: signals, coherences with what was chosen, and scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ambid.record import Record
from ambid.report.drawing import BOUND, GREEN, MEASURED, PREDICTED, WIDE, Block, curve, head, panel, stacked
from ambid.report.numbers import prefixed
from ambid.rig.roles import Candidate
from ambid.signals.spectra import cross_spectra
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SEGMENT = 512  # samples: smooth curves rather than fine ones
_COLORS = {"voltage": BOUND, "current": PREDICTED, "position": GREEN}


def roles_figure(record: Record, ranked: Mapping[str, Sequence[Candidate]], width: float = WIDE) -> Figure:
    """Return a row for each candidate: its signal, and its coherence with the columns chosen for the other roles."""
    rows = [(x, x is found[0]) for found in ranked.values() for x in found]
    chosen = {role: found[0].channel.name for role, found in ranked.items() if found}
    names = list(dict.fromkeys([x.channel.name for x, _ in rows]))
    signals = np.column_stack([record[name] for name in names]) if names else None
    spectra = None if signals is None else cross_spectra(signals, record.rate_hz, segment=min(len(signals), _SEGMENT))
    t = record.start_s + np.arange(record.n_samples) / record.rate_hz

    def signal(axes: Axes, x: Candidate, first: bool) -> None:
        values, unit = x.channel.values, x.channel.unit
        scale, unit = (1.0, unit) if unit in (UNKNOWN, "1") else prefixed(float(np.max(np.abs(values))), unit)
        curve(axes, t, values / scale, PREDICTED if first else MEASURED, "chosen" if first else "other candidates")
        axes.set_ylabel(f"[{unit}]")
        axes.set_xlabel("time [s]")
        head(axes, f"{x.role}: {x.channel.name}, score {x.score:.2f}{' (chosen)' if first else ''}")

    def coherence(axes: Axes, x: Candidate) -> None:
        for role, name in chosen.items():
            if spectra is not None and name != x.channel.name and role != x.role:
                j, k = names.index(x.channel.name), names.index(name)
                power = spectra.density[1:, j, j].real * spectra.density[1:, k, k].real
                share = np.abs(spectra.density[1:, j, k]) ** 2 / np.where(power > 0, power, np.inf)
                axes.semilogx(spectra.frequency_hz[1:], share, color=_COLORS[role], lw=1.0, label=f"with {name}")
        axes.set_ylim(0.0, 1.05)
        axes.set_ylabel("coherence")
        axes.set_xlabel("frequency [Hz]")

    columns = [
        [panel(signal, x, first, height=1.6) for x, first in rows],
        [panel(coherence, x, height=1.6) for x, _ in rows],
    ]
    title = f"{record.provenance.get('file', 'record')}: which column is which"
    return stacked(title, [Block(columns=columns, widths=(3, 2))] if rows else [], width)
