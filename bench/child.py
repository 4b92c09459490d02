"""Run one command as a whole process; print its wall time, peak memory and exit code as JSON.

A process of its own, and a small one: Linux counts the memory of the process that starts a program into its peak.

Run: python -S child.py WORD...
"""

import json
import subprocess
import sys
import time
from resource import RUSAGE_CHILDREN, getrusage

if __name__ == "__main__":
    before = time.perf_counter()
    done = subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    wall = time.perf_counter() - before
    unit = 1 if sys.platform == "darwin" else 1024
    peak = getrusage(RUSAGE_CHILDREN).ru_maxrss * unit
    said = done.stderr.decode(errors="replace")[-500:]
    print(json.dumps({"wall_s": wall, "peak_bytes": peak, "code": done.returncode, "said": said}))
