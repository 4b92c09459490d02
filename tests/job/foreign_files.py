"""Files as other programs write them, all of one simulated record, made with none of the project's readers.

python -m tests.job.foreign_files FOLDER writes them all.
"""

import gzip
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

QUESTIONS = {
    "en_all_volts.csv", "no_position.csv", "two_positions.csv", "scope_plain_channels.csv", "no_rate.dat",
    "no_rate.npy",
}  # fmt: skip
"""What cannot be told from the file: one question is the right answer."""


@dataclass(frozen=True, kw_only=True)
class Signals:
    """A levitated rotor: time in s, voltage in V, current in A, position in m; what it was excited with."""

    t: np.ndarray
    u: np.ndarray
    i: np.ndarray
    x: np.ndarray
    r: np.ndarray

    @property
    def rate(self) -> float:
        return float(np.round((self.t.size - 1) / (self.t[-1] - self.t[0]), 3))


FILES: dict[str, Callable[[Path, Signals], None]] = {}


def file(name):
    def enter(make):
        assert name not in FILES, name
        FILES[name] = make
        return make

    return enter


def table(
    name, heads, columns, mark=",", decimal=".", encoding="utf-8", digits=10, end="\n", before="", tail="", pack=False
):
    """Enter a text: `heads` are its header rows, `columns` what stands below (a function of the signals)."""

    def make(path, s):
        rows = np.column_stack(columns(s))
        above = heads(s) if callable(heads) else heads
        body = end.join(mark.join(f"{x:.{digits}g}".replace(".", decimal) for x in row) + tail for row in rows)
        data = (before + end.join([*above, body, ""])).encode(encoding)
        path.write_bytes(gzip.compress(data) if pack else data)

    file(name)(make)


def plain(s):
    return s.t, s.u, s.i, s.x * 1e3


def si(s):
    return s.t, s.u, s.i, s.x


def extra(s):
    """A counter, a constant temperature, a set point and a noisy channel among the others."""
    n, random = s.t.size, np.random.default_rng(3)
    return s.t, np.arange(n), s.i, np.full(n, 23.5), s.u, s.r, s.x * 1e6, random.normal(size=n)


# seven languages, their usual marks and codes
table("en.csv", ["time [s],voltage [V],current [A],position [mm]"], plain)
table("de.csv", ["Zeit [s];Spannung [V];Strom [A];Weg [mm]"], plain, ";", ",")
table("de_latin.csv", ["Zeit in ms;Spannung in V;Strom in mA;Position in µm"],
      lambda s: (s.t * 1e3, s.u, s.i * 1e3, s.x * 1e6), ";", ",", "latin-1")  # fmt: skip
table("fr.csv", ["Temps (s);Tension (V);Courant (A);Déplacement (mm)"], plain, ";", ",", "latin-1")
table("es.txt", ["Tiempo\tTensión\tCorriente\tPosición", "s\tV\tA\tmm"], plain, "\t", ",")
table("it.csv", ["Tempo/s,Tensione/V,Corrente/A,Spostamento/mm"], plain)
table("ja.csv", ["時間[s],電圧[V],電流[A],変位[mm]"], plain, encoding="utf-8-sig")
table("zh.csv", ["时间(s),电压(V),电流(A),位移(μm)"], lambda s: (s.t, s.u, s.i, s.x * 1e6))
table("zh_16.txt", ["时间\t电压\t电流\t位移", "s\tV\tA\tmm"], plain, "\t", encoding="utf-16")
table("de_16le.csv", ["Zeit [s];Istspannung [V];Istweg [mm];Iststrom [A];Sollweg [mm]"],
      lambda s: (s.t, s.u, s.x * 1e3, s.i, s.r * 0.01), ";", ",", "utf-16")  # fmt: skip
