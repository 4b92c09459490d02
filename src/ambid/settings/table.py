"""Every setting that a job may have, once; what a job has is in `ambid.settings.jobs`."""

from __future__ import annotations

from ambid.settings.schema import Setting

# fmt: off
SETTINGS = (
    Setting("acknowledge", "text", "RULE", "Acknowledge an alarm of the bearing that stands, by its rule or "
        "parameter: it is shown with @who and @why, and returns when it grows, or is raised anew; with @until "
        "whatever the rule raises is silenced until then."),
    Setting("again", "text", "failed", "Do records again that failed before."),
    Setting("alarms", "text", "RULES.toml|usual", "Watch the bearing, or all of them, for drifts, steps and what is "
        "missing: by rules of a file, or by the usual ones."),
    Setting("amplitude", "positive", "V", "Peak of the excitation in V.", shown="found by trials, smallest first"),
    Setting("anyway", "switch", "", "Export an unusable estimate too, or one whose record does not show all; it says "
        "so."),
    Setting("arm", "path", "RIG", "Rig file whose [loop] the controller tries once it levitates, and keeps: the "
        "record is made with it. It returns to the loop before where the rotor moves more than half way to a trip."),
    Setting("at_rest", "switch", "", "All signals are zero before the first sample: estimate no offsets and initial "
        "states (polynomial structures)."),
    Setting("axes", "text", "AX,...", "Axes of a rotor that are excited, with commas between.", shown="all"),
    Setting("band", "band", "LO:HI", "Band of the excitation in Hz.", shown="that of a multisine for levitation, "
        "where the rotor moves; else what the controller can play"),
    Setting("bearing", "text", "NAME", "With @ledger: which bearing this is.", shown="name of the rig"),
    Setting("bench", "text", "PRESET|RIG", "Plant behind an emulated or simulated controller.",
        shown="daq.bench of the rig, or its own values"),
    Setting("candidates", "text", "STRUCTURE:ORDERS...", "Structure and orders to compare: arx:na=2,nb=2,nk=1 or "
        "bj:auto; 'ambid models' lists the structures.", argument=True, many=True, required=True),
    Setting("closed", "loop", "", "With or without the controller.", choices=("open", "closed"),
        shown="as the bench usually works"),
    Setting("coil", "switch", "", "Draft the coil alone, without a position."),
    Setting("column", "words", "ROLE=COLUMN", "Which column, or path such as 'rec.Y(2).Data', is voltage, current, "
        "position or time, its unit behind it in brackets; repeatable.", many=True),
    Setting("criterion", "text", "", "Criterion for orders: bic, aic, aicc, mdl, fpe, holdout or kfold.",
        default="bic"),
    Setting("delay", "text", "S|auto", "Delay of the inputs in s, for the models.",
        shown="0; with @rig as the rig says"),
    Setting("delete", "switch", "", "Remove the journal once its record is written and nothing was damaged."),
    Setting("domain", "text", "", "Domain of the model: continuous or discrete time.", choices=("s", "z"),
        shown="z for @orders with a held input, else s"),
    Setting("drift", "switch", "", "With @identify_nonlinear: let a force and a voltage drift beside the law, though "
        "it may not pay."),
    Setting("duration", "positive", "S", "Length of each record, in s.", shown="as ambid simulate"),
    Setting("eddy", "switch", "", "With @identify_nonlinear: the force follows the current with a pole a/(s + a)."),
    Setting("estimate", "path", "E.json", "With @modes: compare them with the modes of a physical estimate (MAC)."),
    Setting("every", "switch", "", "Also estimates that others of their record and job supersede.", long="all"),
    Setting("every_s", "positive", "S", "Reporting interval, in s of record.", default=0.01),
    Setting("excitation", "text", "NAME", "Excitation that the controller adds to its output: multisine, schroeder, "
        "prbs or steps, or a file that 'ambid design experiment @json' wrote.", shown="none"),
    Setting("excitation_only", "switch", "", "Write only what is to be added to the controllers' outputs of a rotor."),
    Setting("experiment", "path", "E.json", "What 'ambid design experiment' promised: compare with the standard "
        "deviations."),
    Setting("feedthrough", "switch", "", "With @state_space: include a direct path from input to output (D)."),
    Setting("filters", "whole", "N", "Filters around a rotor's lowest bending modes.", least=0, default=0),
    Setting("fix", "text", "NAME=NUMBER", "Fix a coefficient; repeatable.", many=True),
    Setting("folder", "path", "[FOLDER]", "Folder whose files are shown.", argument=True, default="."),
    Setting("force", "switch", "", "Overwrite an existing record; go on with a loop that is predicted unstable."),
    Setting("form", "text", "NAME", "Gains of a rotor's PID: axes (one set) or bearings.",
        default="axes"),
    Setting("from_s", "number", "S", "Start time in the record, in s."),
    Setting("gaps", "text", "", "Missing values: refuse them, interpolate, or use the longest part without any.",
        choices=("error", "interpolate", "cut"), shown="error, or as the rig says"),
    Setting("goals", "text", "FIGURE", "To be small: peak, compliance, noise or settling; repeatable.", many=True,
        shown="peak and compliance"),
    Setting("held", "path", "RECORD", "With @identify_nonlinear: a record with the rotor held at rest, which "
        "identifies the coil; repeatable.", many=True),
    Setting("hold", "text", "", "Input between samples: held constant, or band-limited to half the rate.",
        choices=("zoh", "band-limited"), shown="zoh; band-limited for a file of responses"),
    Setting("holdout", "number", "", "Fraction of the record held out for validation, without a second record.",
        default=0.3),
    Setting("input", "text", "COL", "Input column; repeatable.", many=True),
    Setting("job", "text", "JOB", "What is done: identify, identify_nonlinear, fit, frf, info, margins, validate.",
        default="identify"),
    Setting("journals", "path", "JOURNAL", "Journal of a recording that was cut off: NAME.journal.", argument=True,
        many=True, required=True),
    Setting("json", "text", "FILE", "Write the result as JSON; - for standard output."),
    Setting("layout", "words", "WORD=VALUE", "What the file leaves open, such as group=NAME or decimal=comma; "
        "repeatable.", many=True),
    Setting("keep", "text", "", "Keep one usable estimate of each bearing and job for each of these; none: keep "
        "none.", choices=("none", "day", "week", "month", "year"), default="month"),
    Setting("ledger", "text", "FILE.db|URL", "Keep the result in this ledger: file of SQLite, or URL of PostgreSQL."),
    Setting("limit", "positive", "X", "Acceptable model error, relative to that at identification.", default=1.5),
    Setting("limit_s", "positive", "S", "Longest time for one record, in s.", default=600.0, long="time-limit"),
    Setting("limits", "text", "FIGURE=X", "Largest value, such as peak=9.5dB; repeatable.", many=True,
        shown="what the present loop has"),
    Setting("log_excitation", "switch", "", "Add a column 'excitation': the reference for 'ambid frf'."),
    Setting("memory", "text", "auto|all|S", "Memory of the estimator: found from the data, infinite, or a time "
        "constant in s.", default="auto"),
    Setting("method", "text", "", "Method: averages over periods, averaged spectra, local polynomials, or what suits "
        "the record.", choices=("auto", "periodic", "random", "local"), default="auto"),
    Setting("mode", "text", "", "sample: output off; drive: excitation without feedback; levitate: position loop on "
        "the controller.", choices=("sample", "drive", "levitate"), shown="levitate if the rig has a loop; sample "
        "for a replay"),
    Setting("modes", "text", "auto|N", "Find modes of vibration by maximum likelihood: frequency, damping, shape "
        "over the outputs; N: so many."),
    Setting("no_browser", "switch", "", "Print the link only."),
    Setting("nonlinear", "switch", "", "Identify the nonlinear magnet: k_i, k_x and L as curves over position and "
        "current."),
    Setting("open_loop", "switch", "", "The record was taken without feedback."),
    Setting("orders", "text", "na=2,nb=2,nk=1", "Orders; nb=2/3 for two inputs with different orders, nk=auto to "
        "find the delay, auto to choose all. Of a nonlinear structure its settings, such as ny=2,degree=3; 'ambid "
        "models' lists them.", default="auto"),
    Setting("older_than", "positive", "DAYS", "Move estimates of records taken longer ago, in days.", required=True),
    Setting("other", "text", "OTHER", "The other ledger: file or URL.", argument=True, required=True),
    Setting("out", "path", "FILE", "Record to write: .h5, .csv or .csv.gz.", required=True, short="o"),
    Setting("output", "text", "COL", "Output column; repeatable.", many=True),
    Setting("pace", "text", "", "Speed of an emulated, simulated or replayed device.",
        choices=("fastest", "real-time"), default="fastest"),
    Setting("period", "positive", "S", "Period of the excitation in s.",
        shown="a quarter of the record, or the controller's table"),
    Setting("periods", "whole", "N", "Number of repetitions of the excitation, for 'ambid frf'.", least=1,
        shown="1; of a rotor about one a second, at least 4"),
    Setting("plants", "whole", "N", "Plants that the design is tuned over.", least=1, default=60),
    Setting("plot", "path", "FILE.png", "Draw the result."),
    Setting("port", "text", "PORT", "Serial port, or: emulated, simulated, replay:FILE.", required=True),
    Setting("position", "number", "M", "With @identify_nonlinear: position at which the loop holds the rotor, in m.",
        shown="the operating point's"),
    Setting("preset", "text", "NAME", "Instead of a record: the rig of a bench that 'ambid models' lists; prototype "
        "has a controller."),
    Setting("publish", "path", "FILE.prom", "Write latest values and alarms as gauges for Prometheus; needs @alarms."),
    Setting("rate_hz", "positive", "HZ", "Sampling rate in Hz, for a record without time."),
    Setting("read_only", "switch", "", "Refuse what changes something."),
    Setting("record", "path", "RECORD", "Record: .csv, .csv.gz, .h5, .mat, .tdms, .mf4, .mdf, .parquet, .feather or "
        ".arrow.", argument=True, required=True),
    Setting("records", "path", "RECORD...", "Record: .csv, .csv.gz, .h5, .mat, .tdms, .mf4, .mdf, .parquet, .feather "
        "or .arrow; with @identify_nonlinear several, best at several positions; of a rotor several, best at rest "
        "and at speed.", argument=True, many=True, required=True),
    Setting("redesign", "switch", "", "Design a better loop, load it on trial, and measure again."),
    Setting("redate", "text", "TIME", "Correct when @record was taken, such as 2026-03-01T14:30 (UTC)."),
    Setting("reference", "text", "COL", "Column of the loop's external excitation, for methods that use it; "
        "repeatable.", many=True),
    Setting("remove", "switch", "", "Take the bearing, or one @record, out of all that is shown and judged."),
    Setting("rename", "text", "NAME", "Rename the bearing, or one @record; a bearing of that name gets the estimates."),
    Setting("report", "path", "FILE.html", "Write a report in one self-contained file, .html or .pdf."),
    Setting("result", "path", "ESTIMATE", "What 'ambid identify @json' or 'ambid fit @json' wrote.", argument=True,
        required=True),
    Setting("rig", "path", "RIG", "Rig file (TOML): what is known about the bench."),
    Setting("run_up", "text", "RPM:RPM...", "Speeds in rpm that a rotor runs through evenly, without excitation: "
        "0:20000 is a run-up, 20000:0 a coast-down, 0:20000:0 both; the record has its angle and speed."),
    Setting("scenario", "text", "NAME[:SIZE][@S]", "A change with known truth, as 'ambid models' lists them, its "
        "size and its start in s; the truth goes into columns true_....", shown="nothing changes"),
    Setting("scheduler", "text", "local:N|tcp://HOST:PORT", "Cluster of Dask: N workers on this machine, or a "
        "scheduler that somebody has started, with its workers."),
    Setting("seconds", "positive", "S", "Length of the record in s.", default=10.0),
    Setting("seed", "whole", "N", "Seed of excitation and simulated noise.", least=0, default=0),
    Setting("set", "text", "NAME=VALUE", "Setting of the job, under its name in Python, such as from_s=0.5; "
        "repeatable.", many=True),
    Setting("settle", "from_zero", "S", "Time after the start that is not recorded, in s.", shown="1 when levitating"),
    Setting("source", "text", "RIG|PRESET|ESTIMATE", "Rig file, a bench that 'ambid models' lists, or what identify "
        "@json wrote.", argument=True, required=True),
    Setting("speed_rpm", "number", "RPM", "Speed of a rotor in rpm; once for each record, in their order.", many=True,
        shown="as the record's angle or speed, or the rig, says"),
    Setting("speeds_rpm", "band", "LO:HI", "Of a rotor in rpm.", shown="from rest to the speed of rig or estimate"),
    Setting("spread", "share", "SHARE", "Two relative standard deviations of a rig's free parameters, for the drawn "
        "plants.", default=0.1),
    Setting("start", "text", "ESTIMATE.json|S", "Start from this estimate, or from one of so many seconds of the "
        "record's beginning."),
    Setting("state_space", "text", "n=3|auto", "Fit a state space by subspace identification with the Laguerre "
        "operator."),
    Setting("step", "positive", "X", "Step size of lms and nlms, for signals of size one."),
    Setting("strict", "switch", "", "End with exit code 3 unless the verdict is usable."),
    Setting("structure", "text", "NAME", "Structure; 'ambid models' lists them.", required=True),
    Setting("taken_at", "text", "TIME|file", "With @ledger: when the record was taken, such as 2026-03-01T14:30, of "
        "UTC; file: as its file says.", shown="as the record says"),
    Setting("target", "percent", "SD", "Relative standard deviation whose length of record is told.", default="1%"),
    Setting("to", "text", "", "Library that a script (.py) is for.", long="library", choices=("control", "ross"),
        shown="ross for a rotor, else control"),
    Setting("to_s", "number", "S", "End time in the record, in s."),
    Setting("track", "text", "ESTIMATE.json|auto", "Track the parameters during the run, starting from this "
        "estimate, or from one of the first seconds."),
    Setting("track_seconds", "positive", "S", "Length of live tracking at the end, in s.", default=5.0),
    Setting("use", "positive", "SHARE", "Part of the way to the limits of position and current that may be used.",
        default=0.3),
    Setting("undo", "whole", "N", "Put back what correction N changed; a history numbers them.", least=1),
    Setting("until", "text", "TIME", "With @acknowledge: until when, such as 2026-03-01T14:30 (UTC)."),
    Setting("validate", "path", "RECORD2", "Validate on this record too, on all of it."),
    Setting("who", "text", "NAME", "Who does this.", shown="account and host"),
    Setting("why", "text", "TEXT", "For what reason."),
    Setting("widest", "positive", "X", "Largest acceptable half width of a 95 % interval, relative to the value.",
        default=0.1),
    Setting("workers", "whole", "N", "Processes at work.", least=1, shown="one for each processor"),
    Setting("yes", "switch", "", "Do not ask before the controller switches its output on.", short="y"),
)
# fmt: on
