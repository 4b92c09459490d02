"""Functions of jobs as Python calls them: what their arguments are called, and the range of each."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from ambid.errors import nearest
from ambid.settings.caller import language
from ambid.settings.elsewhere import RECORD
from ambid.settings.jobs import JOBS

P = ParamSpec("P")
R = TypeVar("R")
# What a setting of a command is in Python, where the function of its job does not take it.
_AFTER = {
    "json": "result.save(file)", "plot": "result.plot()", "report": "result.report(file)", "out": "result.save(file)",
    "export": "result.export(file)", "strict": "result.passed", "nonlinear": "ambid.identify_nonlinear",
    "model": "rig={'model': NAME}", "T": "duration=",
    **dict.fromkeys(("voltage", "current", "position", "u", "i", "x"), "a dict as record: {'voltage [V]': u, ...}"),
    **dict.fromkeys(("na", "nb", "nc", "nd", "nf", "nk", "order"), "orders='na=2,nb=2,nk=1'"),
    **dict.fromkeys(("fix", "fixed", "known", "initial", "start"),
                    "rig={'parameters': {'R': {'value': 4.2, 'unit': 'ohm', 'role': 'fixed'}}}"),
}  # fmt: skip
_NUMBERS = ("number", "positive", "from_zero", "share", "whole")


def of_job(job: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Make the function of a job name what an argument is called here that it does not have, and refuse numbers out of
    range by the declaration of the job's settings.
    """

    def make(function: Callable[P, R]) -> Callable[P, R]:
        code = function.__code__
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            if language() == "python" and kwargs:
                for name in kwargs.keys() - {*names}:
                    words = {s.flag.lstrip("-").replace("-", "_"): s.name for s in JOBS[job].settings} | dict(RECORD)
                    here = words.get(name, name)
                    advice = f" Write {here}=" if here in names else nearest(name, names)
                    raise TypeError(f"{function.__name__}() has no argument {name!r}." + (
                        f" Use {_AFTER[name]}" if name in _AFTER else advice))  # fmt: skip
                numbers = {s.name for s in JOBS[job].settings if s.kind in _NUMBERS}
                JOBS[job].check((name, x) for name, x in kwargs.items() if name in numbers)
            return function(*args, **kwargs)

        return call

    return make