# no units, and units in names
table("de_bare.csv", ["Zeit;Spannung;Strom;Weg"], si, ";", ",")
table("de_bare_mm.csv", ["Zeit;Spannung;Strom;Weg"], plain, ";", ",")
table("fr_bare.csv", ["temps,tension,courant,position"], si)
table("es_bare_um_mA.csv", ["t,tensión,corriente,desplazamiento"], lambda s: (s.t, s.u, s.i * 1e3, s.x * 1e6))
table("short.csv", ["t,u,i,x"], si)
table("short_axis.csv", ["time_ms,U_A,I_A,pos_um"], lambda s: (s.t * 1e3, s.u, s.i, s.x * 1e6))
table("short_dashed.txt", ["t_us\tUs\tIs\tpos_x"], lambda s: (s.t * 1e6, s.u, s.i, s.x), "\t")
table("suffix.csv", ["Time_s,Voltage_V,Current_mA,Position_mm"], lambda s: (s.t, s.u, s.i * 1e3, s.x * 1e3))
table(
    "time_unitless_ms.csv", ["Time,voltage [V],current [A],position [um]"], lambda s: (s.t * 1e3, s.u, s.i, s.x * 1e6)
)
# columns beside, and in another order
table("extra.csv", ["time [s],counter,coil current [A],temperature [degC],coil voltage [V],reference [V],gap [um],no"],
      extra)  # fmt: skip
table("extra_de.csv", ["Zeit [s];Nr;Strom Ist [A];Temperatur [°C];Spannung [V];Sollwert [V];Luftspalt [µm];Reserve"],
      extra, ";", ",")  # fmt: skip
table("force_speed.csv", ["time [s],force [N],speed [rpm],position [mm],current [A],voltage [V]"],
      lambda s: (s.t, 9 * s.i, np.full(s.t.size, 3000.0), s.x * 1e3, s.i, s.u))  # fmt: skip
table("index.csv", ["index,time [ms],current [mA],voltage [V],displacement [um]"],
      lambda s: (np.arange(s.t.size), s.t * 1e3, s.i * 1e3, s.u, s.x * 1e6))  # fmt: skip
table("unnamed_index.csv", [",time [s],voltage [V],current [A],position [mm]"],
      lambda s: (np.arange(s.t.size), *plain(s)))  # fmt: skip
table("late_start.csv", ["time [s],voltage [V],current [A],position [mm]"], lambda s: (s.t + 1234.5, *plain(s)[1:]))
table("packed.csv.gz", ["Zeit [s];Spannung [V];Strom [A];Weg [mm]"], plain, ";", ",", pack=True)
table("crlf.csv", ["time [s],voltage [V],current [A],position [mm]"], plain, end="\r\n")
table("closing_mark.csv", ["time [s];voltage [V];current [A];position [mm];"], plain, ";", tail=";")
# header rows
table("three_heads.csv", ["Messung 12 vom 3.4.2025", "Prüfstand 7;Lager A", "Zeit;Spannung;Strom;Weg", "s;V;A;mm"],
      plain, ";", ",")  # fmt: skip
table(
    "units_then_words.csv", ["Time,Voltage,Current,Position", "[s],[V],[A],[mm]", "clock,coil A,coil A,sensor 1"], plain
)
table("commented.txt", ["# bench 7, run 3", "# time/s  voltage/V  current/A  position/mm"], plain, "  ")
table("percent.dat", ["% rate 20 kHz", "% t u i x", "% s V A m"], si, " ")
table("quoted.csv", ['"time [s]","voltage [V]","current [A]","position [mm]"'], plain)
# text without a header, and without time
table("bare.txt", [], plain, "\t")
table("bare_blanks.dat", [], si, "   ", digits=12)
table("bare_order.txt", [], lambda s: (s.t, s.x * 1e6, s.u, s.i), " ")
table("fs_line.txt", lambda s: [f"fs = {s.rate:g} Hz", "u [V]\ti [A]\tx [mm]"], lambda s: plain(s)[1:], "\t")
table(
    "interval_line.csv", lambda s: [f"Sample interval,{1 / s.rate:g},s", "u [V],i [A],x [mm]"], lambda s: plain(s)[1:]
)
table("no_rate.dat", ["u i x"], lambda s: si(s)[1:], " ")
# oscilloscopes and loggers
table("pico.csv", ["Time,Channel A,Channel B,Channel C", "(ms),(V),(A),(mm)", ""],
      lambda s: (s.t * 1e3, s.u, s.i, s.x * 1e3))  # fmt: skip
table("pico_de.csv", ["Zeit;Kanal A;Kanal B;Kanal C", "(ms);(V);(mA);(µm)", ""],
      lambda s: (s.t * 1e3, s.u, s.i * 1e3, s.x * 1e6), ";", ",", "utf-8-sig")  # fmt: skip
