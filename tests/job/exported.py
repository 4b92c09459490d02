"""Exported plants as something that is stepped: C source that is compiled, an FMU in FMPy."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

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

    def step(self, u, length, force=0.0):
        self.set(voltage=u, disturbing_force=force)
        self.fmu.doStep(self.time, length)
        self.time += length
        return 0

    def outputs(self):
        return self.fmu.getReal(self.shown)
