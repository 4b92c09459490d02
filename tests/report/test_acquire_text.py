"""What is said of an acquisition and of a commissioning: true in each state, and visible where something is poor."""

from dataclasses import replace
from pathlib import Path

import pytest

from ambid.acquisition.device import Counters, DeviceInfo
from ambid.acquisition.quality import ColumnQuality, QualityReport
from ambid.acquisition.recorder.convert import Recorded, Survey
from ambid.acquisition.session import Acquired, RunReport
from ambid.estimation.result import Reason
from ambid.job.commissioning_steps import STEPS
from ambid.job.presentation import text as show
from ambid.report.commission import Step, next_text, step_section
from ambid.report.device import progress_line
from ambid.report.document import sections_text

COLUMN = ColumnQuality(
    name="gap", role="position", unit="1", mean=512.0, sd=20.0, rms=512.0, least=400.0, most=600.0, saturated=0.0,
    used=0.2, signal_sd=19.0, noise_sd=4.0, snr_db=13.5, noise_by="periods", still_s=0.0,
)  # fmt: skip
DUTY = replace(COLUMN, name="duty", role="voltage", snr_db=7.0)
QUALITY = QualityReport(
    samples=1000, lost=0, gaps=0, repeated=0, damaged=0, seconds=0.5, rate_hz=2000.0, measured_hz=2000.4,
    measured_sd=0.1, excited=True, columns=(COLUMN, DUTY),
)  # fmt: skip
NOTHING = Counters()
RUN = RunReport(samples=1000, wanted=1000, lost=0, first=0, after=1000, fault=None, interrupted=False, events=())


INFO = DeviceInfo(kind="serial", port="/dev/ttyX", rate_hz=2000.0, columns=())


def said(run=RUN, quality=QUALITY, counters=NOTHING, not_stored=0):
    recorded = Recorded(path=Path("o.h5"), rate_hz=2000.0, survey=Survey())
    done = Acquired(
        info=INFO, run=run, quality=quality, counters=counters, recorded=recorded, troubles=(), not_stored=not_stored
    )
    return " ".join(show(done).split())


def test_a_whole_record_is_told_with_its_columns():
    text = said()
    assert text.startswith("verdict: usable o.h5: 1000 samples at 2000 Hz (0.5 s) from serial /dev/ttyX")
    assert "gap [1] 512 20 4 13.5 dB 20 % 0 %" in text
    assert "duty [1] 512 20 - - 20 % 0 %" in text
    assert "what does not repeat with the excitation" in text


def test_a_short_record_is_told_as_short():
    text = said(run=replace(RUN, samples=700), not_stored=100)
    assert text.startswith("verdict: use with caution")
    assert "complete: 700 of 1000 samples came" in text
    assert "stored: 100 samples are not in the record" in text
    assert "o.h5: 600 samples of 1000 wanted at 2000 Hz (0.3 s)" in text


def test_without_an_excitation_there_is_no_ratio():
    still = replace(QUALITY, excited=False, columns=(replace(COLUMN, noise_by="differences"),))
    text = said(quality=still)
    assert "dB" not in text
    assert "upper bound" in text
    assert "dB" not in progress_line(still, NOTHING)


def test_lost_samples_say_how_to_read_the_record():
    assert "3 samples lost, 0 frames damaged, 0 blocks overrun; read it with gaps" in said(run=replace(RUN, lost=3))


def test_what_is_poor_is_said_first():
    dead = Reason(check="dead", text="gap stands still. Look at it", grave=True)
    text = said(quality=replace(QUALITY, faults=(dead,)))
    assert text.startswith("verdict: do not use ✗ dead: gap stands still. Look at it")


def test_the_longest_tick_of_the_controller_is_told():
    assert "longest controller tick 231 us" in said(counters=Counters(controller={"busy_us": 231.0}))


@pytest.mark.parametrize(
    ("measured", "words"),
    [(float("nan"), "2000 Hz,"), (1990.2, "1990 Hz,"), (52_000.0, "2000 Hz at 26 times real time,")],
)
def test_the_line_of_progress_tells_the_rate_as_it_comes(measured, words):
    line = progress_line(replace(QUALITY, measured_hz=measured), NOTHING)
    assert line.startswith(f"0.5 s, {words} 0 lost, position 14 dB")


def test_a_step_shows_findings_cautions_and_reasons():
    step = Step(name="rest", findings=("found",), cautions=("beware",), reasons=("broken",))
    text = sections_text([step_section(step, "2/9")])
    assert "2/9 rest" in text
    assert [line.strip() for line in text.splitlines()[1:]] == ["found", "note: beware", "stopped: broken"]


@pytest.mark.parametrize("name", STEPS)
def test_after_each_step_it_is_said_what_to_do(name):
    text = " ".join(next_text(False, name, 4, 9, "out").split())
    assert text.startswith(f"stopped at {name}, step 4 of 9; the output is off")
    assert "Next: " in text
    assert "see the reason above" not in text
    assert "{" not in text
