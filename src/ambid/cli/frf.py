"""``ambid frf``: a frequency response from one record, and models fitted to it; ``ambid margins``: of a loop."""

from __future__ import annotations

from typing import Any

from ambid.cli.options import Values, verb
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress
from ambid.errors import AmbidError
from ambid.settings.caller import setting


@verb("frf")
def command(v: Values) -> None:
    """Measure a frequency response with its noise and distortion, or take one from .uff, .unv or .csv; fit models.

    With --reference (the loop's outer excitation) feedback does not bias it. With --rig, physical parameters come out,
    and inputs and outputs are the rig's.
    """
    from ambid.job import frf

    with Outputs(v.record, v.rig, v.estimate, **v.outputs) as outputs:
        how = v.only("input output reference open_loop method hold band orders feedthrough estimate domain rig")
        how |= v.only("from_s to_s rate_hz gaps layout") | {
            "state_space": _number(v.state_space, int, "an order", "state_space", "n=3"),
            "modes": _number(v.modes, int, "a number of modes", "modes", "auto"),
            "delay": _number(v.delay, float, "a time in s", "delay", "1e-4"),
        }
        with progress("measure") as tick:
            found = frf(v.record, **how, tick=tick)
            outputs.give(found, tick)
    outputs.show(found, strict=v.strict)


@verb("margins")
def margins(v: Values) -> None:
    """Show the margins of the loop: sensitivity by ISO 14839-3, gain, phase, delay, compliance.

    The controller is identified where the excitation is logged as reference, else it is the rig's [loop], as for an
    estimate alone. Without --rig, that of the estimate is used.
    """
    from ambid.job import margins

    with Outputs(v.record, v.rig, v.estimate, **v.outputs) as outputs, progress("margins") as show:
        how = v.only("estimate reference from_s to_s rate_hz gaps layout")
        found = margins(v.record, v.rig, **how, tick=show)
        outputs.give(found, show)
    outputs.show(found, strict=v.strict)


def _number(text: str | None, kind: type, what: str, name: str, example: str) -> Any:
    """Read a number that may be ``auto``; of an order ``n=`` may stand before it."""
    if text is None or text.strip() == "auto":
        return None if text is None else "auto"
    digits = text.strip().removeprefix("n=" if name == "state_space" else "")
    try:
        if kind is int and not (digits.isdecimal() and len(digits) <= 3 and (name != "modes" or int(digits))):
            raise ValueError
        return kind(digits)
    except ValueError:
        raise AmbidError(
            f"{setting(name)} is {text!r}; it must be {what}, or auto. Give {setting(name, example)}, for example"
        ) from None
