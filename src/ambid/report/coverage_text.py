"""Monte Carlo over a rig: a table of bias, spread and coverage, and its figure."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from ambid.errors import counted
from ambid.report.drawing import BAND, BOUND, MEASURED, PREDICTED, Block, head, panel, said_panel, stacked
from ambid.report.numbers import quantity, sized
from ambid.report.text import WIDTH, WORDS, Paint, columns, joined, plain, wrapped
from ambid.validation.coverage import Coverage, Covered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_REASONS = 5


def coverage_title(found: Coverage) -> str:
    """Return what was done, in a few words."""
    return f"{found.job} of {counted(len(found.trials), 'simulated record')} of {found.rig}"


def coverage_text(found: Coverage, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write the table below its verdict."""
    n = found.counts
    words = ", ".join(
        [*(f"{n[w]} {WORDS[w][0]}" for w in WORDS if n[w]), *([f"{n['failed']} failed"] * bool(n["failed"]))]
    )
    lines = [f"{paint(coverage_title(found), 'strong')}: {words}", f"{found.seconds:.3g} s"]
    rows: list[tuple[str, ...]] = [
        ("", "truth", "mean ± sd of it", "bias/sd", "sd said/seen", "95 % hold", "(95 %)", "max |z|")
    ]
    rows += [_row(r, found.units.get(r.name, "")) for r in found.rows]
    why = Counter(t.reason for t in found.trials if t.reason).most_common(_REASONS)
    return joined(
        [
            wrapped(lines, width, "  "),
            columns(rows),
            [paint("failures", "strong"), *wrapped([f"{k} x {reason}" for reason, k in why], width, "    ")]
            if why
            else [],
        ]
    )


def _row(r: Covered, unit: str) -> tuple[str, ...]:
    low, high = (100 * x for x in r.coverage)
    unknown = f" ({r.unknown} not seen)" if r.unknown else ""
    return (
        r.name, sized(r.truth, unit), quantity(r.truth + r.bias, r.bias_sd, unit).text, f"{r.bias / r.said:+.2f}",
        f"{r.ratio[0]:.2f} to {r.ratio[1]:.2f}", f"{r.inside} of {r.runs}{unknown}", f"{low:.1f} to {high:.1f} %",
        f"{r.largest_z:.2g}",
    )  # fmt: skip


def coverage_figure(found: Coverage, title: str, width: float) -> Figure:
    """Draw how often intervals hold the truth, and the errors in standard deviations."""
    rows = found.rows
    if not rows:
        return stacked(title, [said_panel("no run gave a number")], width)

    def shares(axes: Axes) -> None:
        at = np.arange(len(rows))
        low, high = (100 * np.array([r.coverage[k] for r in rows]) for k in (0, 1))
        middle = np.array([100 * r.inside / r.runs for r in rows])
        axes.errorbar(middle, at, xerr=(np.maximum(middle - low, 0), np.maximum(high - middle, 0)), fmt="o",
                      color=PREDICTED, label="share, 95 %")  # fmt: skip
        axes.axvline(95.0, color=BOUND, linewidth=1.0, label="said")
        axes.set_yticks(at, [r.name for r in rows])
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlabel("95 % intervals that hold the truth [%]")

    def errors(axes: Axes) -> None:
        from scipy.stats import norm

        z = np.concatenate([found.z(r.name) for r in rows])
        reach = max(4.0, float(np.ceil(np.max(np.abs(z)))))
        axes.hist(z, bins=np.linspace(-reach, reach, 41).tolist(), density=True, color=BAND, label="all parameters")
        x = np.linspace(-reach, reach, 200)
        axes.plot(x, norm.pdf(x), color=MEASURED, label="standard normal")
        axes.set_xlabel("error / standard deviation")
        head(axes, f"rms {np.sqrt(np.mean(z**2)):.2f}, largest {np.max(np.abs(z)):.2g}")

    tall = max(2.5, 0.22 * len(rows))
    block = Block(columns=[[panel(shares, height=tall)], [panel(errors, height=tall)]], shared=False)
    return stacked(title, [block], width)
