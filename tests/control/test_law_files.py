"""A law as files: C source against the matrices, the script against python-control, and what MATLAB reads."""

import runpy
import shutil
import subprocess

import numpy as np
import pytest
from scipy.io import loadmat

from ambid.control.law_files import write_law
from ambid.errors import EstimationError
from ambid.physics.law import beside
from ambid.physics.loop import Loop
from tests.control.laws import of_preset

DRIVER = """
#include <stdio.h>
#include "law.c"

int main(void)
{
    struct law law;
    double y[LAW_SIGNALS], w[LAW_COMMANDS], given[LAW_COMMANDS], most;
    int j;
    law_reset(&law);
    scanf("%lf", &most);
    for (;;) {
        for (j = 0; j < LAW_SIGNALS; j++)
            if (scanf("%lf", &y[j]) != 1)
                return 0;
        law_command(&law, y, w);
        for (j = 0; j < LAW_COMMANDS; j++) {
            given[j] = w[j] > most ? most : w[j] < -most ? -most : w[j];
            printf("%.17g ", given[j]);
        }
        law_next(&law, y, w, given);
    }
}
"""


def of_rotor():
    bench, plant = of_preset("rmit")
    signals = [f"{a}_{x}" for a in plant.axes for x in ("position", "current")]
    law = beside([bench.loop.as_law(plant.rate_hz)] * len(plant.axes))
    return law, signals, plant.model.inputs


def of_gain():
    return Loop(kp=2.0e4, kc=3.0).as_law(2000.0), ["position", "current"], ["voltage"]


@pytest.mark.parametrize("made", [of_rotor, of_gain])
def test_c_source_computes_the_law(tmp_path, made):
    law, signals, commands = made()
    write_law(law, tmp_path / "law.c", 'a "rig" */ of mine', signals, commands)
    (tmp_path / "main.c").write_text(DRIVER)
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wno-unused-result"]
    subprocess.run([compiler, *flags, "-o", tmp_path / "law", tmp_path / "main.c"], check=True)
    rng, most, z, wanted = np.random.default_rng(1), 2.0, np.zeros(law.order), []
    y = rng.standard_normal((200, len(signals))) * np.tile([1e-5, 1e-2], len(commands))
    text = f"{most} " + " ".join(map(repr, y.ravel().tolist()))
    told = subprocess.run([tmp_path / "law"], input=text, capture_output=True, text=True, check=True).stdout
    for row in y:
        w = law.C @ z + law.D @ row
        wanted.append(np.clip(w, -most, most))
        z = law.A @ z + law.B @ row + law.windup @ (wanted[-1] - w)
    found = np.array(told.split(), dtype=float).reshape(-1, len(commands))
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-12 * np.max(np.abs(wanted)))


def test_script_and_matlab_file_hold_the_law(tmp_path):
    law, signals, commands = of_rotor()
    for ending in (".py", ".mat"):
        write_law(law, tmp_path / f"law{ending}", "rmit", signals, commands)
    system = runpy.run_path(str(tmp_path / "law.py"))["law"]()
    assert (system.input_labels, system.output_labels) == (signals, list(commands))
    assert system.dt == 1.0 / law.rate_hz
    for name in "ABCD":
        np.testing.assert_array_equal(getattr(system, name), getattr(law, name))
    read = loadmat(tmp_path / "law.mat", squeeze_me=True)
    for name in "ABCDG":
        np.testing.assert_array_equal(read[name], law.windup if name == "G" else getattr(law, name))
    assert read["signals"].tolist() == signals
    assert read["rate_hz"] == law.rate_hz
    with pytest.raises(EstimationError, match="ends in none of"):
        write_law(law, tmp_path / "law.txt", "rmit", signals, commands)
