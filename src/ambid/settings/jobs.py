"""The jobs, each with its settings in the order in which the help of its verb shows them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from ambid.settings.schema import Job
from ambid.settings.table import SETTINGS

_TABLE = {s.name: s for s in SETTINGS}


def declare(name: str, settings: str, **differences: Mapping[str, Any]) -> Job:
    """Return a job with settings of the table, and what some of them have otherwise here."""
    return Job(name, tuple(replace(_TABLE[key], **differences.get(key, {})) for key in settings.split()))


_LEDGER: Mapping[str, Any] = {
    "help": "The ledger: file of SQLite, or URL of PostgreSQL.",
    "metavar": "LEDGER",
    "argument": True,
    "required": True,
}

# fmt: off
_JOBS = (
    declare("identify", "records rig nonlinear held eddy drift speed_rpm experiment validate from_s to_s rate_hz "
        "gaps layout json plot report ledger bearing taken_at strict",
        validate={"help": "Validate the estimate on this second record."},
        plot={"help": "Draw signals, residuals, Bode and poles; with @identify_nonlinear curves with bands, and "
        "every record."}),
    declare("fit", "records structure input output orders seed criterion fix rig reference open_loop at_rest from_s "
        "to_s rate_hz gaps layout validate json plot report strict",
        records={"help": "Record: .csv, .csv.gz, .h5, .mat, .tdms, .mf4, .mdf, .parquet, .feather or .arrow; "
        "nonlinear structures take several of one bench."},
        seed={"help": "Seed of all randomness in a nonlinear structure.", "default": None, "shown": "0"},
        plot={"help": "Draw signals, residuals, Bode and poles; for a nonlinear structure signals, errors and bands."}),
    declare("frf", "record input output reference open_loop method band hold orders state_space feedthrough modes "
        "estimate domain delay rig from_s to_s rate_hz gaps layout json plot report strict",
        band={"help": "Frequency band to use, in Hz.", "shown": "all"},
        orders={"help": "Fit transfer functions by maximum likelihood: degree of the denominator, number of "
        "numerator coefficients.", "default": None, "metavar": "nf=2,nb=1"},
        plot={"help": "Draw response, levels and models."}),
    declare("compare", "record candidates output input reference rig open_loop from_s to_s rate_hz gaps layout "
        "validate holdout json plot report strict"),
    declare("acquire", "port rig out seconds excitation amplitude band mode settle arm bench pace seed track json "
        "plot report force strict",
        rig={"help": "Rig file (TOML): calibrations, [loop], [daq].", "required": True},
        json={"help": "Write the result, with @track the track as lines of JSON; - for standard output."}),
    declare("commission", "port rig out seconds track_seconds amplitude band widest bench pace seed json plot report "
        "ledger bearing redesign force yes",
        rig={"help": "Rig file (TOML): calibrations, [loop], [daq].", "required": True},
        out={"help": "Folder for records, estimate and report.", "metavar": "FOLDER"},
        seconds={"default": 20.0},
        force={"help": "Go on with a loop that is predicted unstable."}),
    declare("console", "folder port no_browser read_only",
        port={"help": "Port of the page; 0: any that is free.", "default": 0, "most": 65535, "kind": "whole",
        "metavar": "N", "required": False}),
    declare("track", "record rig method input output orders open_loop step start every_s limit memory pace "
        "from_s to_s rate_hz layout json plot report ledger bearing taken_at strict",
        method={"help": "rpem, the supervised tracker; ekf or ukf without supervisor; or coefficients from @input to "
        "@output by rls, lms, nlms, or a recursive arx, armax, oe, bj, ...", "choices": (), "default": "rpem",
        "metavar": "NAME"},
        orders={"help": "Orders of the tracked coefficients.", "default": None},
        pace={"help": "Replay as fast as possible, or in real time."},
        json={"help": "Write the track as lines of JSON as it is computed; - for standard output."},
        plot={"help": "Draw the tracks, with the truth if the record has columns true_NAME."}),
    declare("margins", "record rig estimate reference from_s to_s rate_hz gaps layout json plot report strict",
        record={"help": "Record of the levitated rotor, or what 'ambid identify @json' wrote.",
        "metavar": "RECORD|ESTIMATE"},
        estimate={"help": "Plant, as 'ambid identify @json' wrote it.", "shown": "identified from the record"},
        reference={"help": "Column of the excitation, of one axis.", "shown": "as the rig says", "many": False}),
    declare("accept", "records rig estimate speed_rpm from_s to_s rate_hz gaps layout json plot report strict",
        records={"help": "Records of one rotor: at rest and at speed with excitation, run-ups, coast-downs."},
        estimate={"help": "Machine, as 'ambid identify @json' wrote it.", "shown": "identified from the records"}),
    declare("history", "ledger bearing every rename redate remove record undo alarms acknowledge until who why "
        "publish json plot report strict",
        record={"kind": "text", "help": "Only this record of the bearing: name of its file, or digits of its "
        "SHA-256.", "metavar": "NAME|SHA", "argument": False, "required": False},
        ledger={"help": "The ledger: file of SQLite, or URL of PostgreSQL.", "required": True},
        bearing={"help": "Name of the bearing; without it all are listed.", "shown": "", "metavar": "BEARING",
        "argument": True}),
    declare("ledger check", "ledger", ledger=_LEDGER),
    declare("ledger backup", "ledger out", ledger=_LEDGER,
        out={"help": "Backup to write, a file of SQLite."}),
    declare("ledger restore", "ledger other out who why", ledger=_LEDGER,
        other={"help": "Backup, or another ledger.", "metavar": "BACKUP"},
        out={"help": "Backup of what the ledger holds now.", "required": False}),
    declare("ledger merge", "ledger other who why", ledger=_LEDGER),
    declare("ledger retain", "ledger older_than keep out who why", ledger=_LEDGER,
        out={"help": "Archive, a ledger that is made where there is none.", "kind": "text", "metavar": "FILE.db|URL"}),
    declare("design experiment", "source out rig seconds period band criterion target use spread rate_hz closed "
        "seed json plot report strict force",
        out={"help": "Write one period of the excitation: .csv, .csv.gz or .h5.", "required": False},
        seconds={"shown": "10", "default": None},
        band={"shown": "one period to a fifth of the rate"},
        criterion={"help": "all, or the parameter that matters.", "default": "all", "metavar": "NAME"},
        rate_hz={"help": "Sampling rate in Hz.", "shown": "the bench's"},
        force={"help": "Overwrite an existing record."}),
    declare("design controller", "estimate rig out goals limits spread form filters speeds_rpm "
        "plants seed json plot report strict force",
        estimate={"help": "What 'ambid identify @json' wrote.", "metavar": "ESTIMATE", "argument": True,
        "required": True},
        out={"help": "Write the rig with the new [loop].", "required": False, "metavar": "RIG"},
        spread={"help": "How far plants are drawn, such as delay=0.3; repeatable.", "shown": "see the documentation",
        "many": True, "kind": "text", "default": None, "metavar": "SOURCE=X"},
        seed={"help": "Seed of the plants."},
        force={"help": "Overwrite an existing rig file."}),
    declare("export", "result out to anyway force",
        out={"help": "File to write: .mat, .py, .c, .h or .fmu."},
        force={"help": "Overwrite a file that is no export."}),
    declare("fleet run", "records ledger rig taken_at job set again workers limit_s scheduler json plot report "
        "strict",
        records={"help": "Files, URLs, or patterns in quotes such as 'records/{bearing}/*.h5', where a word in "
        "braces stands for a part of one name.", "kind": "text"},
        ledger={"help": "Ledger that keeps the estimates: what stands there is not done again.", "required": True},
        rig={"help": "Rig file of all records; or with words of the pattern, 'rigs/{bearing}.toml'; or a table with "
        "columns pattern, rig and perhaps bearing, taken_at.", "kind": "text", "metavar": "RIG|MAP.csv"},
        taken_at={"help": "When those were taken that say it neither themselves nor by {taken_at} or table; file: "
        "time of the file.", "shown": ""}),
    declare("recover", "journals out delete json plot report force strict",
        out={"help": "Record to write: .h5, .hdf5, .csv or .csv.gz.", "shown": "NAME", "required": False},
        force={"help": "Overwrite an existing record."},
        strict={"help": "End with exit code 3 if something was damaged or is missing."}),
    declare("init", "record out column coil preset yes rate_hz gaps layout force",
        record={"required": False},
        out={"help": "Rig file to write.", "shown": "standard output", "required": False, "metavar": "RIG"},
        yes={"help": "Choose the most likely columns without asking.", "short": ""},
        force={"help": "Overwrite an existing rig file."}),
    declare("simulate", "rig out duration rate_hz scenario run_up excitation amplitude band periods axes settle "
        "excitation_only log_excitation seed closed nonlinear position force",
        rig={"help": "Rig file, or a bench that 'ambid models' lists.", "kind": "text", "metavar": "RIG|PRESET",
        "argument": True, "required": True},
        out={"help": "Record to write: .csv, .csv.gz or .h5."},
        duration={"help": "Length in s.", "shown": "1, or the scenario's or experiment's"},
        rate_hz={"help": "Sampling rate in Hz.", "shown": "the preset's, or the rig's"},
        excitation={"help": "Excitation, as 'ambid models' lists them, or a file that 'ambid design experiment "
        "@json' wrote.", "shown": "multisine"},

        amplitude={"help": "Peak in V (rms for gaussian).", "shown": "what half of the limits allows", "metavar": "A"},
        band={"shown": "one period to a fifth of the rate"},
        settle={"help": "Periods that a rotor runs before the record begins, in steady state.", "shown": "1",
        "kind": "whole", "metavar": "N"},
        seed={"help": "Seed of excitation and noise."},
        nonlinear={"help": "Simulate the nonlinear magnet ([magnet] of a rig) instead of its linearisation."}),
    declare("validate", "estimate record rig from_s to_s rate_hz gaps layout json plot report strict",
        estimate={"help": "JSON file written by 'ambid identify' or 'ambid fit'.", "metavar": "ESTIMATE.json",
        "argument": True, "required": True}),
    declare("info", "record rig rate_hz gaps layout json plot report strict"),
)
# fmt: on
JOBS = {job.name: job for job in _JOBS}


def check(job: str, **values: Any) -> None:
    """Refuse what is out of the range of a job's setting; each by its name in Python, None where it was not given."""
    JOBS[job].check(values.items())
