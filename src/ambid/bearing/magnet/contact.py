"""Samples in which the rotor touches a stop: a force acts there that the model does not have.

A few touches in thousands of samples are enough to move every number by deviations, as each hits the predictor with a
force hundreds of times the noise. They are not thrown away: position and current are measured on; force and motional
voltage are what is unknown, as the speed ends somewhere within the sample. A rotor that lies on a stop is carried by a
force that does not average out: those stretches are cut, and the predictor begins anew where the rotor is free again.

Whether the force of one magnet carries the weight shows over any stretch without touches: the impulse of the force is
that of the weight and the momentum gained, so that the mean of f/(m g) is (v_end - v_begin)/(g T) - 1. Neither coil nor
noise enter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ambid.bearing.magnet.problem import BearingRecord
from ambid.estimation.problem import noise_floor
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.loop import Interval

_NEAR = 6.0  # standard deviations of the sensor from a stop within which the rotor may lie at it
_LOCAL, _REST = 3, 3.0  # samples over which the speed is looked for, and its floor in the sensor's deviations a sample
_AROUND = 1  # samples before and after: it comes and goes between them
_LASTING = 5  # samples at a stop from which it is more than a touch
_FREE = 40  # samples between two such stretches that are not worth a new beginning
_SPEED = 8  # samples over which a speed is taken
_LEAST = 50  # samples of a stretch that counts


def touching(record: BearingRecord, stops: Interval) -> BearingRecord:
    """Take the force as unknown while the rotor touches a stop, and cut out where it lies on one.

    The acceleration of a touch is given the standard deviation of stopping within a sample from the speed seen about
    it.

    `record`: of a rotor that is free to move. Returns with `knock` and `cut` where that is so; the record as it was
    where the rotor never touches.
    """
    x, noise = record.y[:, 0], float(noise_floor(record.y)[0])
    at = (x <= stops[0] + _NEAR * noise) | (x >= stops[1] - _NEAR * noise)
    at &= record.valid[:, 0]
    if record.held:
        return record
    cut = _lasting(at)
    # between two samples it may have come and gone
    reach = _NEAR * noise + np.abs(np.diff(x, append=x[-1]))
    at |= record.valid[:, 0] & ((x - stops[0] <= reach) | (stops[1] - x <= reach))
    if not at.any():
        return record
    for _ in range(_AROUND):
        at[:-1] |= at[1:]
        at[1:] |= at[:-1]
    step = np.abs(np.diff(x, prepend=x[0]))
    near = np.max([np.roll(step, k) for k in range(-_LOCAL, _LOCAL + 1)], axis=0) + _REST * noise
    knock = np.where(at, near * record.rate_hz**2, 0.0)
    if record.knock is not None:
        knock = np.hypot(knock, record.knock)
    if not cut.any():
        return replace(record, knock=knock)
    knock[cut] = 0.0
    if record.cut is not None:
        cut |= record.cut
    return replace(record, knock=knock, cut=cut, valid=record.valid & ~cut[:, None])


def _lasting(at: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which samples belong to lying: long stays with what is about them, and what is too short between two of them."""
    cut = np.zeros(at.size, dtype=np.bool_)
    for first, end in _runs(at):
        if end - first >= _LASTING:
            cut[max(first - _AROUND - 1, 0) : end + _AROUND + 1] = True
    if cut.any():
        for first, end in _runs(~cut):
            if end - first < _FREE:
                cut[first:end] = True
    return cut


def _runs(on: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


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
