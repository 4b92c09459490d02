"""The thesis's coil by two methods
=================================

The thesis's coil, I/V = 550/(s + 860) (eq. 4.2), rotor at rest, from voltage and noisy current by two methods.

The thesis gets 519.8/(s + 812.5) (eq. 4.3) by least squares. Noise on the current makes least squares biased, because
the current is its regressor; the likelihood is not.

Run: ``python docs/examples/coil.py``
"""

from __future__ import annotations

from matplotlib.figure import Figure

from ambid import identify
from ambid.bearing.coil import coil_least_squares
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.rig import default_rig
from ambid.signals import multisine
from ambid.simulation import LinearPlant, noise_at_snr, simulate

GAIN, POLE = 550.0, 860.0  # A/(V s) and rad/s, thesis eq. 4.2
PRINTED = {"gain": 519.8, "pole": 812.5}  # thesis eq. 4.3
RATE_HZ, N_SAMPLES, SNR_DB = 10_000.0, 20_000, 40.0


def main(seed: int = 1) -> dict[str, dict[str, float]]:
    """Print gain b and pole a of I/V = b/(s + a) by every method; return them."""
    coil = LinearPlant(model=model("coil"), parameters={"R": POLE / GAIN, "L": 1.0 / GAIN})
    voltage = multisine(N_SAMPLES, RATE_HZ, band=(1.0, 2000.0), amplitude=5.0, seed=seed)
    clean = simulate(coil, voltage, rate_hz=RATE_HZ, seed=seed, noise=Noise())
    record = simulate(coil, voltage, rate_hz=RATE_HZ, seed=seed, noise=noise_at_snr(clean, SNR_DB)).record

    found = {"truth (4.2)": {"gain": GAIN, "pole": POLE}, "thesis (4.3)": PRINTED}
    result = coil_least_squares(record["voltage"].values, record["current"].values, RATE_HZ)
    found["least squares"] = {"gain": result.b, "pole": result.a}
    estimate = identify(record, default_rig("coil"))
    resistance, inductance = estimate.parameter("R"), estimate.parameter("L")
    found["likelihood"] = {"gain": 1.0 / inductance.value, "pole": resistance.value / inductance.value}

    print(f"{'':22} {'b [A/(V s)]':>12} {'error':>8} {'a [rad/s]':>10} {'error':>8} {'R [ohm]':>9} {'L [mH]':>8}")
    for method, f in found.items():
        print(
            f"{method:22} {f['gain']:12.2f} {f['gain'] / GAIN - 1:8.2%} {f['pole']:10.2f} {f['pole'] / POLE - 1:8.2%}"
            f" {f['pole'] / f['gain']:9.4f} {1e3 / f['gain']:8.4f}"
        )
    print(
        f"likelihood: R = {resistance.value:.5f} ± {resistance.sd:.1g} ohm, L = {1e3 * inductance.value:.5f} ±"
        f" {1e3 * inductance.sd:.1g} mH"
    )
    return found


def draw(found: dict[str, dict[str, float]]) -> Figure:
    """Draw the errors of gain and pole, method by method."""
    figure = Figure(figsize=(7.0, 2.8), layout="constrained")
    axes = figure.subplots()
    methods = [name for name in found if not name.startswith("truth")]
    for shift, (key, true) in zip((-0.2, 0.2), {"gain": GAIN, "pole": POLE}.items(), strict=True):
        errors = [100.0 * (found[name][key] / true - 1.0) for name in methods]
        axes.barh([k + shift for k in range(len(methods))], errors, height=0.35, label=key)
    axes.set_yticks(range(len(methods)), methods)
    axes.axvline(0.0, color="0.3", linewidth=0.8)
    axes.set_xlabel("error in %")
    axes.legend()
    return figure


if __name__ == "__main__":
    figure = draw(main())
