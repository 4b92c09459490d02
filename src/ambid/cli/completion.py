"""What the Tab key offers for the value of an option: the names that the program knows, or the shell's own files."""

from __future__ import annotations

from collections.abc import Callable, Iterable


def _structures() -> Iterable[str]:
    from ambid.blackbox.fit import STRUCTURES
    from ambid.nonlinear.fit import NONLINEAR_STRUCTURES

    return (*STRUCTURES, *NONLINEAR_STRUCTURES)


def _excitations() -> Iterable[str]:
    from ambid.signals import AXES_EXCITATIONS, EXCITATIONS

    return (*EXCITATIONS, *AXES_EXCITATIONS)


def _presets(*, rotors: bool | None = None) -> Iterable[str]:
    from ambid.physics.presets import preset_names

    return preset_names(rotors=rotors)


def _scenarios() -> Iterable[str]:
    from ambid.simulation.scenarios import scenario_names

    return scenario_names()


def _methods() -> Iterable[str]:
    from ambid.job.track_estimator import METHODS

    return METHODS


_NAMES: dict[str, Callable[[], Iterable[str]]] = {
    "--structure NAME": _structures,
    "STRUCTURE:ORDERS...": _structures,
    "--excitation NAME": _excitations,
    "--preset NAME": _presets,
    "--bench PRESET|RIG": lambda: _presets(rotors=False),
    "RIG|PRESET": _presets,
    "--scenario NAME": _scenarios,
    "--method NAME": _methods,
    "--port PORT": lambda: ("emulated", "simulated"),
}


def values_of(usage: str) -> Callable[[str], list[str]]:
    """Return what completes a value of an option or argument with this usage; nothing lets the shell offer files."""

    def complete(incomplete: str) -> list[str]:
        names = _NAMES.get(usage, tuple)()
        return [name for name in names if name.startswith(incomplete)]

    return complete
