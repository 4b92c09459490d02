"""Exported plants as something that is stepped: C source that is compiled, an FMU in FMPy."""

import ctypes
import runpy
import shutil
import subprocess

import numpy as np
import pytest
from scipy.io import loadmat

from ambid.job.exchange import write_plant

CC = shutil.which("cc")
needs_compiler = pytest.mark.skipif(CC is None, reason="no C compiler")
FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-O1", "-shared", "-fPIC")
DRIVER = """
static struct plant held;
int steps(const double *u, double force, double length);
void outputs(double *y);
void begin(void);
void begin(void) { plant_reset(&held, &plant_identified); }
void outputs(double *y) { plant_outputs(&held, y); }
int steps(const double *u, double force, double length)
{
    double d[PLANT_DISTURBANCES] = {0.0};
    d[0] = force;
    return plant_step(&held, u, d, length);
}
"""


class InC:
    """The C source of a plant, compiled."""

    def __init__(self, estimate, folder, *, anyway=False):
        write_plant(estimate, folder / "plant.c", "plant", anyway=anyway)
        (folder / "driver.c").write_text('#include "plant.c"\n' + DRIVER)
        subprocess.run([CC, *FLAGS, "-o", "plant.so", "driver.c", "-lm"], cwd=folder, check=True)
        self.made, self.y = ctypes.CDLL(str(folder / "plant.so")), (ctypes.c_double * 32)()
        self.made.begin()

    def step(self, u, length, force=0.0):
        given = (ctypes.c_double * np.size(u))(*np.atleast_1d(u))
        return self.made.steps(given, ctypes.c_double(force), ctypes.c_double(length))

    def outputs(self):
        self.made.outputs(self.y)
        return self.y[:]


class InFmpy:
    """The FMU of a plant, in FMPy."""

    def __init__(self, path, folder, name="one", **start):
        fmpy = pytest.importorskip("fmpy")
        from fmpy.fmi2 import FMU2Slave

        self.told = fmpy.read_model_description(str(path))
        self.at = {v.name: v.valueReference for v in self.told.modelVariables}
        inputs = (v.name for v in self.told.modelVariables if v.causality == "input")
        self.driven = [name for name in inputs if not name.startswith("disturbing")]
        self.shown = [v.valueReference for v in self.told.modelVariables if v.causality == "output"]
        self.fmu = FMU2Slave(
            guid=self.told.guid, unzipDirectory=fmpy.extract(str(path), str(folder)), instanceName=name,
            modelIdentifier=self.told.coSimulation.modelIdentifier,
        )  # fmt: skip
        self.fmu.instantiate()
        self.begin(**start)

    def begin(self, **start):
        self.time = 0.0
        self.fmu.setupExperiment(startTime=0.0)
        self.set(**start)
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, **values):
        self.fmu.setReal([self.at[name] for name in values], list(values.values()))

    def step(self, u, length):
        self.set(**dict(zip(self.driven, np.atleast_1d(u).tolist(), strict=True)))
        self.fmu.doStep(self.time, length)
        self.time += length
        return 0

    def outputs(self):
        return self.fmu.getReal(self.shown)


def runs_of_exports(estimate, folder, u, *, anyway=True):
    """What each export of an estimate makes of the same inputs, (n, n_y) from the operating point."""
    control = pytest.importorskip("control")
    period = 1.0 / float((estimate.records[0] if hasattr(estimate, "law") else estimate.record)["rate_hz"])
    for ending, to in ((".mat", None), (".py", "control"), (".fmu", None)):
        write_plant(estimate, folder / f"plant{ending}", "plant", to, anyway=anyway)
    read = loadmat(folder / "plant.mat", simplify_cells=True)["sampled"]
    script = runpy.run_path(str(folder / "plant.py"))["sampled"]()
    n_y, n_u = script.noutputs, script.ninputs
    matrices = (np.asarray(read[x]).reshape(rows, columns) for x, rows, columns in (
        ("A", script.nstates, script.nstates), ("B", script.nstates, n_u), ("C", n_y, script.nstates)
    ))  # fmt: skip
    found = {
        ".mat": _states(*matrices, u),
        ".py": control.forced_response(script, inputs=u.T, squeeze=False).outputs.T,
    }
    for name, plant in (
        (".c", InC(estimate, folder, anyway=anyway)),
        (".fmu", InFmpy(folder / "plant.fmu", folder / "open")),
    ):
        rows = []
        for value in u:
            rows.append(plant.outputs()[:n_y])
            assert plant.step(value, period) == 0
        found[name] = np.array(rows)
    return found


def _states(A, B, C, u):
    x, rows = np.zeros(A.shape[0]), []
    for value in u:
        rows.append(C @ x)
        x = A @ x + B @ value
    return np.array(rows)


def assert_agree(runs, within=1e-9):
    """Each output of every export the same, as a share of its range."""
    wanted = runs[".mat"]
    assert np.all(np.ptp(wanted, axis=0) > 0.0)
    for name, y in runs.items():
        assert np.max(np.abs(y - wanted) / np.ptp(wanted, axis=0)) < within, name
