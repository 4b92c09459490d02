"""Measured records of a levitated ball: begun on the first half, the second half is predicted as well as off-line."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.job import identify, load_bench
from ambid.recursive.joint import JointEkf, JointUkf
from ambid.rig import load_rig
from tests.real.test_maglev import AXIS_RIG, MAGLEV, written
from tests.recursive.joint_starts import rates_of

pytestmark = pytest.mark.skipif(not MAGLEV.is_dir(), reason="the measured records are not beside this checkout")


@pytest.mark.parametrize("name", ["updown_c"])
def test_innovations_of_the_second_half_are_those_of_a_model_fitted_to_it(tmp_path, name):
    path, rig = MAGLEV / f"levitate_{name}.csv", load_rig(written(tmp_path, AXIS_RIG))
    record = load_bench(path, rig, from_s=2.0)
    half = record.n_samples // 2
    begun = identify(path, rig, from_s=2.0, to_s=2.0 + half / record.rate_hz)
    later = identify(path, rig, from_s=2.0 + half / record.rate_hz)
    wanted = [later.fit[r].innovation_sd for r in ("position", "current")]
    share = dict.fromkeys(begun.covariance_names, 0.02)
    rates = rates_of(share, begun.values) | {"force_offset": 0.02, "voltage_offset": 0.1}
    for kind in (JointEkf, JointUkf):
        filter_ = kind.from_estimate(begun, record.rate_hz, rates=rates)
        errors = filter_.update(record["voltage"][half:], np.column_stack([record[r] for r in later.fit])[half:])
        assert np.all(np.sqrt(np.nanmean(errors[10:] ** 2, axis=0)) < 1.05 * np.array(wanted))
        assert filter_.n_rejected == 0
