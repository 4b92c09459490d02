"""The loop of a record as it is: plant of an estimate, controller of the record or of the rig."""

from __future__ import annotations

import numpy as np

from ambid.control.closed import ClosedLoop, Plant
from ambid.control.controller import controller_of_loop, identify_controller
from ambid.errors import EstimationError
from ambid.rig import Rig
from ambid.rotor.estimate import RotorEstimate
from ambid.rotor.spectra import PeriodSpectra
from ambid.simulation.plant import fed_back

_NO_FEEDBACK = 1e-4  # share of an input below which nothing is fed back


def closed_loop(estimate: RotorEstimate, rig: Rig, spectra: PeriodSpectra) -> ClosedLoop:
    """Return the closed loop of an estimate; EstimationError where nothing says what the controller is."""
    assert rig.rotor is not None
    model = rig.rotor.at_speed(estimate.speed).with_modes(estimate.n_modes)
    plant = Plant.of(
        model, estimate.numbers, estimate.delay, spectra.rate_hz, estimate.covariance_names, estimate.covariance
    )
    if spectra.R is not None:
        own = [[k for k in pair if k >= 0] for pair in fed_back(model)]
        controller = identify_controller(
            spectra.frequency_hz, spectra.mean_u, spectra.mean_y, spectra.R, rate_hz=spectra.rate_hz, own=own
        )
        back = np.einsum("kuy,ky->ku", controller.response(spectra.frequency_hz)[0], spectra.mean_y)
        if np.max(np.abs(back)) < _NO_FEEDBACK * np.max(np.abs(spectra.mean_u)):
            raise EstimationError(
                "the inputs of the record follow its references alone: no loop is closed, and none has margins. Record "
                "the levitated rotor"
            )
    elif rig.loop is not None and rig.loop.closed:
        controller = controller_of_loop(rig.loop, model, spectra.rate_hz)
    else:
        raise EstimationError(
            "neither a reference in the record nor [loop] in the rig says what the controller is. Log the excitation "
            "as reference, or give [loop]"
        )
    return ClosedLoop.of(plant, controller)
