"""Does the force of one magnet carry the weight, whatever the dynamics say?

Over any stretch without touches the impulse of the force is that of the weight and the momentum gained: the mean of
f/(m g) is (v_end - v_begin)/(g T) - 1. Neither coil nor noise enter.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ambid.bearing.magnet.problem import BearingRecord
from ambid.physics.coenergy_law import MagnetLaw

_SPEED = 8  # samples over which a speed is taken
_LEAST = 50  # samples of a stretch that counts


def weight_carried(law: MagnetLaw, values: Mapping[str, float], record: BearingRecord) -> float | None:
    """Return the mean force of one magnet over what it would have to be.

    `law`: of one magnet; `values`: numbers, SI; m and g among them; `record`: of a rotor that is free to move. Returns
    1 where the law carries the weight; None where no stretch is long enough to tell.
    """
    free = np.ones(record.u.size, dtype=np.bool_) if record.cut is None else ~record.cut
    if record.knock is not None:
        free &= record.knock == 0.0
    edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]])))
    found, wanted = 0.0, 0.0
    for first, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if end - first < _LEAST:
            continue
        part = record.y[first + _SPEED // 2 : end - _SPEED // 2]
        ends = record.y[first : first + _SPEED + 1, 0], record.y[end - _SPEED - 1 : end, 0]
        before, after = ((x[-1] - x[0]) * record.rate_hz / _SPEED for x in ends)
        x, i = part[:, 0] - values.get("x_offset", 0.0), part[:, 1] - values.get("i_offset", 0.0)
        rubbed = values.get("c", 0.0) * float(part[-1, 0] - part[0, 0]) * record.rate_hz
        found += float(np.sum(law.force(x, i, values))) - rubbed
        wanted += values["m"] * ((after - before) * record.rate_hz - values["g"] * part.shape[0])
    return float(found / wanted) if wanted else None
