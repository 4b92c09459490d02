"""Samples in which the rotor touches a stop: a force acts there that the model does not have.

A few touches in thousands of samples are enough to move every number by deviations, as each hits the predictor with a
force hundreds of times the noise. They are not thrown away: position and current are measured on; force and motional
voltage are what is unknown, as the speed ends somewhere within the sample. This holds for touches. A rotor that lies
on a stop is carried by a force that does not average out: such stretches have to be cut out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.identify.nonlinear_bearing.problem import BearingRecord
from ambid.identify.scaling import noise_floor
from ambid.physics.loop import Interval

LYING = 0.05
"""Share of a record's samples at a stop above which it is more than touches."""

_NEAR = 6.0  # standard deviations of the sensor from a stop within which the rotor may lie at it
_LOCAL, _REST = 3, 3.0  # samples over which the speed is looked for, and its floor in the sensor's deviations a sample
_AROUND = 1  # samples before and after: it comes and goes between them


def touching(record: BearingRecord, stops: Interval) -> BearingRecord:
    """Take the force as unknown while the rotor is at a stop.

    The acceleration there is given the standard deviation of stopping within a sample from the speed seen about it.

    Parameters
    ----------
    record : BearingRecord
        Of a rotor that is free to move.
    stops : (float, float)
        Positions in m, as the sensor shows them, at which the rotor touches; infinite for none.

    Returns
    -------
    BearingRecord
        With `knock` where that is so; the record as it was where the rotor never touches.
    """
    x, noise = record.y[:, 0], float(noise_floor(record.y)[0])
    at = (x <= stops[0] + _NEAR * noise) | (x >= stops[1] - _NEAR * noise)
    at &= record.valid[:, 0]
    if record.held or not at.any():
        return record
    for _ in range(_AROUND):
        at[:-1] |= at[1:]
        at[1:] |= at[:-1]
    step = np.abs(np.diff(x, prepend=x[0]))
    near = np.max([np.roll(step, k) for k in range(-_LOCAL, _LOCAL + 1)], axis=0) + _REST * noise
    knock = np.where(at, near * record.rate_hz**2, 0.0)
    if record.knock is not None:
        knock = np.hypot(knock, record.knock)
    return replace(record, knock=knock)
