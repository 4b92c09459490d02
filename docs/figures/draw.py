"""Draw the figures of README and docs/wiring.md: ``python docs/figures/draw.py [FOLDER]`` (default: here)."""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Arc, Polygon, Rectangle

INK, POWER, SOFT = "#222222", "#b03a2e", "#5f6b76"
LINE = 1.2
ADC_TOP, REFERENCE_V = 1024, 5.0


def wire(ax: Axes, *points: tuple[float, float], color: str = INK) -> None:
    """Draw a line through points."""
    ax.plot([p[0] for p in points], [p[1] for p in points], color=color, lw=LINE, solid_capstyle="round")


def dot(ax: Axes, x: float, y: float, color: str = INK) -> None:
    """Mark a junction."""
    ax.plot([x], [y], "o", ms=3.5, color=color)


def words(ax: Axes, x: float, y: float, text: str, *, size: float = 7.5, at: str = "center", color: str = INK) -> None:
    """Write text, centred in height."""
    ax.text(x, y, text, fontsize=size, ha=at, va="center", color=color, linespacing=1.15)


def box(ax: Axes, x: float, y: float, w: float, h: float, text: str, *, size: float = 8.0) -> None:
    """Draw a part as a box with its name."""
    ax.add_patch(Rectangle((x, y), w, h, fill=True, fc="#f4f6f8", ec=INK, lw=LINE))
    words(ax, x + w / 2, y + h / 2, text, size=size)


def resistor(ax: Axes, x: float, y: float, text: str, *, above: bool = True) -> None:
    """Draw a horizontal resistor of width 5 with its centre at x, y."""
    ax.add_patch(Rectangle((x - 2.5, y - 0.9), 5, 1.8, fc="white", ec=INK, lw=LINE, zorder=3))
    words(ax, x, y + (2.3 if above else -2.3), text)


def upright(ax: Axes, x: float, y: float, text: str, *, right: bool = True) -> None:
    """Draw a vertical resistor of height 4 with its centre at x, y."""
    ax.add_patch(Rectangle((x - 0.9, y - 2), 1.8, 4, fc="white", ec=INK, lw=LINE, zorder=3))
    words(ax, x + (1.6 if right else -1.6), y, text, at="left" if right else "right")


def ground(ax: Axes, x: float, y: float) -> None:
    """Draw the star ground's sign below x, y."""
    for k, half in enumerate((1.4, 0.9, 0.4)):
        wire(ax, (x - half, y - 0.7 * k), (x + half, y - 0.7 * k))


def capacitor(ax: Axes, x: float, y: float, text: str, *, drop: float = 5.0) -> None:
    """Draw a capacitor from x, y down to ground."""
    top = y - drop / 2
    wire(ax, (x, y), (x, top))
    wire(ax, (x - 1.6, top), (x + 1.6, top))
    wire(ax, (x - 1.6, top - 0.9), (x + 1.6, top - 0.9))
    wire(ax, (x, top - 0.9), (x, y - drop))
    ground(ax, x, y - drop)
    words(ax, x + 2.2, top - 0.5, text, at="left")


def contact(ax: Axes, x: float, y: float, text: str, color: str = INK) -> None:
    """Draw a contact that is closed at rest, 4 wide, with its centre at x, y."""
    ax.add_patch(Rectangle((x - 2, y - 1.5), 4, 3.4, fc="white", ec="none", zorder=2))
    dot(ax, x - 2, y, color)
    dot(ax, x + 2, y, color)
    ax.plot([x - 2, x + 2.3], [y, y + 0.9], color=color, lw=LINE, zorder=3)
    ax.plot([x + 2, x + 2], [y, y + 1.3], color=color, lw=LINE, zorder=3)
    words(ax, x, y + 3.6, text)


def winding(ax: Axes, x: float, top: float, text: str, color: str, *, right: bool) -> None:
    """Draw a vertical winding of height 6 below x, top, with the dot of its sense on top."""
    for k in range(4):
        turn = Arc((x, top - 0.75 - 1.5 * k), 1.8, 1.5, theta1=-90, theta2=90, color=color, lw=LINE)
        ax.add_patch(turn)
    words(ax, x + (1.8 if right else -1.4), top - 3, text, at="left" if right else "right")


