"""Print the files of ``ambid`` that a record enters on its way through ``ambid.identify``, with calls into each.

python tools/files_entered.py [--preset NAME] [--duration SECONDS]
"""

from __future__ import annotations

import argparse
import collections
import sys
from pathlib import Path
from types import FrameType

import ambid


def main() -> None:
    """Identify once to load everything, and once to count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="thesis")
    parser.add_argument("--duration", type=float, default=1.0)
    options = parser.parse_args()
    root = str(Path(ambid.__file__).parent)
    calls: collections.Counter[str] = collections.Counter()

    def profile(frame: FrameType, event: str, _argument: object) -> None:
        name = frame.f_code.co_filename
        if event == "call" and name.startswith(root):
            calls[name[len(root) + 1 :]] += 1

    record = ambid.simulate(options.preset, duration=options.duration, seed=1)
    ambid.identify(record)
    sys.setprofile(profile)
    ambid.identify(record)
    sys.setprofile(None)
    for name, count in sorted(calls.items()):
        print(f"{count:7} {name}")
    print(f"{len(calls)} files")


if __name__ == "__main__":
    main()
