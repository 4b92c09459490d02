"""The exceptions of `ambid`.

Every error that input can cause is an :class:`AmbidError`; the command line prints it on one line and exits with 2.
Anything else that escapes is a defect of the program.
"""

import difflib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any


class AmbidError(Exception):
    """Input refused.

    The message names what, where, the rule and the remedy, on one line:
    ``column 'current' is in [V]; the rig needs a current unit. Fix the header, or give channels.current.gain``.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class UnitError(AmbidError):
    """A unit is unknown, missing, or of another kind than the quantity it stands with."""


class RecordError(AmbidError):
    """A record, its file or one of its channels breaks a rule of the record format."""


class RigError(AmbidError):
    """A rig file or one of its entries breaks a rule of the rig schema."""


class ModelError(AmbidError):
    """A model is unknown, or its parameters do not make a physical plant."""


class EstimationError(AmbidError):
    """The data cannot be turned into an estimate at all (as opposed to a poor one, which is given with its flags)."""


class DeviceError(AmbidError):
    """A controller, its port or its line: not there, not understood, refusing, or in its safe state."""


def nearest(word: object, known: Sequence[str]) -> str:
    """Return `` Did you mean 'x'?`` for the known word closest to `word`, or an empty string.

    `word`: what was written; `known`: what may be written. Returns a sentence that begins with a space, or ``""``.
    """
    turned = [k for k in known if sorted(k) == sorted(str(word))]  # two letters exchanged come before another word
    close = turned[:1] or difflib.get_close_matches(str(word), known, n=1, cutoff=0.4)
    return f" Did you mean {close[0]!r}?" if close else ""


def counted(n: float | str, noun: str) -> str:
    """Return a number of things, as in ``1 sample``, ``2 samples``, ``3.25 samples``; a number may be text already."""
    text = f"{n:.3g}" if isinstance(n, float) else str(n)
    return f"{text} {noun}{'' if text == '1' else 's'}"


def refuse_given(given: Mapping[str, object], refusal: str) -> None:
    """Refuse the first option that was given although it has no use; its name replaces ``{}`` in the refusal.

    `given`: by name; None, False and what is empty were not given.
    """
    for name, value in given.items():
        if not (value is None or value is False or (isinstance(value, (Sequence, Mapping)) and not value)):
            raise EstimationError(refusal.replace("{}", name))


LARGEST = 1e9
"""What a time in s or an amplitude may be at most: beyond it is a slip, and numbers of samples would overflow."""


def check_positive(given: Mapping[str, object]) -> None:
    """Refuse by option what is not a number, not positive, not finite or absurd; None was not given."""
    _check(given, Real, lambda x: 0 < x <= LARGEST, f"a positive number, up to {LARGEST:g}")


def check_whole(given: Mapping[str, object], least: int = 0, most: float = math.inf) -> None:
    """Refuse by option what is no whole number from `least` to `most`."""
    ends = f"of at least {least}" if most == math.inf else f"from {least} to {most:g}"
    _check(given, Integral, lambda x: least <= x <= most, f"a whole number {ends}", required=True)


def check_number(given: Mapping[str, object]) -> None:
    """Refuse by option what is no finite number; None was not given."""
    _check(given, Real, math.isfinite, "a number")


def check_share(given: Mapping[str, object]) -> None:
    """Refuse by option what is not a number from 0 to below 1."""
    _check(given, Real, lambda x: 0 <= x < 1, "a number, 0 to below 1", required=True)


def check_band(given: object, said: object = None) -> None:
    """Refuse what is no band: two frequencies, the lower first; None was not given. `said`: how it was written."""
    ends = tuple(given) if isinstance(given, Iterable) else ()
    if given is not None and not (
        len(ends) == 2 and all(isinstance(x, Real) for x in ends) and 0.0 <= ends[0] < ends[1] < math.inf
    ):
        shown = f"{given if said is None else said!r:.40}"
        raise AmbidError(
            f"--band is {shown}; it must be two frequencies in Hz with a colon between. Give --band 1:2000, for example"
        )


def check_switch(given: Mapping[str, object]) -> None:
    """Refuse by option what is neither True nor False; None was not given."""
    _check(given, object, lambda x: x in (True, False), "True or False")


def by_name(given: Any, what: str) -> Mapping[str, Any]:
    """Return what is given by name, and nothing where None is."""
    if given is not None and not isinstance(given, Mapping):
        raise AmbidError(f"{what} is {given!r:.40}; it must be values by name, such as a dict. Correct it")
    return given or {}


def path_of(given: object, what: str) -> Path:
    """Return the path that a word stands for; `what`: what the file is, for messages."""
    if not isinstance(given, (str, Path)):
        raise AmbidError(f"{what} is {given!r:.40}; it must be a file's path. Correct it")
    return Path(given)


def _check(
    given: Mapping[str, object], kind: type, fits: Callable[[Any], bool], rule: str, *, required: bool = False
) -> None:
    for name, x in given.items():
        if x is None and not required:
            continue
        if not isinstance(x, kind) or (isinstance(x, bool) and kind is not object) or not fits(x):
            shown = f"{float(x):g}" if isinstance(x, Real) and not isinstance(x, bool) else f"{x!r:.40}"
            raise AmbidError(f"{name} is {shown}; it must be {rule}. Correct it")
