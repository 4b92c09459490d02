"""The linear models there are, by name."""

from __future__ import annotations

from ambid.errors import ModelError, nearest
from ambid.physics.coil import Coil
from ambid.physics.linear_model import LinearModel
from ambid.physics.one_axis import OneAxis
from ambid.physics.rotor import Rotor

_MODELS: dict[str, LinearModel] = {m.name: m for m in (OneAxis(), Coil(), Rotor())}


def model_names() -> tuple[str, ...]:
    """Return the names of all linear models.

    Returns
    -------
    tuple of str
        Names as they are written in a rig file.
    """
    return tuple(_MODELS)


def model(name: str) -> LinearModel:
    """Return the linear model called `name`.

    Parameters
    ----------
    name : str
        One of `model_names`.

    Returns
    -------
    LinearModel
        The model.

    Raises
    ------
    ModelError
        If there is none of that name; the message names the nearest.
    """
    if name not in _MODELS:
        raise ModelError(
            f"there is no model {name!r}; there are {', '.join(_MODELS)}.{nearest(name, list(_MODELS))} "
            "See 'ambid models'"
        )
    return _MODELS[name]
