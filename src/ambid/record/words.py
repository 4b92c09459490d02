"""What names of columns say in English, German, French, Spanish, Italian, Japanese and Chinese: quantities, units
behind or within a name, sampling intervals and rates beside the data.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping
from functools import lru_cache

from ambid.errors import UnitError
from ambid.units import Unit, parse_unit

# Of each quantity: parts of a name, then whole words of it, then short names, which may end in an axis or a number.
# Without accents, in small letters.
_QUANTITIES: Mapping[str, tuple[str, str, str]] = {
    "time": ("zeitstempel|timestamp|messzeit|horodatage|時間|时间|時刻|时刻",
             "time|times|zeit|temps|tiempo|tempo|tout|uhrzeit|clock", "t"),
    "voltage": ("volt|spannung|tension|duty|pwm|stellgro|電圧|电压|電壓", "command|input|drive", "u|v"),
    "current": (r"curr|strom|courant|corriente|corrente|intensi|(?<!st)(?<!cl)(?<!\br)(?<![sd])amp(?!l)|電流|电流",
                "amp", "i"),
    "position": (r"pos|disp|gap|eddy|hall|abstand|auslenk|luftspalt|weg\b|deplac|entrefer|desplaz|entrehierro|spostam|"
                 "traferro|sensor|変位|位置|位移|間隙|间隙|气隙|ギャップ", "lage|output|hub", "x|y|z"),
    "speed": ("speed|velo|omega|rotat|drehzahl|geschwind|vitesse|giri|速度|转速|回転", "rpm|spin", "n"),
    "angle": ("angle|encoder|winkel|angol|angul|角度", "phi|theta|phase", ""),
    "force": ("force|kraft|fuerza|forza|荷重|推力|磁力", "load|effort|力", "f"),
    "other": ("temper|温度|counter|index|sample|status|druck|pressure|accel|beschleun", "temp|nr|no|flag", ""),
}  # fmt: skip
_SET_POINT = re.compile(
    r"(?<!ent)ref(?!lec)|set(?!up)|target|desired|goal|soll|consign|riferim|objetivo|目標|目标|指令|参考|参照|設定|设定|給定|给定"
)
_PART = {k: re.compile(parts) for k, (parts, _, _) in _QUANTITIES.items()}
_WORD = {k: frozenset(words.split("|")) for k, (_, words, _) in _QUANTITIES.items()}
_SHORT = {
    k: re.compile(f"(?:{short})(?:[a-z0-9]|ist|act|in|out)?") for k, (_, _, short) in _QUANTITIES.items() if short
}
_RATE = re.compile(
    r"fs|sr|f_?s|rate|(?:sampl|record|acquir|logg|measur)edat|(?:sampl\w*|abtast\w*|scan\w*|acquisition|daq)(?:rate|freq\w*)|fsampl\w*|frequence\w*echant\w*|"
    r"frecuencia\w*muestreo|frequenzadi?campion\w*|采样[频率]+|サンプリング周波数|samplespersecond|ratehz"
)
_INTERVAL = re.compile(
    r"ts|dt|t_?s|delta_?[tx]|(?:sampl\w*|abtast\w*|scan\w*)(?:time|zeit|interval\w*|period\w*|intervall)|tsampl\w*|increment|"
    r"xincr\w*|stepsize|interval|tastzeit|periode\w*echant\w*|periodo\w*muestreo|periododicampion\w*|采样[周期时间]+|"
    r"サンプリング周期|wfincrement|horinterval"
)
_UNIT_WORDS = {
    "V": "volt volts vdc", "A": "amp amps ampere amperes", "m": "meter meters metre metres", "s": "sec secs second "
    "seconds sekunde sekunden", "ms": "millisecond milliseconds msec", "us": "microsecond microseconds usec",
    "N": "newton newtons", "Hz": "hertz s/s sa/s sps samples/s", "kHz": "ks/s ksa/s ksps", "ohm": "ohms",
    "deg": "degree degrees °", "rad": "radian radians", "rpm": "1/min u/min min^-1", "mm": "millimeter millimeters",
    "um": "micron microns micrometer micrometers", "mil": "mils thou", "mV": "millivolt", "mA": "milliampere milliamps",
}  # fmt: skip
_SYMBOLS = {word: unit for unit, words in _UNIT_WORDS.items() for word in words.split()}
_LABEL = re.compile(r"(?P<name>.*?)\s*\[(?P<unit>[^\[\]]*)\]")
_BEHIND = (re.compile(r"(?P<name>.*\S)\s*\((?P<unit>[^()]*)\)"),
           re.compile(r"(?P<name>.*[^\s/])\s*/\s*(?P<unit>[^\s/()]+)"),
           re.compile(r"(?P<name>.*\S)(?:\s+(?:in|en)\s+|,\s*)(?P<unit>\S+)"))  # fmt: skip
_KINDS = {"time": "s", "voltage": "V", "current": "A", "position": "m", "force": "N"}


def symbol(text: str) -> str:
    """Return a unit as it is usually written: ``V`` for ``volts``."""
    plain = text.strip()
    return _SYMBOLS.get(plain.lower(), plain)


@lru_cache(maxsize=1024)
def unit_or_none(text: str | None) -> Unit | None:
    """Return the unit that a text names; None where it names none."""
    try:
        return None if text is None else parse_unit(symbol(text))
    except UnitError:
        return None


def label_of(label: str) -> tuple[str, str | None]:
    """Return name and unit of ``name [unit]``, and of ``name (unit)``, ``name/unit``, ``name in unit`` where the
    unit is a known one.
    """
    text = label.strip()
    if match := _LABEL.fullmatch(text):
        return match["name"].strip(), match["unit"].strip()
    for form in _BEHIND:
        match = form.fullmatch(text)
        if match and not match["unit"].strip().isdigit() and unit_or_none(match["unit"]) is not None:
            return match["name"].strip(), match["unit"].strip()
    return text, None


@lru_cache(maxsize=1024)
def _words(name: str) -> tuple[str, tuple[str, ...]]:
    """Return a name without accents in small letters, and its words: ``U_A`` and ``coilCurrent`` have two each."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z][a-z])", " ", unicodedata.normalize("NFKD", name))
    plain = "".join(c for c in apart if not unicodedata.combining(c)).lower()
    return plain, tuple(re.findall(r"[^\W_]+", plain))


