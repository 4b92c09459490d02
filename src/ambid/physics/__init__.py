"""Parameters, magnets, models and their exact discretisation, control loop, presets, shafts and their whirl."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.physics.linear_model import LinearModel as LinearModel
    from ambid.physics.linear_model import Parameter as Parameter
    from ambid.physics.linear_model import model as model
    from ambid.physics.linear_model import model_names as model_names
    from ambid.physics.loop import Limits as Limits
    from ambid.physics.loop import Noise as Noise
    from ambid.physics.loop import placed_loop as placed_loop
    from ambid.physics.magnet import DifferentialPair as DifferentialPair
    from ambid.physics.nonlinear import NonlinearPlant as NonlinearPlant
    from ambid.physics.presets import preset as preset
    from ambid.physics.shaft import Disc as Disc
    from ambid.physics.shaft import FreeRotor as FreeRotor
    from ambid.physics.shaft import Material as Material
    from ambid.physics.shaft import Shaft as Shaft
    from ambid.physics.shaft import Step as Step
    from ambid.physics.whirl import Campbell as Campbell
    from ambid.physics.whirl import CriticalSpeed as CriticalSpeed
    from ambid.physics.whirl import Support as Support
    from ambid.physics.whirl import campbell as campbell
    from ambid.physics.whirl import critical_speeds as critical_speeds

__getattr__, __dir__, __all__ = exports(__name__)
