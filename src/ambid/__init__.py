"""Physical parameters of active magnetic bearings, with honest uncertainty.

``ambid.identify(record, rig)`` is the main job; `fit`, `frf`, `compare`, `margins`, `accept`, `simulate`, `track`,
`validate`, `info`, `init` and `acquire` are the functions that the commands of these names call, and `load` reads what
they wrote. Rooms and names are imported when they are first used, so that ``import ambid`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    __version__: str
    from ambid.errors import AmbidError as AmbidError
    from ambid.estimation.estimate import Estimate as Estimate
    from ambid.estimation.estimate import estimate_from_json as estimate_from_json
    from ambid.fleet.run import fleet as fleet
    from ambid.job import accept as accept
    from ambid.job import acquire as acquire
    from ambid.job import compare as compare
    from ambid.job import demo as demo
    from ambid.job import design_controller as design_controller
    from ambid.job import design_experiment as design_experiment
    from ambid.job import fit as fit
    from ambid.job import frf as frf
    from ambid.job import history as history
    from ambid.job import identify as identify
    from ambid.job import identify_nonlinear as identify_nonlinear
    from ambid.job import info as info
    from ambid.job import init as init
    from ambid.job import load as load
    from ambid.job import margins as margins
    from ambid.job import simulate as simulate
    from ambid.job import track as track
    from ambid.job import validate as validate
    from ambid.physics.linear_model import model as model
    from ambid.physics.linear_model import model_names as model_names
    from ambid.physics.presets import preset as preset
    from ambid.physics.presets import preset_names as preset_names
    from ambid.record import Channel as Channel
    from ambid.record import Record as Record
    from ambid.record import read_record as read_record
    from ambid.record import write_record as write_record
    from ambid.rig import Rig as Rig
    from ambid.rig import default_rig as default_rig
    from ambid.rig import load_rig as load_rig
    from ambid.rig import read_bench as read_bench
    from ambid.rig import write_rig as write_rig
    from ambid.signals import excitation as excitation
    from ambid.simulation import simulate_preset as simulate_preset
    from ambid.simulation import simulate_rig as simulate_rig

_ROOMS = (
    "bearing", "blackbox", "control", "errors", "estimation", "job", "ledger", "nonlinear", "physics", "record",
    "recursive", "report", "rig", "signals", "simulation", "tracking", "units", "validation",
)  # fmt: skip

_exported, __dir__, __all__ = exports(__name__)


def __getattr__(name: str) -> object:
    """Import a public name or a room when it is first asked for."""
    if name == "__version__":
        from importlib.metadata import version

        return version("ambid")
    if name in _ROOMS:
        return import_module(f"ambid.{name}")
    if name not in __all__ and not name.startswith("_"):
        from ambid.settings.elsewhere import PACKAGE, missing

        raise missing("ambid", name, __dir__(), PACKAGE)
    return _exported(name)
