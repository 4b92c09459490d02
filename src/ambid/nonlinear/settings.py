"""Settings of the networks, checked: names, ranges, choices."""

from __future__ import annotations

from collections.abc import Mapping

from ambid.errors import EstimationError, nearest


def checked(
    structure: str,
    given: Mapping[str, object],
    ranges: Mapping[str, tuple[float, float]],
    choices: Mapping[str, tuple[str, ...]],
    auto: tuple[str, ...] = (),
) -> dict[str, object]:
    """Check settings by name.

    `structure`: for messages; `ranges`: numbers; whole ones where both bounds are of type int; `auto`: numbers that may
    be ``auto``, which is as good as leaving them out. Returns what was given, less what is ``auto``.
    """
    for name, value in given.items():
        if name in auto and value == "auto":
            continue
        if name in choices:
            if value not in choices[name]:
                near = nearest(str(value), list(choices[name]))
                raise EstimationError(
                    f"{structure}: {name} is {value!r}; it must be one of {', '.join(choices[name])}.{near}"
                )
        elif name in ranges:
            low, high = ranges[name]
            whole = isinstance(low, int) and isinstance(high, int)
            number = isinstance(value, int if whole else (int, float)) and not isinstance(value, bool)
            if not number or not low <= value <= high:  # type: ignore[operator]
                kind = "whole number" if whole else "number"
                raise EstimationError(f"{structure}: {name} is {value!r}; it must be a {kind} from {low} to {high}")
        else:
            known = [*ranges, *choices]
            raise EstimationError(
                f"{structure}: setting {name!r} is not known; known: {', '.join(known)}.{nearest(name, known)}"
            )
    return {k: v for k, v in given.items() if not (k in auto and v == "auto")}