def tag(ax: Axes, x: float, y: float, text: str, color: str = POWER) -> None:
    """Draw the name of a supply at the end of a wire."""
    ax.text(x, y, text, fontsize=7.5, ha="center", va="center", color=color,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": color, "lw": 0.9})  # fmt: skip


def supply(ax: Axes) -> None:
    """Battery, fuse, emergency stop, buffer: the top of the diagram."""
    y = 78
    wire(ax, (14, y), (117, y), color=POWER)
    box(ax, 3, 74, 11, 8, "battery\n12 V")
    wire(ax, (8.5, 74), (8.5, 71))
    ground(ax, 8.5, 71)
    ax.add_patch(Rectangle((18, y - 1.2), 6, 2.4, fc="white", ec=POWER, lw=LINE, zorder=3))
    wire(ax, (18, y), (24, y), color=POWER)
    words(ax, 21, y + 3.2, "F1  3 A")
    contact(ax, 34, y, "S1, contact 1\n(emergency stop)", POWER)
    capacitor(ax, 50, y, "1000 µF\n25 V", drop=6)
    wire(ax, (61, y), (61, 72))
    ax.add_patch(Polygon([(59.7, 74.2), (62.3, 74.2), (61, 76.2)], closed=True, fc="white", ec=INK, lw=LINE))
    wire(ax, (59.5, 76.4), (62.5, 76.4))
    ground(ax, 61, 72)
    words(ax, 63.2, 75.2, "TVS\n18 V", at="left")
    dot(ax, 50, y, POWER)
    dot(ax, 61, y, POWER)
    tag(ax, 71, y + 0.02, "+12 V")


def stage(ax: Axes) -> None:
    """Bridge, shunt, control and bias windings."""
    box(ax, 74, 52, 14, 18, "full bridge\nlocked\nanti-phase\n20 kHz")
    wire(ax, (81, 78), (81, 70), color=POWER)
    dot(ax, 81, 78, POWER)
    wire(ax, (81, 52), (81, 50.4))
    ground(ax, 81, 50.4)
    for y, name, text, at in ((64, "D9", "direction", 64), (56, "D8", "enable", 56)):
        wire(ax, (45, y), (74, at))
        resistor(ax, 53, y, "100 Ω")
        wire(ax, (62, y), (62, y - 0.6))
        dot(ax, 62, y)
        words(ax, 73.4, y + 1.5, text, size=7, at="right", color=SOFT)
        words(ax, 44.4, y, name, at="right")
    for y in (64, 56):
        wire(ax, (62, y), (62, y - 4.6))
        ax.add_patch(Rectangle((61.2, y - 4), 1.6, 3.0, fc="white", ec=INK, lw=LINE, zorder=3))
        ground(ax, 62, y - 4.6)
        words(ax, 63.6, y - 2.5, "10 kΩ", at="left")
    wire(ax, (88, 67), (109, 67))
    resistor(ax, 94, 67, "0.1 Ω")
    for top, text in ((67, "control,\nmagnet A"), (61, "control,\nmagnet B,\nreversed")):
        winding(ax, 109, top, text, INK, right=False)
    wire(ax, (109, 55), (88, 55))
    wire(ax, (117, 78), (117, 76.5), color=POWER)
    ax.add_patch(Rectangle((110.5, 71), 13, 5.5, fc="#f4f6f8", ec=INK, lw=LINE))
    words(ax, 117, 73.7, "1 A source with\nfreewheel diode", size=7)
    wire(ax, (117, 71), (117, 67))
    for top, text in ((67, "bias,\nmagnet A"), (61, "bias,\nmagnet B")):
        winding(ax, 117, top, text, INK, right=True)
    wire(ax, (117, 55), (117, 52))
    ground(ax, 117, 52)


def inputs(ax: Axes) -> None:
    """Interlock loop, and the three analog inputs with their filters."""
    wire(ax, (45, 45), (84, 45))
    words(ax, 44.4, 45, "D7", at="right")
    capacitor(ax, 48, 45, "100 nF", drop=4.6)
    dot(ax, 48, 45)
    resistor(ax, 54, 45, "1 kΩ")
    wire(ax, (60, 45), (60, 41.5))
    tag(ax, 62.5, 40.4, "1 kΩ to +5 V", INK)
    dot(ax, 60, 45)
    contact(ax, 67, 45, "S1,\ncontact 2")
    contact(ax, 77, 45, "90 °C\nin the coil")
    wire(ax, (84, 45), (84, 44))
    ground(ax, 84, 44)
    rows = ((33, "A1", "1.0 kΩ", "current\namplifier\n20 V/V"), (23, "A0", "1.0 kΩ", "position\nsensor\n2 V/mm"))
    for y, pin, ohms, part in rows:
        wire(ax, (45, y), (88, y))
        words(ax, 44.4, y, pin, at="right")
        resistor(ax, 66, y, ohms)
        capacitor(ax, 54, y, "47 nF at the pin", drop=5)
        dot(ax, 54, y)
        box(ax, 88, y - 4, 13, 8, part, size=7.5)
    for x in (90.5, 97.5):
        wire(ax, (x, 67), (x, 37))
        dot(ax, x, 67)
    words(ax, 94, 47, "Kelvin\nleads", size=7, color=SOFT)
    words(ax, 102, 33, "middle at 2.5 V\nfrom the Uno's 5 V", size=7, at="left", color=SOFT)
    words(ax, 102, 23, "2.5 V at the centre,\n0 to 5 V over 2.5 mm", size=7, at="left", color=SOFT)
    wire(ax, (45, 12), (88, 12))
    words(ax, 44.4, 12, "A2", at="right")
    capacitor(ax, 54, 12, "100 nF", drop=5)
    dot(ax, 54, 12)
    resistor(ax, 80, 12, "22 kΩ")
    tag(ax, 91, 12, "+12 V")
    wire(ax, (70, 12), (70, 6))
    upright(ax, 70, 9, "10 kΩ")
    dot(ax, 70, 12)
    ground(ax, 70, 6)
    words(ax, 96, 12, "optional: the supply", size=7, at="left", color=SOFT)


def wiring() -> plt.Figure:
    """Return the wiring diagram."""
    figure, ax = plt.subplots(figsize=(12, 8.05))
    ax.set_xlim(1, 128)
    ax.set_ylim(0.5, 85.5)
    ax.set_aspect("equal")
    ax.axis("off")
    figure.subplots_adjust(0.005, 0.005, 0.995, 0.995)
    ax.add_patch(Rectangle((29, 3), 16, 64, fc="#eef3ee", ec=INK, lw=1.5))
    words(ax, 35.5, 36, "Arduino Uno\n\nATmega328P\n16 MHz\n\nlamp: D13", size=8.5)
    supply(ax)
    stage(ax)
    inputs(ax)
    box(ax, 3, 40, 9, 8, "host")
    box(ax, 16, 40, 9, 8, "USB\nisolator")
    wire(ax, (12, 44), (16, 44))
    wire(ax, (25, 44), (29, 44))
    wire(ax, (29, 12), (22, 12), (22, 10))
    ground(ax, 22, 10)
    words(ax, 25.5, 13.6, "GND", size=7)
    words(
        ax, 14.5, 27,
        "Star ground: filters and\nsensors to the Uno's GND;\nit, bridge, bias and battery\n"
        "each with one wire to the\nminus of the 1000 µF.",
        size=7, color=SOFT,
    )  # fmt: skip
    return figure


def infrared(distance_mm: np.ndarray) -> np.ndarray:
    """Relative signal of a reflective sensor, laid through three points of a data sheet; for illustration."""
    peak, near, far = 2.5, 0.2, 15.0
    reach = np.where(distance_mm < peak, np.log(peak / near), np.log(far / peak))
    return np.asarray(np.exp(np.log(0.2) * (np.log(distance_mm / peak) / reach) ** 2))


def sensors() -> plt.Figure:
    """Return curves of position sensors, their resolution, and the filters at the inputs."""
    figure, (curve, steps, filters) = plt.subplots(1, 3, figsize=(11.6, 3.7))
    per_volt = ADC_TOP / REFERENCE_V
    d = np.geomspace(0.15, 20.0, 600)
    counts = 4.5 * per_volt * infrared(d)
    straight = np.array([2.0, 4.5])
    curve.plot(d, counts, color=POWER, label="reflective infrared")
    curve.plot(straight, (straight - straight[0]) * 2.0 * per_volt, color=INK, label="linear, 2 V/mm")
    curve.plot([0.2, 2.5, 15.0], 4.5 * per_volt * np.array([0.2, 1.0, 0.2]), "o", color=POWER, ms=5)
    curve.set(xlabel="distance (mm)", ylabel="counts", xlim=(0, 20), ylim=(0, 1150))
    curve.legend(loc="upper right", frameon=False)
    curve.set_title("counts against distance")

    resolution = 1e3 / np.abs(np.gradient(counts, d))
    steps.semilogy(d, resolution, color=POWER, label="reflective infrared")
    steps.semilogy(straight, [1e3 / (2.0 * per_volt)] * 2, color=INK, lw=2.5, label="linear, 2 V/mm")
    steps.set(xlabel="distance (mm)", ylabel="µm per count", xlim=(0, 20), ylim=(0.5, 300))
    steps.set_title("what one count means")
    steps.legend(loc="upper right", frameon=False)
    steps.annotate("blind at\nthe peak", (2.6, 150), (5.0, 60), arrowprops={"arrowstyle": "->", "color": SOFT})

    f = np.geomspace(10.0, 40e3, 400)
    gain = -10 * np.log10(1 + (2 * np.pi * f * 1.0e3 * 47e-9) ** 2)
    filters.semilogx(f, gain, color=POWER, label="A0 and A1: 1.0 kΩ, 47 nF")
    marks = ((55.0, "loop\n55 Hz"), (1000.0, "half the\nrate"), (20e3, "PWM"))
    for at, name in marks:
        filters.axvline(at, color=SOFT, lw=0.8, ls=":")
        filters.text(at * 0.93, -21.5, name, fontsize=8, ha="right", va="bottom", color=SOFT)
    filters.set(xlabel="frequency (Hz)", ylabel="dB", xlim=(10, 40e3), ylim=(-22, 6))
    filters.set_title("filters at the inputs")
    filters.legend(loc="upper right", framealpha=1.0, edgecolor="white")
    for ax in (curve, steps, filters):
        ax.grid(alpha=0.25)
    figure.tight_layout()
    return figure


def demo() -> Figure:
    """What goes into `ambid demo`, and what comes out beside the truth."""
    import ambid

    data = Path(ambid.__file__).parent / "data"
    record = ambid.read_record(data / "demo.csv.gz")
    estimate, truth = ambid.identify(record, data / "demo.toml"), ambid.preset("unstable-bearing").parameters
    free = [p for p in estimate.parameters if p.role == "free"]
    figure = plt.figure(figsize=(9.0, 3.0), layout="constrained")
    left, right = figure.subfigures(1, 2)
    left.suptitle("in: 0.1 s of a levitated rotor", fontsize=10)
    channels = zip(
        left.subplots(3, 1, sharex=True),
        (("voltage", 1.0, "V"), ("current", 1e3, "mA"), ("position", 1e6, "µm")),
        strict=True,
    )
    for ax, (name, scale, unit) in channels:
        ax.plot(record.time_s, scale * record.channel(name).values, color=SOFT, lw=0.6)
        ax.set_ylabel(f"{name}\n[{unit}]")
    ax.set_xlabel("time [s]")
    ax.locator_params(axis="x", nbins=5)
    right.suptitle("out: five parameters, error and 95 % interval in %", fontsize=10)
    ax = right.subplots()
    off = [100.0 * (p.value / truth[p.name] - 1.0) for p in free]
    ax.errorbar(
        off,
        [p.name for p in free],
        xerr=[196.0 * p.sd / abs(truth[p.name]) for p in free],
        fmt="o",
        capsize=4,
        color="#0b6fb8",
    )
    ax.axvline(0.0, color=INK, lw=0.8)
    ax.set_ylim(len(free) - 0.5, -0.5)
    ax.set_xlabel("estimate against truth [%]")
    ax.grid(axis="x", alpha=0.25)
    return figure


def main() -> None:
    """Write the wiring as SVG (with a folder as argument also as PNG, to look at) and the demo as PNG."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    kept = {"svg.fonttype": "none", "svg.hashsalt": "ambid", "font.family": "DejaVu Sans", "font.size": 9,
            "axes.titlesize": 9, "legend.fontsize": 8}  # fmt: skip
    with plt.rc_context(kept):
        for name, figure in (("wiring", wiring()), ("sensors", sensors())):
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
            if len(sys.argv) > 1:
                figure.savefig(folder / f"{name}.png", dpi=120)
        demo().savefig(folder / "demo.png", dpi=110)


if __name__ == "__main__":
    main()
