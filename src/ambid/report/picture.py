"""Pictures of a page: figures as small SVG that follow its colours, with the points whose values a pointer reads."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.report.drawing import save

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# fmt: off
# colours that depend on light and dark, by the name that report.css gives them
_NAMED = {"#ffffff": "paper", "#000000": "ink", "#1a1a1a": "ink", "#4d4d4d": "measured", "#777777": "edge",
          "#e4e4e4": "grid", "#fbf7ee": "second", "#a9d1ec": "band", "#0072b2": "predicted", "#555555": "edge"}
# fmt: on
_FIXED = ("#1b1b1b", "#fefefe")  # on coloured cells
_LONG = 40  # lines of a path from which tenths of a point are enough
_CLOSE = 0.2  # points by which a long path may leave what it draws
_READ = 800  # points of a line, of which a pointer reads no more: they lie closer than it can be placed
_BORDERS = ("border of stability",)  # lines without values
_LARGEST = 400_000  # letters of an SVG, from which a PNG is smaller


class Arrays:
    """Arrays in base 64, each kept once: little-endian float32, of which pages show six digits at most."""

    def __init__(self) -> None:
        """Hold none yet."""
        self.packed: list[str] = []
        self._known: dict[str, int] = {}

    def add(self, values: Array) -> int:
        """Return the place of an array (n,), of finite values or NaN."""
        with np.errstate(over="ignore"):  # what runs away so far is not drawn
            text = base64.b64encode(np.asarray(values).astype("<f4").tobytes()).decode()
        if text not in self._known:
            self._known[text] = len(self.packed)
            self.packed.append(text)
        return self._known[text]


def picture(figure: Figure, title: str, prefix: str) -> tuple[str, dict[str, Any]]:
    """Return a figure as the HTML of a picture, and what a pointer reads of it.

    `title`: what it shows, for those who hear the page; `prefix`: of the names inside, each once on a page.
    """
    import matplotlib
    from markupsafe import escape

    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        save(figure, buffer, kind="svg")
    text = buffer.getvalue().decode()
    if len(text) > 4 * _LARGEST or len(small := _small(text[text.index("<g id=") :], prefix)) > _LARGEST:
        buffer = io.BytesIO()
        save(figure, buffer, kind="png")
        return (
            f'<img alt="{escape(title)}" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">',
            {},
        )
    width, height = (72 * x for x in figure.get_size_inches())
    head = f'<svg viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(title)}" tabindex="0"'
    return f'{head} fill="var(--ink)" stroke-linejoin="round">{small}', _read(figure)


def image(figure: Figure, title: str) -> str:
    """Return a figure as the address of an image, whose colours follow light and dark as those of a page do."""
    from importlib.resources import files

    html_text, _ = picture(figure, title, "i")
    if html_text.startswith("<img"):
        return html_text.rpartition('src="')[2].removesuffix('">')
    sheet = files("ambid").joinpath("data", "report.css").read_text(encoding="utf-8")
    colours = sheet[: sheet.index("* {")] + "text { font-family: system-ui, sans-serif; }"
    whole = html_text.replace("<svg ", '<svg xmlns="http://www.w3.org/2000/svg" ', 1).replace(
        ">", f"><style>{colours}</style>", 1
    )
    return "data:image/svg+xml;base64," + base64.b64encode(whole.encode()).decode()


def _small(text: str, prefix: str) -> str:
    """Return the body of an SVG in fewer letters: named colours, attributes for styles, rounded paths."""
    references = dict.fromkeys(re.findall(r"(?:url\(|href=\")#([^)\"]+)", text))
    names = {name: f"{prefix}{k}" for k, name in enumerate(references)}
    text = re.sub(r' id="([^"]*)"', lambda m: f' id="{names[m[1]]}"' if m[1] in names else "", text)
    text = re.sub(r"(url\(|href=\")#([^)\"]+)", lambda m: f"{m[1]}#{names[m[2]]}", text).replace("xlink:", "")
    text = re.sub(r' d="([^"]*)"', lambda m: f' d="{_path(m[1])}"', text)
    text = re.sub(r' style="([^"]*)"', lambda m: _attributes(m[1]), text)
    text = re.sub(r' transform="rotate\(-?0 [^"]*"|<!--.*?-->', "", text, flags=re.DOTALL)
    text = re.sub(r'( (?:x|y|width|height)="-?\d+\.\d\d)\d+', r"\1", text)
    text = re.sub(r"rotate\((-?\d+) (-?\d+\.\d)\d* (-?\d+\.\d)\d*", r"rotate(\1 \2 \3", text)
    text = re.sub(r">\s+<", "><", text)
    # neighbours that look alike are put together: bars and stems as one path, marks as one group
    for _ in range(2):
        text = re.sub(r"<g>(<[^/][^>]*/>)</g>", r"\1", text)
    lines = r'<path d="[^"]*"([^>]* fill="none"[^>]*)/>(?:<path d="[^"]*"\1/>)+'
    text = re.sub(lines, lambda m: f"""<path d="{"".join(re.findall(' d="([^"]*)', m[0]))}"{m[1]}/>""", text)
    marks = r'<use href="([^"]*)" x="[^"]*" y="[^"]*"([^>]*)/>(?:<use href="\1" x="[^"]*" y="[^"]*"\2/>)+'
    return re.sub(marks, lambda m: f"<g{m[2]}>{m[0].replace(m[2], '')}</g>" if m[2] else m[0], text)


def _attributes(style: str) -> str:
    """Return a style as attributes, which need no permission of a page's security policy."""
    attributes = []
    for part in filter(None, (x.strip() for x in style.split(";"))):
        name, value = (x.strip() for x in part.split(":", 1))
        if name == "font":  # of an older matplotlib
            name, value = "font-size", value.split("px")[0].split()[-1] + "px" + ("Mono" if "Mono" in value else "")
        if name == "font-family" or value.endswith("Mono"):
            attributes += ['font-family="monospace"'] if "Mono" in value else []
        if name != "font-family":
            colour = _NAMED.get(value.lower(), _grey(value.lower()))
            attributes.append(f'{name}="{value.removesuffix("Mono") if colour is None else f"var(--{colour})"}"')
    return "".join(f" {x}" for x in attributes)


def _grey(value: str) -> str | None:
    """Return the nearest named colour of a grey; None for other colours, and for those that stay in the dark."""
    match = re.fullmatch(r"#([0-9a-f]{2})\1\1", value)
    if match is None or value in _FIXED:
        return None
    return "ink" if match[1] < "60" else "edge" if match[1] < "b0" else "rule"


def _path(d: str) -> str:
    """Write a path with rounded numbers: lines relative to the point before, long ones with the points they need."""
    parts = re.findall(r"(L(?:[^A-Za-z]|L)*|[A-Za-z][^A-Za-z]*)", d)
    long, out, at = d.count("L") > _LONG, [], np.zeros(2)
    for part in parts:
        points = np.array(part.replace("L", " ")[part[0] != "L" :].split(), dtype=float).reshape(-1, 2)
        if part[0] == "L" and long:
            points = points[_needed(points)]
        points = np.round(points, 1 if long else 2)
        steps = np.diff(points, axis=0, prepend=at[None]) if part[0] == "L" else points
        numbers = " ".join(f"{x:.2f}".rstrip("0").rstrip(".") for x in steps.ravel() + 0.0)
        numbers = re.sub(r"(?<![\d.])0\.", ".", numbers.replace("-0 ", "0 ")).replace(" -", "-")
        out.append(part[0].replace("L", "l") + numbers)
        at = points[-1] if points.size else at
    return "".join(out)


def _needed(points: Array) -> Array:
    """Which points (n, 2) a line needs that nowhere leaves them by more than `_CLOSE` (Douglas and Peucker)."""
    needed, open_ = np.zeros(len(points), dtype=bool), [(0, len(points) - 1)]
    needed[[0, -1]] = True
    while open_:
        first, last = open_.pop()
        across, between = points[last] - points[first], points[first + 1 : last] - points[first]
        length = float(np.hypot(*across))
        far = np.abs(between @ [-across[1], across[0]]) / length if length > _CLOSE else np.hypot(*between.T)
        if far.size and far.max() > _CLOSE:
            k = first + 1 + int(np.argmax(far))
            needed[k] = True
            open_ += [(first, k), (k, last)]
    return needed


def _read(figure: Figure) -> dict[str, Any]:
    """Return boxes, scales and points of a figure that has been drawn, in the points of its SVG."""
    arrays, panels = Arrays(), []
    for axes in (a for a in figure.axes if a.axison):
        points = [{"label": label, "x": arrays.add(x), "y": arrays.add(y)} for label, x, y in _points(axes)]
        if points:
            box = axes.get_window_extent().transformed(figure.transFigure.inverted())
            across, up = 72 * figure.get_size_inches()
            siblings = axes.get_shared_x_axes().get_siblings(axes)
            panels.append({
                "box": [round(x, 2) for x in (box.x0 * across, (1 - box.y1) * up, box.width * across, box.height * up)],
                "x": [*axes.get_xlim(), axes.get_xscale() == "log"],
                "y": [*axes.get_ylim(), axes.get_yscale() == "log"],
                "names": [next((a.get_xlabel() for a in siblings if a.get_xlabel()), ""), axes.get_ylabel()],
                "points": points,
            })  # fmt: skip
    return {"arrays": arrays.packed, "panels": panels} if panels else {}


def _points(axes: Axes) -> Iterator[tuple[str, Array, Array]]:
    """Label and coordinates of what has points: lines, marks and stems; not of bands and borders."""
    from matplotlib.collections import LineCollection
    from matplotlib.container import ErrorbarContainer

    bars = [c for c in axes.containers if isinstance(c, ErrorbarContainer)]
    labels = {c[0]: str(c.get_label()) for c in bars}
    for line in axes.lines:
        label, (x, y) = labels.get(line, str(line.get_label())), (np.asarray(v, dtype=float) for v in line.get_data())
        aside = label[:1] == "_" and any(
            str(x.get_label())[:1] != "_" for x in axes.lines
        )  # belongs to one with a name
        free = not aside and all(line.get_transform().contains_branch_seperately(axes.transData))
        if free and x.size and label not in _BORDERS:
            some = slice(None, None, -(-x.size // _READ))
            yield label if label[:1] != "_" else "", x[some], y[some]
    for stems in (c for c in axes.collections if isinstance(c, LineCollection) and all(c not in b[2] for b in bars)):
        ends = np.array([max(s, key=lambda end: abs(end[1])) for s in stems.get_segments()])
        if ends.size:
            yield "", ends[:, 0], ends[:, 1]