table("saleae.csv", ["Time [s],Coil voltage,Coil current,Position"], si)
table("keysight.csv", ["x-axis,1,2,3", "second,Volt,Ampere,Meter"], si)
table("tektronix.csv", ["Model,MSO24", "Firmware Version,1.2", "", "Waveform Type,ANALOG", "Horizontal Units,s",
      "Record Length,6000", "", "TIME,CH1,CH2,CH3", "s,V,A,mm"], plain)  # fmt: skip
table("rigol.csv", lambda s: ["X,voltage,current,gap,Start,Increment", f"Sequence,VOLT,AMPERE,mm,0.0,{1 / s.rate:e}"],
      lambda s: (np.arange(s.t.size), *plain(s)[1:]), tail=",,")  # fmt: skip
table("scope_plain_channels.csv", ["Time,CH1,CH2,CH3", "s,V,V,V"], lambda s: (s.t, s.u, s.i, s.x * 1e4))
table("glued.txt", ["t[s] u[V] i[mA] x[um]"], lambda s: (s.t, s.u, s.i * 1e3, s.x * 1e6), " ")
table("coil_it.csv", ["Tempo;Tensione bobina;Corrente bobina;Posizione rotore"], plain, ";", ",", "latin-1")
table("coil_es.csv", ["Tiempo (s);Voltaje (V);Corriente (A);Posición (mm);Temperatura (°C)"],
      lambda s: (*plain(s), 20 + s.t), ";", ",", "latin-1")  # fmt: skip
table("coil_zh.csv", ["时间 ms,线圈电压 V,线圈电流 mA,转子位置 um"],
      lambda s: (s.t * 1e3, s.u, s.i * 1e3, s.x * 1e6), encoding="gb18030")  # fmt: skip
table("ja_jis.csv", ["時間[ms],コイル電流[A],コイル電圧[V],ギャップ[mm],目標位置[mm]"],
      lambda s: (s.t * 1e3, s.i, s.u, s.x * 1e3, s.r), encoding="cp932")  # fmt: skip
table("excel_sep.csv", ["sep=;", "Zeit in s;Spulenspannung in V;Spulenstrom in A;Rotorlage in mm"], plain, ";", ",")
table("closed_loop.csv", ["time,u_ref,u_meas,i_ref,i_meas,x_set,x_meas"],
      lambda s: (s.t, np.roll(s.u, 3), s.u, np.roll(s.i, 5), s.i, s.r * 1e-5, s.x))  # fmt: skip
# what cannot be known
table("en_all_volts.csv", ["time [s],voltage [V],current [V],position [V]"], lambda s: (s.t, s.u, 0.1 * s.i, s.x * 1e4))
table("no_position.csv", ["time [s],voltage [V],current [A]"], lambda s: plain(s)[:3])
table("two_positions.csv", ["time [s],voltage [V],current [A],position 1 [mm],position 2 [mm]"],
      lambda s: (*plain(s), 1.01 * s.x * 1e3))  # fmt: skip
# units that are wrong
table("wrong_mm.csv", ["time [s],voltage [V],current [A],position [mm]"], si)
table("wrong_current.csv", ["time [s],voltage [V],current [mA],position [mm]"], plain)
QUESTIONS |= {"wrong_mm.csv", "wrong_current.csv"}

_LVM = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t{decimal}
Multi_Headings\tNo
X_Columns\t{x}
Time_Pref\tRelative
Operator\tlab
Date\t2025/04/03
Time\t10:11:12,1234
***End_of_Header***\t

