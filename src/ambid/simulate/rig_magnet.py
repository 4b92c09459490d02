"""The nonlinear plant of a rig: ``[magnet]`` and the m, R and c of ``[parameters]``, where it stands, and its truth.

Magnet, gravity, eddy pole, stage and offsets are those that ``ambid identify --nonlinear`` finds, under the same names.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from ambid.errors import RigError
from ambid.physics.bearing_numbers import BEARING_NUMBERS
from ambid.physics.coenergy_law import MagnetLaw, law_numbers
from ambid.physics.law_magnet import LawMagnet
from ambid.physics.magnet import CoEnergy
from ambid.physics.nonlinear import NonlinearPlant, OperatingPoint
from ambid.physics.power_stage import IDEAL, PowerStage

if TYPE_CHECKING:  # the rig room reads files; a simulation needs its values only
    from ambid.rig.rig import Rig, RigMagnet

_FINE = 0.25  # largest rate of the plant at rest times a Runge-Kutta step


def law_of_rig(rig: Rig) -> tuple[MagnetLaw, dict[str, float]]:
    """Return the law that a rig's ``[magnet]`` names, and the numbers of it that have a value.

    Returns `values`: all numbers of ``[magnet.parameters]`` with a value, whatever their role, and m, R and c; SI.
    """
    known = rig.magnet
    if known is None:
        raise RigError(
            f"rig {rig.name!r} has no [magnet]; a nonlinear simulation needs one. Add it with kind and numbers, or"
            " leave nonlinear out"
        )
    kind = "single" if known.kind == "auto" and known.gap == "exponential" else known.kind
    if kind == "auto":
        raise RigError(
            f"rig {rig.name!r}: magnet.kind is 'auto'; a simulation has no record to tell it by. Give kind = 'single'"
            " or 'pair'"
        )
    law = MagnetLaw(
        gap=known.gap or "hyperbolic", pair=kind == "pair", saturation=known.saturation,
        rise=_has(known, known.rise, ("L_rise", "i_knee")),
        asymmetric=_has(known, known.asymmetric, ("k_asym", "i0_asym")),
    )  # fmt: skip
    given = [*(rig.parameter(n) for n in ("m", "R", "c")), *known.parameters]
    values = {p.name: p.value for p in given if p.value is not None}
    needed = [
        "m",
        "R",
        "c",
        *law.names[:2],
        "L_leak",
        *(["i0"] if law.pair else []),
        *(p.name for p in known.parameters),
    ]
    needed += [n for n, on in (("sigma", law.saturation), ("L_rise", law.rise), ("i_knee", law.rise)) if on]
    needed += ["a"] if known.eddy else []
    missing = list(dict.fromkeys(n for n in needed if n not in values))
    if missing:
        where = " and ".join(
            f"{table} for {', '.join(names)}"
            for table, names in (
                ("[parameters]", [n for n in missing if n in ("m", "R", "c")]),
                ("[magnet.parameters]", [n for n in missing if n not in ("m", "R", "c")]),
            )
            if names
        )
        raise RigError(
            f"rig {rig.name!r}: there is no value for {', '.join(missing)}; a nonlinear simulation of a {law} needs it."
            f" Give value = ... in {where}"
        )
    return law, values


def _has(known: RigMagnet, said: bool | None, names: tuple[str, ...]) -> bool:
    """Whether the law has a part that the rig may leave to the records: as it says, else where it names a number."""
    return any(known.known(n) is not None for n in names) if said is None else said


def plant_of_rig(rig: Rig) -> NonlinearPlant:
    """Return the nonlinear plant of a rig, in the coordinates of its position sensor.

    A number that the rig does not name takes what identification takes for it: gravity is 9.81 m/s^2 for one magnet and
    0 for a pair, offsets, drops and differences of a pair are zero. Only the leakage has to be named, if only as zero.
    ``k_x``, ``k_i`` and ``L`` of ``[parameters]`` are not looked at; ``drift`` and ``off_below`` are not simulated.

    Parameters
    ----------
    rig : Rig
        Model ``one-axis``, with ``[magnet]``.

    Returns
    -------
    NonlinearPlant
        Its magnet is a `LawMagnet`.

    Raises
    ------
    RigError
        As `law_of_rig`.
    ModelError
        If a number cannot be that of a plant.
    """
    law, values = law_of_rig(rig)
    stage = PowerStage(
        v_drop=values.get("v_drop", 0.0),
        i_drop=values.get("i_drop", IDEAL.i_drop),
        offset=values.get("v_offset", 0.0),
    )
    return NonlinearPlant(
        magnet=LawMagnet(law=law, values=values, x_offset=values.get("x_offset", 0.0)),
        m=values["m"],
        R=values["R"],
        c=values["c"],
        gravity=values.get("g", 0.0 if law.pair else 9.81),
        eddy_pole=values["a"] if rig.magnet is not None and rig.magnet.eddy else math.inf,
        stage=stage,
    )


def current_offset(rig: Rig) -> float:
    """Return what the rig's current sensor shows without current.

    Returns in A.
    """
    known = None if rig.magnet is None else rig.magnet.known("i_offset")
    return 0.0 if known is None or known.value is None else known.value


def rest_of_rig(rig: Rig, plant: NonlinearPlant) -> OperatingPoint:
    """Return where the loop holds the plant: the declared position, and what current and voltage the law needs
    there.

    `rig`: the position of its operating point is used, 0 where it gives none.
    """
    return plant.equilibrium(rig.operating_point.get("position", 0.0))


def enough_steps(plant: NonlinearPlant, point: OperatingPoint, rate_hz: float) -> int:
    """Return how many Runge-Kutta steps a sample wants, by the fastest rate of the plant at rest.

    Returns at least 1.
    """
    p = plant.linearise(point.position)
    resistance = p["R"] + abs(plant.stage.slope(0.0))  # the drop is steepest where the current passes zero
    rates = [resistance / p["L"], abs(p["k_i"]) / math.sqrt(p["L"] * p["m"]), math.sqrt(abs(p["k_x"]) / p["m"])]
    rates += [p["c"] / p["m"], plant.eddy_pole if math.isfinite(plant.eddy_pole) else 0.0]
    return max(1, math.ceil(max(rates) / (_FINE * rate_hz)))


def nonlinear_truth(plant: NonlinearPlant) -> Mapping[str, float]:
    """Return the numbers of a nonlinear plant by the names of ``[magnet.parameters]``.

    Returns SI: those of the law and g, of the others those that are not zero; and R, without what a drop adds to it.
    """
    magnet, stage, w = plant.magnet, plant.stage, plant.magnet.coenergy
    if isinstance(magnet, LawMagnet):
        found = {"L_leak": 0.0, **magnet.values, "x_offset": magnet.x_offset}
        kept = {*magnet.law.names[:2], "L_leak", "g"}
    elif isinstance(w, CoEnergy) and (w.k_a == 0.0 or w.s_a == w.s_b):
        found = law_numbers(w)
        kept = {"k", "s", "L_leak", "g"}
    else:
        return {}
    found |= {"a": plant.eddy_pole if math.isfinite(plant.eddy_pole) else 0.0, "v_offset": stage.offset}
    found |= {"v_drop": stage.v_drop, "i_drop": stage.i_drop if stage.v_drop else 0.0}
    found["g"] = plant.gravity
    names = [spec.name for spec in BEARING_NUMBERS if spec.name in found]
    return {"R": plant.R, **{n: found[n] for n in names if found[n] != 0.0 or n in kept}}
