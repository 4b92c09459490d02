"""Memory and time of reading a long record from TDMS and MDF, each read in a process of its own; structures of MATLAB
beside scipy.io.loadmat alone, and CSV beside numpy.loadtxt, in turn in one process.

python bench/formats.py [SAMPLES]
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

STREAMS, RATE_HZ, BLOCK = ("voltage", "current", "position", "reference"), 20_000.0, 100_000
UNITS = ("V", "A", "um", "V")
CHILD = """
import json, resource, sys, time
from ambid.record import read_record
begin = time.perf_counter()
record = read_record(sys.argv[1])
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
print(json.dumps({"MB": peak * 1.048576, "s": time.perf_counter() - begin, "samples": record.n_samples,
                  "last": [c.values[-1] for c in record.channels]}))
"""


def blocks(n: int):
    """Yield the number of the first sample and the values, so that the writer does not need room for all either."""
    random = np.random.default_rng(1)
    for at in range(0, n, BLOCK):
        yield at, random.standard_normal((len(STREAMS), min(BLOCK, n - at)))


def write_tdms(path: Path, n: int) -> np.ndarray:
    import nptdms

    with nptdms.TdmsWriter(path) as writer:
        for _, values in blocks(n):
            writer.write_segment(
                [
                    nptdms.ChannelObject("Log", name, x, {"wf_increment": 1 / RATE_HZ, "unit_string": unit})
                    for name, unit, x in zip(STREAMS, UNITS, values, strict=True)
                ]
            )
    return values[:, -1]


def write_mdf(path: Path, n: int) -> np.ndarray:
    import asammdf

    mdf = asammdf.MDF(version="4.10")
    for at, values in blocks(n):
        t = np.arange(at, at + values.shape[1]) / RATE_HZ
        if at == 0:
            named = zip(STREAMS, UNITS, values, strict=True)
            mdf.append([asammdf.Signal(x, t, name=name, unit=unit) for name, unit, x in named])
        else:
            mdf.extend(0, [(t, None), *((x, None) for x in values)])
    mdf.save(path, overwrite=True)
    mdf.close()
    return values[:, -1]


def beside(n: int = 200_000, rounds: int = 15) -> None:
    """Print the time of reading MATLAB and CSV over that of the bare library, the least of rounds in turn."""
    from scipy.io import loadmat, savemat

    from ambid.record import read_record

    t, data = np.arange(n) / RATE_HZ, np.random.default_rng(1).standard_normal((7, n))
    series = {name: {"Time": t, "Data": x, "Name": name} for name, x in zip(STREAMS, data, strict=False)}
    signals = np.array(
        [(x, name) for name, x in zip(STREAMS, data, strict=False)], dtype=[("values", "O"), ("label", "O")]
    )
    axis = np.array([("t", t)], dtype=[("Name", "O"), ("Data", "O")])
    measured = np.array(list(zip(STREAMS, data, strict=False)), dtype=[("Name", "O"), ("Data", "O")])
    contents = {
        "Simulink": {"log": {"time": t, "signals": signals}}, "timeseries": {"logsout": series},
        "dSPACE": {"rec": {"X": axis, "Y": measured}}, "columns": {"run": {"time": t, "u": data[0], "i": data[1]}},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        pairs = {}
        for name, content in contents.items():
            path = Path(folder) / f"{name}.mat"
            savemat(path, content)
            pairs[path] = loadmat
        table = Path(folder) / "eight columns.csv"
        head = ",".join(["time [s]", *(f"c{k} [V]" for k in range(7))])
        np.savetxt(table, np.column_stack([t, data.T]), delimiter=",", header=head, comments="", fmt="%.9g")
        pairs[table] = lambda path: np.loadtxt(path, delimiter=",", skiprows=1)
        for path, bare in pairs.items():
            seconds = []
            for _ in range(rounds if path.suffix == ".mat" else 3):
                begin = time.perf_counter()
                bare(path)
                middle = time.perf_counter()
                read_record(path)
                seconds.append((time.perf_counter() - middle, middle - begin))
            ours, alone = np.min(seconds, axis=0)
            print(f"{path.name}: {ours * 1e3:.1f} ms, bare library {alone * 1e3:.1f} ms, ratio {ours / alone:.2f}")


def main(n: int) -> None:
    beside()
    print(f"{n} samples x {len(STREAMS)} streams, {8e-6 * n * len(STREAMS):.0f} MB of values")
    with tempfile.TemporaryDirectory() as folder:
        for name, write in (("long.tdms", write_tdms), ("long.mf4", write_mdf)):
            path = Path(folder) / name
            begin = time.perf_counter()
            last = write(path, n)
            took = time.perf_counter() - begin
            child = subprocess.run([sys.executable, "-c", CHILD, path], stdout=subprocess.PIPE, text=True, check=True)
            found = json.loads(child.stdout)
            scale = np.array([1.0, 1.0, 1e-6, 1.0])
            assert found["samples"] == n
            assert np.allclose(found["last"], last * scale, rtol=1e-12)
            print(
                f"{name}: file {path.stat().st_size / 1e6:.0f} MB, written in {took:.1f} s, read in {found['s']:.1f} "
                f"s, peak {found['MB']:.0f} MB"
            )
            path.unlink()


if __name__ == "__main__":
    main(int(float(sys.argv[1])) if len(sys.argv) > 1 else 10_000_000)
