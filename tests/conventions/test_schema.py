"""The one declaration of settings: what verbs offer and refuse comes from it, so that a new one is one edit."""

import math
from dataclasses import replace
from inspect import signature

import pytest

from ambid.cli.app import parser
from ambid.cli.options import Values, verb
from ambid.errors import AmbidError
from ambid.settings import jobs
from ambid.settings.caller import setting, speaking
from ambid.settings.jobs import JOBS, check
from ambid.settings.schema import Job, Setting

WRONG = {
    "number": (math.nan, "x"), "positive": (0.0, -1.0, math.inf, math.nan), "percent": (0.0, -1.0),
    "share": (1.0, -0.1),
    "from_zero": (-1.0, math.nan), "whole": (-1, 1.5, True), "switch": ("yes", 1), "loop": ("open", 1),
    "band": ((2.0, 1.0), (1.0,), "1:2"), "words": ("a=b",),
}  # fmt: skip
LIMITS = [(job.name, s, x) for job in JOBS.values() for s in job.settings for x in WRONG.get(s.kind, ())]


@pytest.mark.parametrize(("job", "one", "value"), LIMITS)
def test_a_value_beyond_its_limits_is_refused_in_both_languages(job, one, value):
    with pytest.raises(AmbidError) as in_python:
        check(job, **{one.name: value})
    assert str(in_python.value).startswith(f"{one.name} is ")
    with speaking("shell", {one.name: one.flag}), pytest.raises(AmbidError) as in_shell:
        check(job, **{one.name: value})
    assert str(in_shell.value).startswith(f"{one.flag if one.name != 'out' else '-o'} is ")


@pytest.mark.parametrize("job", JOBS.values(), ids=lambda job: job.name)
def test_a_choice_that_is_none_is_refused(job):
    for one in (s for s in job.settings if s.choices and s.kind == "text"):
        with pytest.raises(AmbidError, match=f"{one.name} is 'none of these'; it must be one of"):
            check(job.name, **{one.name: "none of these"})


def test_the_options_of_every_verb_are_those_of_the_schema():
    commands = parser().commands
    for job in JOBS.values():
        head, _, tail = job.name.partition(" ")
        command = commands[head].commands[tail] if tail else commands[head]
        assert [p.name for p in command.params if p.name != "help"] == [s.name for s in job.settings]
        for parameter, one in zip(command.params, job.settings, strict=False):
            if not one.argument:
                assert parameter.opts[0] == ("--out" if one.name == "out" else one.flag)
                assert parameter.help == one.about


def test_a_new_setting_is_one_edit(monkeypatch):
    new = Setting("warmth_s", "positive", "S", "Time to warm up, with @rig.", default=1.0)
    monkeypatch.setitem(jobs.JOBS, "info", Job("info", (*JOBS["info"].settings, new)))
    given = []

    @verb("info")
    def command(v: Values) -> None:
        given.append(v.warmth_s)

    assert signature(command).parameters["warmth_s"].default == 1.0
    words = {s.name: None for s in JOBS["info"].settings}
    command(**words | {"warmth_s": 2.0})
    assert given == [2.0]
    with pytest.raises(AmbidError, match=r"^--warmth is -1; it must be a positive number"):
        command(**words | {"warmth_s": -1.0})
    with pytest.raises(AmbidError, match=r"^warmth_s is -1"):
        check("info", warmth_s=-1.0)


def test_a_job_may_call_a_setting_otherwise():
    assert replace(JOBS["export"]["to"]).flag == "--library"
    with speaking("shell", {"to": "--library"}):
        assert setting("to") == "--library"
