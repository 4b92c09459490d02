"""An estimate of physical parameters from the embedded record."""

from functools import cache
from importlib.resources import files

from ambid.job import identify


@cache
def demo():
    data = files("ambid") / "data"
    return identify(str(data / "demo.csv.gz"), rig=str(data / "demo.toml"))
