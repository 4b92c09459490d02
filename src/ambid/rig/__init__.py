"""The rig file: what is known of a bench, and its records seen through that."""

from ambid.rig.draft import draft_rig, preset_text, rig_of_preset
from ambid.rig.load import (
    bench_record,
    default_rig,
    load_rig,
    mat_variables,
    read_bench,
    rig_from_tables,
    rig_from_text,
)
from ambid.rig.rig import Daq, RecordSettings, Rig, RigChannel, RigMagnet, rig_text, write_rig

__all__ = [
    "Daq",
    "RecordSettings",
    "Rig",
    "RigChannel",
    "RigMagnet",
    "bench_record",
    "default_rig",
    "draft_rig",
    "load_rig",
    "mat_variables",
    "preset_text",
    "read_bench",
    "rig_from_tables",
    "rig_from_text",
    "rig_of_preset",
    "rig_text",
    "write_rig",
]