@lru_cache(maxsize=1024)
def quantities(name: str) -> frozenset[str]:
    """Return what a name may be that of: time, voltage, current, position, speed, angle, force, other."""
    plain, words = _words(name)
    named = frozenset(k for k in _QUANTITIES if _PART[k].search(plain) or _WORD[k] & set(words))
    if named:
        return named if named == {"time"} else named - {"time"}
    if re.fullmatch(r"x[ _-]?(?:value|axis)(?:[ _]\d+)?", plain):
        return frozenset({"time"})
    return frozenset(k for k, short in _SHORT.items() if words and short.fullmatch(words[0]))


def is_time(name: str) -> bool:
    """Whether a column called so is time."""
    return "time" in quantities(name)


def is_set_point(name: str) -> bool:
    """Whether a column called so is what a controller is told, not what is measured."""
    return _SET_POINT.search(_words(name)[0]) is not None


def unit_within(name: str) -> str | None:
    """Return the unit that a name ends in, as ``pos_um`` and ``time_ms`` do, where it is one of what the rest names."""
    rest, _, last = name.strip().replace(" ", "_").rpartition("_")
    unit = unit_or_none(last) if rest and not last.isdigit() else None
    return last if unit is not None and any(_KINDS.get(k) == unit.si for k in quantities(rest)) else None


def rate_of(name: str, value: float, text: str | None = None) -> tuple[float, bool] | None:
    """Return the sampling rate in Hz that a number beside the data tells, ``fs``, ``dt`` and the like, and whether a
    unit says so; else None, also where the unit is not known (``50 k``).
    """
    called, inside = label_of(name)
    called = _words(called)[0]
    ending = re.fullmatch(r"(.*[^_\W])[_ ](k?hz|m?s|us)", called)
    if ending and text is None and inside is None:
        called, inside = ending[1], {"hz": "Hz", "khz": "kHz"}.get(ending[2], ending[2])
    key, unit = re.sub(r"[^\w]|_(?!s\b)", "", called), unit_or_none(text or inside)
    if not value > 0 or (unit is None and (text or inside or key.endswith("edat"))):  # recorded at 2024: no rate
        return None
    if _RATE.fullmatch(key) and (unit is None or unit.si == "Hz"):
        rate = value if unit is None else unit.to_si(value)
    elif _INTERVAL.fullmatch(key) and (unit is None or unit.si == "s"):
        rate = 1.0 / (value if unit is None else unit.to_si(value))
    else:
        return None
    sure = unit is not None or key == "samplespersecond"
    return (float(f"{rate:.10g}"), sure) if 20.0 <= rate <= 1e8 else None
