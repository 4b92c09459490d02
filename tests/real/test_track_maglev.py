"""Tracking of a measured, levitated ball through other operating points and under other controllers.

Started on the first half of one record. A model fitted off-line to the very data that are tracked predicts them at best
5 % better, by the root mean square of the innovations of each output.
"""

from functools import cache

import numpy as np
import pytest

from ambid.job import identify
from ambid.job.track_start import rows_of
from ambid.rig import load_rig
from ambid.tracking.evidence import Samples
from ambid.tracking.rpem import PhysicalRpem
from ambid.tracking.supervisor import Supervisor
from tests.real.test_maglev import AXIS_RIG, MAGLEV, written

pytestmark = pytest.mark.skipif(not MAGLEV.is_dir(), reason="the measured records are not beside this checkout")

RECORDS = {"stairs_a": 8.5, "stairs_b": 2.0, "updown_c": 2.0, "sine_d": 2.0, "sine_e": 2.0}


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    return load_rig(written(tmp_path_factory.mktemp("maglev"), AXIS_RIG))


@pytest.fixture(scope="module")
def begun(rig):
    return identify(MAGLEV / "levitate_stairs_a.csv", rig, from_s=2.0, to_s=8.5)


@pytest.fixture(scope="module")
def record(rig):
    @cache
    def read(name):
        """Samples of a record, and innovations of the model that is fitted to them off-line."""
        file = MAGLEV / f"levitate_{name}.csv"
        values = rows_of(file, rig, from_s=RECORDS[name], to_s=None, rate_hz=None).replay.values
        whole = values[np.isfinite(values).all(axis=1)]
        fit = identify(file, rig, from_s=RECORDS[name]).fit
        return whole[:, :1].copy(), whole[:, 1:].copy(), [fit[k].innovation_sd for k in ("position", "current")]

    return read


@pytest.mark.parametrize("name", RECORDS)
@pytest.mark.parametrize("supervised", [False, True])
def test_innovations_are_no_worse_than_those_of_a_model_fitted_to_the_data(record, begun, name, supervised):
    u, y, off_line = record(name)
    rpem = PhysicalRpem(begun)
    if supervised:
        supervisor, samples = Supervisor(rpem), Samples(u=u, y=y)
        errors = np.vstack([supervisor.feed(samples.part(k, k + 10), k) for k in range(0, len(y), 10)])
    else:
        errors = rpem.update(u, y)
    rms = np.sqrt(np.mean(errors[200:] ** 2, axis=0))
    assert np.all(rms < 1.05 * np.array(off_line))
    assert rpem.n_unreached == 0
