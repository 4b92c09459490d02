"""Kill recordings at random moments, recover them, and compare bit by bit: for the test and for the benchmark."""

import os
import random
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambid.acquisition.recorder import JournalReader, journal_path, recorded_from
from ambid.record.hdf5_format import read_hdf5
from tests.acquisition.recorder.signals import ROWS, same_bits, values_at

ROOT = Path(__file__).resolve().parents[3]


@dataclass
class Kill:
    """What became of one recording."""

    acknowledged: int
    recovered: int
    when: str
    fault: str = ""


def killed(folder, cases, seed):
    """Yield what became of each recording."""
    rng = random.Random(seed)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    server = subprocess.Popen(
        [sys.executable, str(Path(__file__).with_name("kill_server.py"))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment,
    )  # fmt: skip
    try:
        for case in range(cases):
            yield one_kill(server, Path(folder) / f"{case}.h5", rng)
    finally:
        server.stdin.close()
        try:
            server.wait(60)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


def one_kill(server, path, rng):
    # Most after a number of blocks that is drawn, some from the first microsecond on, some while the record is made.
    moment = rng.random()
    blocks = rng.randint(1, 1500) if moment < 0.7 else 0 if moment < 0.85 else -1
    delay = rng.uniform(0.0, 0.005 if blocks > 0 else 0.03)
    server.stdin.write(f"{path} {blocks} {delay}\n")
    server.stdin.flush()
    return judged(path, int(server.stdout.readline()))


def judged(path, acknowledged):
    """Recover what there is, and compare it."""
    journal, when = journal_path(path), "after the end"
    if journal.exists():
        when = "while the record was made" if list(path.parent.glob(f".*-{path.name}")) else "while recording"
        try:
            with JournalReader.open(journal) as reader:
                made = recorded_from(reader, path, force=True)
        except Exception as failure:
            made, when = None, f"while the journal was made ({type(failure).__name__})"
        if made is None:
            return Kill(acknowledged, 0, when, "lost all" if acknowledged else "")
        if made.survey.damage.frames or made.survey.gap_samples:
            return Kill(acknowledged, made.survey.blocks, when, "damage in the middle")
    elif not path.exists():
        return Kill(acknowledged, 0, "before the journal", "lost all" if acknowledged else "")
    record = read_hdf5(path)
    values = np.column_stack([c.values for c in record.channels])
    blocks = len(values) // ROWS
    fault = "" if blocks >= acknowledged else f"{acknowledged - blocks} acknowledged blocks lost"
    if not same_bits(values, values_at(0, blocks * ROWS)):
        fault = "values differ"
    return Kill(acknowledged, blocks, when, fault)
