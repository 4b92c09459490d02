"""Words that people bring along from MATLAB, python-control, SIPPY and pandas, and what each is here.

A word that is nothing here is refused by `missing` with the one that may be meant.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ambid.errors import nearest

PACKAGE: Mapping[str, str] = {
    **dict.fromkeys(("iddata", "idfrd"), "ambid.Record.from_dataframe(table), or ambid.load(file)"),
    **dict.fromkeys(("read", "read_csv", "read_excel", "open", "loadmat"), "ambid.load(file)"),
    **dict.fromkeys(("greyest", "idgrey", "idnlgrey", "nlgreyest", "pem"), "ambid.identify(record, rig)"),
    **dict.fromkeys(("tfest", "spa", "etfe", "spafdr"), "ambid.frf(record, input, output, orders='nf=3,nb=2')"),
    **dict.fromkeys(("arx", "armax", "bj", "oe", "iv4", "n4sid", "moesp", "cva"), "ambid.fit(record, {0!r})"),
    **dict.fromkeys(("ssest", "ssregest"), "ambid.fit(record, 'pbsid')"),
    **dict.fromkeys(("nlarx", "idnlarx"), "ambid.fit(record, 'narx')"),
    **dict.fromkeys(("recursiveARX", "recursiveLS", "rarx"), "ambid.track(record, method='rls')"),
    **dict.fromkeys(("system_identification", "ident"), "ambid.fit(record, structure)"),
    **dict.fromkeys(("idss", "idpoly", "idtf", "ss", "tf"), "result.to_control()"),
    **dict.fromkeys(("bode", "step", "impulse", "nyquist", "pzmap", "resid", "plot"), "result.plot()"),
    "lsim": "result.simulate(record)", "sim": "result.simulate(record)", "predict": "result.predict(record, ahead)",
    "goodnessOfFit": "result.fit", "fitperf": "result.fit", "save": "result.save(file)", "idinput": "ambid.excitation",
    "models": "ambid.model_names(), ambid.preset_names()", "export": "result.export(file)",
    **dict.fromkeys(("draft", "guess", "make_rig"), "ambid.init(record)"), "version": "__version__",
    **dict.fromkeys(("presets", "list_presets"), "ambid.preset_names()"), "help": "help(ambid.identify)",
}  # fmt: skip
"""Of the package."""

RECORD: Mapping[str, str] = {
    **dict.fromkeys(("fs", "rate", "SamplingRate"), "rate_hz"), **dict.fromkeys(("dt", "Ts"), "1 / rate_hz"),
    **dict.fromkeys(("time", "t", "SamplingInstants", "index"), "time_s"), "columns": "names",
    **dict.fromkeys(("iloc", "loc", "head", "tail", "values", "corr"), "to_dataframe().{0}"),
    **dict.fromkeys(("to_csv", "to_hdf", "write"), "save(file)"), "fft": "plot()", "detrend": "ambid.signals",
    **dict.fromkeys(("to_pandas", "copy", "rename", "drop", "describe", "info"), "to_dataframe()"),
    "psd": "ambid.signals", "filter": "scipy.signal.sosfiltfilt(sos, record['name'])", "cut": "record[from_s:to_s]",
    **dict.fromkeys(("u", "InputData", "y", "OutputData"), "record['name']"),
    "resample": "ambid.signals.resample(record, rate_hz)",
}  # fmt: skip
"""Of a record; a part of one is ``record[0.5:2.0]``, in seconds."""

RESULT: Mapping[str, str] = {
    **dict.fromkeys(("bode", "step", "impulse", "nyquist", "feedback", "damp", "tf", "ss", "zpk"), "to_control()"),
    **dict.fromkeys(("A", "B", "C"), "continuous.{0}, or to_control().{0}"), "D": "to_control().D",
    **dict.fromkeys(("state_space", "transfer_function", "to_ss", "to_tf"), "to_control()"),
    **dict.fromkeys(("G", "frequency_hz", "coherence"), "response.{0}"), "magnitude": "abs(response.G)",
    **dict.fromkeys(("params", "getpvec", "Report", "x"), "parameters"), "resid": "residuals",
    **dict.fromkeys(("getcov", "cov", "covariance_matrix"), "covariance"), "corr": "correlation",
    **dict.fromkeys(("ok", "passed", "success"), "verdict.word"), "compare": "ambid.compare(one, other)",
    **dict.fromkeys(("aic", "bic", "fpe"), "criteria[{0!r}]"), "ci95": "to_dataframe()",
    **dict.fromkeys(("sd", "std", "stderr", "bse"), "to_dataframe()['sd']"), "polynomials": "to_dict()[{0!r}]",
    **dict.fromkeys(("json", "to_json", "to_csv", "write"), "save(file)"), "show": "plot()", "print": "summary()",
    "r2": "fit", "score": "validate(record)", "FitPercent": "fit", "rate_hz": "record['rate_hz']",
}  # fmt: skip
"""Of a result."""


def missing(owner: str, name: str, known: Iterable[str], elsewhere: Mapping[str, str]) -> AttributeError:
    """Return the refusal of a name that `owner` does not have: what it is here, or the nearest of those known."""
    here = elsewhere.get(name, "").format(name)
    advice = f" Write {here}" if here else nearest(name, [x for x in known if not x.startswith("_")])
    return AttributeError(f"{owner} has no {name!r}.{advice}")
