"""The rig file: what is known of a bench, and its records seen through that."""

from ambid.rig.bench import bench_record, mat_variables, read_bench
from ambid.rig.load import default_rig, load_rig
from ambid.rig.rig import Loop, Noise, RecordSettings, Rig, RigChannel

__all__ = [
    "Loop",
    "Noise",
    "RecordSettings",
    "Rig",
    "RigChannel",
    "bench_record",
    "default_rig",
    "load_rig",
    "mat_variables",
    "read_bench",
]
