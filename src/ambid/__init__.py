"""Physical parameters of active magnetic bearings, with honest uncertainty.

``ambid.job.identify(record, rig)`` is the main job; the names below are what else a script needs. Rooms and names are
imported when they are first used, so that ``import ambid`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str
    from ambid.errors import AmbidError
    from ambid.identify.estimate import Estimate
    from ambid.identify.estimate_file import estimate_from_json
    from ambid.physics.models import model, model_names
    from ambid.physics.presets import preset, preset_names
    from ambid.record import Channel, Record, read_record, write_record
    from ambid.rig import Rig, default_rig, load_rig, read_bench, write_rig
    from ambid.signals import excitation
    from ambid.simulate import simulate_preset, simulate_rig

_HOMES = {
    "AmbidError": "ambid.errors",
    "Channel": "ambid.record",
    "Estimate": "ambid.identify.estimate",
    "Record": "ambid.record",
    "Rig": "ambid.rig",
    "default_rig": "ambid.rig",
    "estimate_from_json": "ambid.identify.estimate_file",
    "excitation": "ambid.signals",
    "load_rig": "ambid.rig",
    "model": "ambid.physics.models",
    "model_names": "ambid.physics.models",
    "preset": "ambid.physics.presets",
    "preset_names": "ambid.physics.presets",
    "read_bench": "ambid.rig",
    "read_record": "ambid.record",
    "simulate_preset": "ambid.simulate",
    "simulate_rig": "ambid.simulate",
    "write_record": "ambid.record",
    "write_rig": "ambid.rig",
}
_ROOMS = ("errors", "identify", "job", "physics", "record", "report", "rig", "signals", "simulate", "units", "validate")

__all__ = [
    "AmbidError",
    "Channel",
    "Estimate",
    "Record",
    "Rig",
    "__version__",
    "default_rig",
    "estimate_from_json",
    "excitation",
    "load_rig",
    "model",
    "model_names",
    "preset",
    "preset_names",
    "read_bench",
    "read_record",
    "simulate_preset",
    "simulate_rig",
    "write_record",
    "write_rig",
]


def __getattr__(name: str) -> object:
    """Import a public name or a room when it is first asked for."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    if name == "__version__":
        from importlib.metadata import version

        return version("ambid")
    if name in _ROOMS:
        return import_module(f"ambid.{name}")
    raise AttributeError(f"module 'ambid' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names and rooms."""
    return sorted({*globals(), *_HOMES, *_ROOMS})
