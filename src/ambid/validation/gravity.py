"""Facts that no fit has a part in: the balance of gravity, and the loop that held the rotor.

The force of one magnet grows with the square of its current, f = i^2 h(x), and at rest it carries the weight, f = -m g
(x grows away from the magnet). So k_i = df/di = 2 f/i0, and k_i/m = -2 g/i0 (theory.md sec. 1; thesis eq. 1.9). A
current read too large by a factor makes both sides smaller by it, and the motion alone gives k_i/m, whatever mass and
voltage are: the balance tests position, rate and the current's zero.

With a position that is reversed k_i has the other sign and every other parameter its own: a convention, until gravity
or a controller says which it is.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.arrays import Array
from ambid.estimation.estimate import Check
from ambid.record import Record
from ambid.rig.rig import Rig, RigMagnet
from ambid.signals.faults import resolution
from ambid.simulation.plant import closed_loop_poles

GRAVITY = 9.81
_FAR = 3.3  # standard deviations, as for other facts
_MIRROR = 0.5  # of the difference to the mirrored value: nearer to that, the sign is wrong and not the size
_REVERSED = 0.02  # of a current's largest value that an offset may put on the other side of zero


def carries_weight(magnet: RigMagnet | None, current: Array) -> bool:
    """Whether a rig says that one magnet carries the weight, with a force that grows as the square of `current`."""
    if magnet is None or magnet.kind == "pair" or magnet.saturation:
        return False
    low, high = sorted((float(current.min()), float(current.max())), key=abs)
    one_sided = low * high > 0 or abs(low) <= _REVERSED * abs(high)
    gravity = magnet.known("g")
    return (magnet.kind == "single" or one_sided) and (gravity is None or gravity.value != 0.0)


def gravity_balance(
    magnet: RigMagnet, record: Record, theta: Mapping[str, float], names: tuple[str, ...], covariance: Array
) -> Check:
    """Check k_i/m against -2 g/i0.

    `record`: channels named by role; `theta`: parameters; `names`, `covariance`: the estimated ones, under the model.
    The limit is what is not known: of the estimate, of gravity and of the current's zero (both from the rig; else the
    current's resolution), and of the law beyond its tangent, E[f] = f (1 + var(i)/i0^2 + ...), for the motion seen.
    """
    x, i = record["position"].values, record["current"].values
    numbers = {name: magnet.known(name) for name in ("g", "i_offset")}
    g, g_sd = _value(numbers["g"], GRAVITY, 0.0)
    zero, zero_sd = _value(numbers["i_offset"], 0.0, resolution(record, "current").step / np.sqrt(12.0))
    i0, (spread, along) = float(i.mean()) - zero, np.cov(x, i)
    ratio, expected = theta["k_i"] / theta["m"], -2.0 * g / i0
    slope = np.array([(name == "k_i") / theta["k_i"] - (name == "m") / theta["m"] for name in names])
    sd = abs(ratio) * float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
    rise = theta["k_x"] / (theta["m"] * g)  # f_x/f, as f = -m g
    ripple = float(along[1]) / i0**2
    bend = ripple + 2.0 * rise * float(along[0]) / i0 + 0.75 * rise**2 * float(spread[0])
    doubt = abs(expected) * float(np.sqrt((g_sd / g) ** 2 + (zero_sd / i0) ** 2 + bend**2 + ripple**2))
    total = float(np.hypot(sd, doubt))
    off = ratio / expected - 1.0
    passed = abs(ratio - expected) <= _FAR * total
    detail = f"k_i/m = {ratio:.4g} N/(A kg), sd {sd:.2g} if the model is right; the weight at {i0:.4g} A asks for "
    detail += f"-2 g/i0 = {expected:.4g}, sd {doubt:.2g}"
    if abs(ratio + expected) < _MIRROR * abs(expected):
        detail += (
            ": position is reversed. It has to grow away from the magnet: give channels.position.gain the other sign "
            "(k_i changes its sign with it, no other parameter does), or magnet.parameters.g"
        )
    else:
        detail += f": {100.0 * abs(off):.3g} % {'more' if off > 0 else 'less'}"
    if not passed and abs(off) < 1.0:
        detail += (
            f". A position that reads as much too {'large' if off > 0 else 'small'}, or a current that reads "
            f"{zero + i0 * off / (1.0 + off):.3g} A at zero would explain it (a factor on current, voltage or mass "
            "would not). Check these two, and that one magnet alone carries the rotor; else record away from limits, "
            "with more excitation"
        )
    values = {"k_i_over_m": ratio, "expected": expected, "relative": off, "sd": sd, "expected_sd": doubt}
    return Check(passed=passed, values=values, detail=detail)


def _value(p: object, value: float, sd: float) -> tuple[float, float]:
    """A number of the rig and its standard deviation, or what stands where it says nothing."""
    given = getattr(p, "value", None)
    return (value, sd) if given is None else (float(given), float(getattr(p, "sd", None) or 0.0))


def loop_agrees(rig: Rig, theta: Mapping[str, float], rate_hz: float) -> Check | None:
    """Check that the rig's controller holds what was identified, and not its mirror image.

    `theta`: parameters of model one-axis, SI. Returns None where the rig tells of no loop, or the record was taken
    without it.
    """
    if rig.loop is None or not rig.loop.closed or rig.open_loop:
        return None
    poles, mirrored = (
        float(np.abs(closed_loop_poles({**theta, "k_i": sign * theta["k_i"]}, rig.loop, rate_hz)).max())
        for sign in (1.0, -1.0)
    )
    values = {"largest_pole": poles, "mirrored": mirrored}
    if poles < 1.0 <= mirrored:
        return Check(passed=True, values=values, detail="the controller of the rig holds the identified plant")
    if mirrored < 1.0 <= poles:
        detail = (
            f"the controller of the rig would not hold the identified plant (largest pole {poles:.4g}), but its mirror "
            f"image (k_i = {-theta['k_i']:.4g} N/A): position is reversed, or voltage and current both are. Give "
            "channels.position.gain the other sign (k_i changes its sign with it, no other parameter does), or correct "
            "the signs of [loop]"
        )
        return Check(passed=False, values=values, detail=detail)
    detail = "the controller of the rig does not tell the sign of the position: "
    detail += (
        "it holds both" if poles < 1.0 else f"it holds neither this plant (largest pole {poles:.4g}) nor its mirror"
    )
    return Check(passed=True, values=values, detail=detail)
