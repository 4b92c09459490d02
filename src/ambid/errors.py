"""The exceptions of `ambid`.

Every error that input can cause is an :class:`AmbidError`; the command line prints it on one line and exits with 2.
Anything else that escapes is a defect of the program.
"""

import difflib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager


class AmbidError(Exception):
    """Input refused.

    The message names what, where, the rule and the remedy, on one line:
    ``column 'current' is in [V]; the rig needs a current unit. Fix the header, or give channels.current.gain``.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


class CircumstanceError(AmbidError):
    """What was asked for, or what is installed, does not go: that says nothing of a record, and is not remembered."""


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


_ALIKE = 0.4  # ratio of letters in common from which a word may be meant


def nearest(word: object, known: Sequence[str]) -> str:
    """Return `` Did you mean 'x'?`` for the known word closest to `word`, or an empty string.

    `word`: what was written; `known`: what may be written. Returns a sentence that begins with a space, or ``""``.
    """
    written = str(word)
    turned = [k for k in known if sorted(k) == sorted(written)]  # two letters exchanged come before another word
    begun = [k for k in known if written and k.startswith(f"{written}_")]  # then a unit left out, as of rate_hz
    alike = {k: difflib.SequenceMatcher(None, k, written).ratio() for k in known}
    close = [k for k in known if alike[k] == max(alike.values()) >= _ALIKE]
    held = [k for k in close if written in k or k in written]  # of equally close words one that holds the other
    best = (*turned, *begun, *held, *close)
    return f" Did you mean {best[0]!r}?" if best else ""


def choices(word: object, known: Iterable[str]) -> str:
    """Return what may be written and which of it was meant: ``a, b. Did you mean 'a'?``, for the end of a message."""
    words = list(known)
    return f"{', '.join(words)}.{nearest(word, words)}"


@contextmanager
def needs(package: str, what: str, extra: str) -> Iterator[None]:
    """Refuse an import inside whose package is not installed: `what` needs it, and ``ambid[extra]`` brings it."""
    try:
        yield
    except ImportError:
        raise CircumstanceError(f"{package} is not installed, and {what} needs it. Install ambid[{extra}]") from None


def listed(names: Sequence[str], most: int) -> str:
    """Return names with commas, and how many more there are than `most`: ``a, b and 3 more``."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def counted(n: float | str, noun: str) -> str:
    """Return a number of things, as in ``1 sample``, ``2 samples``, ``3.25 samples``; a number may be text already."""
    text = f"{n:.3g}" if isinstance(n, float) else str(n)
    return f"{text} {noun}{'' if text == '1' else 's'}"
