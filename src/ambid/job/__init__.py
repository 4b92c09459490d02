"""The jobs: what the commands do, as functions; command line, benchmarks and tests call these, so what is tested runs.

One record, or several, and what is known of the bench go in; one result that was judged comes out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.job.acceptance import accept as accept
    from ambid.job.acquiring import acquire as acquire
    from ambid.job.commissioning import commission as commission
    from ambid.job.controller_design import design_controller as design_controller
    from ambid.job.data import load_bench as load_bench
    from ambid.job.data import read_data as read_data
    from ambid.job.data import signals_of as signals_of
    from ambid.job.drafting import info as info
    from ambid.job.drafting import init as init
    from ambid.job.experiment_design import design_experiment as design_experiment
    from ambid.job.fits import compare as compare
    from ambid.job.fits import fit as fit
    from ambid.job.fits import physics as physics
    from ambid.job.identification import demo as demo
    from ambid.job.identification import identify as identify
    from ambid.job.identification import identify_nonlinear as identify_nonlinear
    from ambid.job.loop_margins import margins as margins
    from ambid.job.response import frf as frf
    from ambid.job.results import history as history
    from ambid.job.results import load as load
    from ambid.job.results import validate as validate
    from ambid.job.simulation import simulate as simulate
    from ambid.job.tracking import track as track

__getattr__, __dir__, __all__ = exports(__name__)