Channels\t3\t\t\t
Samples\t{n}\t{n}\t{n}\t
Date\t2025/04/03\t2025/04/03\t2025/04/03\t
Time\t10:11:12\t10:11:12\t10:11:12\t
Y_Unit_Label\tV\tA\tmm\t
X_Dimension\tTime\tTime\tTime\t
X0\t0.0000000000000000E+0\t0.0000000000000000E+0\t0.0000000000000000E+0\t
Delta_X\t{dt}\t{dt}\t{dt}\t
***End_of_Header***\t\t\t\t
X_Value\t{names}\tComment
"""


def lvm(name, x, decimal="."):
    def make(path, s):
        names = "Voltage\tX_Value\tCurrent\tX_Value\tPosition" if x == "Multi" else "Voltage\tCurrent\tPosition"
        head = _LVM.format(x=x, decimal=decimal, n=s.t.size, dt=f"{1 / s.rate:.6f}".replace(".", decimal), names=names)
        if x == "No":
            rows = np.column_stack([s.u, s.i, s.x * 1e3])
            lead = "\t"
        else:
            columns = [s.t, s.u, s.t, s.i, s.t, s.x * 1e3] if x == "Multi" else [s.t, s.u, s.i, s.x * 1e3]
            rows, lead = np.column_stack(columns), ""
        body = "\n".join(lead + "\t".join(f"{v:.6f}".replace(".", decimal) for v in row) for row in rows)
        path.write_text(head + body + "\n", encoding="utf-8")

    file(name)(make)


lvm("labview.lvm", "One")
lvm("labview_comma.lvm", "One", ",")
lvm("labview_no_x.lvm", "No")
lvm("labview_multi.lvm", "Multi")


@file("long.csv")
def _(path, s):
    rows = [f"{t:.9g},{n},{v:.9g}" for k, t in enumerate(s.t)
            for n, v in (("voltage [V]", s.u[k]), ("current [A]", s.i[k]), ("gap [mm]", 1e3 * s.x[k]))]  # fmt: skip
    path.write_text("time [s],signal,value\n" + "\n".join(rows) + "\n")


@file("long_units.csv")
def _(path, s):
    rows = [f"{n};{t:.9g};{v:.9g};{w}".replace(".", ",")
            for n, x, w in (("Strom", s.i, "A"), ("Weg", 1e3 * s.x, "mm"), ("Spannung", s.u, "V"))
            for t, v in zip(s.t, x, strict=True)]  # fmt: skip
    path.write_text("Kanal;Zeit [s];Wert;Einheit\n" + "\n".join(rows) + "\n")


@file("wide.csv")
def _(path, s):
    rows = (("time [s]", s.t), ("voltage [V]", s.u), ("current [A]", s.i), ("position [mm]", 1e3 * s.x))
    path.write_text("\n".join(",".join([name, *(f"{v:.9g}" for v in x)]) for name, x in rows) + "\n")


@file("dates.csv")
def _(path, s):
    stamps = np.datetime64("2025-04-03T10:11:12") + np.round(s.t * 1e9).astype("timedelta64[ns]")
    rows = [f"{a},{u:.9g},{i:.9g},{1e3 * x:.9g}" for a, u, i, x in zip(stamps, s.u, s.i, s.x, strict=True)]
    path.write_text("timestamp,voltage [V],current [A],position [mm]\n" + "\n".join(rows).replace("T", " ") + "\n")


@file("arrays.npz")
def _(path, s):
    np.savez(path, t=s.t, u=s.u, i=s.i, x=s.x)


@file("arrays_fs.npz")
def _(path, s):
    np.savez(path, voltage=s.u, current=s.i, position=s.x, fs=s.rate)


@file("matrix_names.npz")
def _(path, s):
    names = np.array(["time [s]", "voltage [V]", "current [A]", "position [mm]"])
    np.savez(path, data=np.column_stack(plain(s)), names=names)


@file("matrix.npy")
def _(path, s):
    np.save(path, np.column_stack(plain(s)))


@file("matrix_wide.npy")
def _(path, s):
    np.save(path, np.array(si(s)))


@file("structured.npy")
def _(path, s):
    rows = np.rec.fromarrays(list(si(s)), names="Zeit,Spannung,Strom,Weg")
    np.save(path, np.asarray(rows))


@file("no_rate.npy")
def _(path, s):
    np.save(path, np.column_stack(si(s)[1:]))


def workbook(name, fill):
    def make(path, s):
        import openpyxl

        book = openpyxl.Workbook()
        fill(book, s)
        book.save(path)

    file(name)(make)


def _sheet(book, s):
    sheet = book.active
    sheet.append(["Zeit [s]", "Spannung [V]", "Strom [A]", "Weg [mm]"])
    for row in np.column_stack(plain(s)).tolist():
        sheet.append(row)


def _titled(book, s):
    book.active.title = "Info"
    book.active.append(["Bench 7"])
    sheet = book.create_sheet("Data")
    for row in (["Run 12"], [], ["t", "U", "I", "x"], ["ms", "V", "A", "µm"]):
        sheet.append(row)
    for row in np.column_stack([s.t * 1e3, s.u, s.i, s.x * 1e6]).tolist():
        sheet.append(row)


workbook("sheet.xlsx", _sheet)
workbook("titled.xlsx", _titled)


def mat(name, content):
    def make(path, s):
        from scipy.io import savemat

        savemat(path, content(s), long_field_names=True, do_compression="packed" in path.name)

    file(name)(make)


def structs(*rows):
    """An array of structs."""
    out = np.empty((1, len(rows)), dtype=[(k, object) for k in rows[0]])
    for k, row in enumerate(rows):
        out[0, k] = tuple(row.values())
    return out


def cells(*texts):
    out = np.empty((1, len(texts)), dtype=object)
    out[0, :] = texts
    return out


def col(x):
    return np.asarray(x)[:, None]


mat("vectors.mat", lambda s: {"t": col(s.t), "u": col(s.u), "i": col(s.i), "x": col(s.x)})
mat("vectors_de.mat", lambda s: {"Zeit": col(s.t), "Spannung": col(s.u), "Strom": col(s.i), "Weg": col(s.x), "n": 7.0})
mat("scalar_Ts_packed.mat", lambda s: {"Ts": 1 / s.rate, "u": s.u, "i": s.i, "pos": s.x})
mat("scalar_fs.mat", lambda s: {"meas": {"fs": s.rate, "voltage": col(s.u), "current": col(s.i), "position": col(s.x)}})
mat("matrix_cell.mat", lambda s: {"data": np.column_stack(plain(s)), "names": cells("time", "voltage", "current", "x"),
                                  "units": cells("s", "V", "A", "mm")})  # fmt: skip
mat("matrix_labels.mat", lambda s: {"Y": np.array(plain(s)), "labels": cells("t [s]", "U [V]", "I [A]", "x [mm]")})
mat("matrix_bare.mat", lambda s: {"log": np.column_stack(si(s))})
mat("struct_columns.mat", lambda s: {"bench": {"run": {"time": col(s.t), "u": col(s.u), "i": col(s.i), "x": col(s.x)}}})


def dspace(s, *, order="uix"):
    signals = {"u": ("Model Root/Coil voltage/Out1", s.u, "V"), "i": ("Model Root/Coil current/Out1", s.i, "A"),
               "x": ("Model Root/Position/Out1", 1e3 * s.x, "mm")}  # fmt: skip
    ys = [{"Name": n, "Type": "float64", "Data": v[None, :], "Unit": w, "XIndex": 1.0}
          for n, v, w in (signals[k] for k in order)]  # fmt: skip
    x = {"Name": "", "Type": "float64", "Data": s.t[None, :], "Unit": "s"}
    return {"X": structs(x), "Y": structs(*ys), "Description": {"General": {"DateTime": "2025-04-03"}},
            "RTProgram": "bench.sdf", "Capture": {"SamplePeriod": 1.0}}  # fmt: skip


mat("struct_above.mat", lambda s: {"S": {"time": col(s.t), "meas": {"u": col(s.u), "i": col(s.i), "pos": col(s.x)}}})
mat("simulink_tout.mat", lambda s: {"tout": col(s.t), "yout": {"time": np.empty((0, 0)), "signals": structs(
    {"values": col(s.u), "dimensions": 1.0, "label": "u"}, {"values": col(s.i), "dimensions": 1.0, "label": "i"},
    {"values": col(s.x), "dimensions": 1.0, "label": "x"})}})  # fmt: skip
mat("matrix_index.mat", lambda s: {"M": np.column_stack([np.arange(s.t.size), *si(s)]), "dt": 1 / s.rate})
mat("dspace.mat", lambda s: {"rec": dspace(s)})
mat("dspace_packed.mat", lambda s: {"exp_007": dspace(s, order="xiu")})
mat("simulink_time.mat", lambda s: {"ScopeData": {"time": col(s.t), "signals": structs(
    {"values": col(s.u), "dimensions": 1.0, "label": "voltage [V]"},
    {"values": col(s.i), "dimensions": 1.0, "label": "current [A]"},
    {"values": col(s.x), "dimensions": 1.0, "label": "position [m]"}), "blockName": "bench/Scope"}})  # fmt: skip
mat("simulink_no_labels.mat", lambda s: {"out": {"yout": {"time": col(s.t), "signals": {
    "values": np.column_stack([s.u, s.i, s.x]), "dimensions": 3.0, "label": ""}}}})  # fmt: skip


def series(name, t, y, unit):
    return {"Time": col(t), "Data": col(y), "Name": name, "DataInfo": {"Units": unit}}


mat("timeseries_nested.mat", lambda s: {"logsout": {"plant": {
    "coil": {"U": series("U", s.t, s.u, "V"), "I": series("I", s.t, s.i, "A")},
    "rotor": {"x": series("x", s.t, s.x * 1e3, "mm")}}}})  # fmt: skip
mat("to_workspace.mat", lambda s: {"tout": col(s.t), "voltage": col(s.u), "current": col(s.i), "pos": col(s.x)})


@file("figure.fig")
def _(path, s):
    from scipy.io import savemat

    def line(name, y):
        return {"type": "graph2d.lineseries", "handle": 1.0, "children": np.empty((0, 0)), "special": np.empty((0, 0)),
                "properties": {"XData": s.t[None, :], "YData": y[None, :], "DisplayName": name}}  # fmt: skip

    axes = [{"type": "axes", "handle": 2.0, "children": structs(line(n, y)), "special": np.empty((0, 0)),
             "properties": {"Tag": ""}}
            for n, y in (("voltage [V]", s.u), ("current [A]", s.i), ("position [mm]", 1e3 * s.x))]  # fmt: skip
    figure = {"type": "figure", "handle": 3.0, "children": structs(*axes), "properties": {"Name": "run 7"}}
    with path.open("wb") as out:
        savemat(out, {"hgS_070000": figure}, long_field_names=True)


def write73(file, name, value):
    """Write as MATLAB 7.3 does: column-major, structs as groups, arrays of structs and cells by references."""
    import h5py

    if isinstance(value, dict):
        group = file.create_group(name)
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, x in value.items():
            write73(file, f"{name}/{key}", x)
    elif isinstance(value, str):
        dataset = file.create_dataset(name, data=np.array([[ord(c)] for c in value], dtype=np.uint16))
        dataset.attrs["MATLAB_class"] = np.bytes_("char")
    elif isinstance(value, list):
        group = file.create_group(name)
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for key in value[0]:
            references = np.empty((len(value), 1), dtype=h5py.ref_dtype)
            for k, row in enumerate(value):
                at = f"#refs#/{name.replace('/', '_')}_{key}_{k}"
                write73(file, at, row[key])
                references[k, 0] = file[at].ref
            group.create_dataset(key, data=references, dtype=h5py.ref_dtype)
    else:
        dataset = file.create_dataset(name, data=np.atleast_2d(value).T)
        dataset.attrs["MATLAB_class"] = np.bytes_("double")


def mat73(name, content):
    def make(path, s):
        import h5py

        with h5py.File(path, "w", userblock_size=512) as out:
            for key, value in content(s).items():
                write73(out, key, value)
        with path.open("r+b") as out:
            out.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")

    file(name)(make)


mat73("v73_vectors.mat", lambda s: {"zeit": col(s.t), "spannung": col(s.u), "strom": col(s.i), "weg": col(s.x)})
mat73("v73_dspace.mat", lambda s: {"rec": {
    "X": {"Name": "t", "Data": s.t[None, :], "Unit": "s"},
    "Y": [{"Name": n, "Data": y[None, :], "Unit": w}
          for n, y, w in (("voltage", s.u, "V"), ("current", s.i, "A"), ("position", s.x * 1e6, "um"))]}})  # fmt: skip


@file("plain.h5")
def _(path, s):
    import h5py

    with h5py.File(path, "w") as out:
        group = out.create_group("run")
        for key, y, unit in (("time", s.t, "s"), ("voltage", s.u, "V"), ("current", s.i, "A"), ("position", s.x, "m")):
            group.create_dataset(key, data=y).attrs["units"] = unit


def signals(duration: float = 0.3, seed: int = 3, bench: str = "unstable-bearing") -> Signals:
    """Simulate the record that all files hold."""
    import ambid

    record = ambid.simulate(bench, duration=duration, seed=seed)
    r = np.sin(2 * np.pi * 40 * record.time_s)
    u, i, x = (np.array(record[name].values) for name in ("voltage", "current", "position"))
    return Signals(t=np.array(record.time_s), u=u, i=i, x=x, r=r)


def write_all(folder: Path, s: Signals) -> list[Path]:
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in FILES.items():
        make(folder / name, s)
    return [folder / name for name in FILES]


if __name__ == "__main__":
    write_all(Path(sys.argv[1]), signals())
