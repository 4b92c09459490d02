"""The columns that may be a role, as a picture: signals, coherences with what was chosen, and scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ambid.record import Record
from ambid.report.drawing import MEASURED, PREDICTED, curve, grid, single
from ambid.rig.roles import Candidate
from ambid.signals.spectra import cross_spectra

if TYPE_CHECKING:
    from matplotlib.figure import Figure, SubFigure

_SEGMENT = 512  # samples: smooth curves rather than fine ones
_COLORS = {"voltage": "#c0392b", "current": "#0b6fb8", "position": "#2e7d32"}


def roles_figure(record: Record, ranked: Mapping[str, Sequence[Candidate]]) -> Figure:
    """Return a row for each candidate: its signal, and its coherence with the columns chosen for the other roles."""
    rows = [(x, x is found[0]) for found in ranked.values() for x in found]
    chosen = {role: found[0].channel.name for role, found in ranked.items() if found}
    names = list(dict.fromkeys([x.channel.name for x, _ in rows]))
    signals = np.column_stack([record[name] for name in names]) if names else None
    spectra = None if signals is None else cross_spectra(signals, record.rate_hz, segment=min(len(signals), _SEGMENT))
    t = record.start_s + np.arange(record.n_samples) / record.rate_hz

    def draw(figure: Figure | SubFigure) -> None:
        figure.suptitle(f"{record.provenance.get('file', 'record')}: which column is which", fontsize=13)
        places = figure.subplots(len(rows), 2, squeeze=False, sharex="col", width_ratios=(3, 2))
        for (x, first), (signal, coherence) in zip(rows, places, strict=True):
            curve(signal, t, x.channel.values, PREDICTED if first else MEASURED, None)
            words = f"{x.role}: {x.channel.name}, score {x.score:.2f}{' (chosen)' if first else ''}"
            signal.set_title(words, fontsize=10, loc="left", fontweight="bold" if first else "normal")
            signal.set_ylabel(f"[{x.channel.unit}]")
            for role, name in chosen.items():
                if spectra is not None and name != x.channel.name and role != x.role:
                    j, k = names.index(x.channel.name), names.index(name)
                    power = spectra.density[1:, j, j].real * spectra.density[1:, k, k].real
                    share = np.abs(spectra.density[1:, j, k]) ** 2 / np.where(power > 0, power, np.inf)
                    coherence.semilogx(spectra.frequency_hz[1:], share, color=_COLORS[role], lw=1.0, label=name)
            coherence.set_ylim(0.0, 1.05)
            coherence.set_title("coherence with", fontsize=9, loc="left")
            coherence.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
            grid(signal, coherence)
        places[-1][0].set_xlabel("time [s]")
        places[-1][1].set_xlabel("frequency [Hz]")

    return single(1.7 * max(len(rows), 1) + 0.6, draw)
