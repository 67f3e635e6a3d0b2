"""Describe a figure as text: one line per artist, with its style and its data."""

from collections import Counter
from difflib import unified_diff
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import to_hex
from matplotlib.legend import Legend
from matplotlib.spines import Spine
from matplotlib.ticker import AutoLocator

_STYLE = (
    *("label", "text", "visible", "zorder", "alpha", "clip_on", "color", "edgecolor"),
    *("facecolor", "markerfacecolor", "marker", "markersize", "markeredgewidth"),
    *("linestyle", "linewidth", "fontsize", "fontweight", "ha", "va", "rotation"),
    *("clim", "interpolation"),
)
_DATA = ("xydata", "offsets", "widths", "heights", "angles", "segments", "array")
_AXES = ("xlim", "ylim", "xscale", "yscale", "aspect", "facecolor")
_LEGEND = ("_ncols", "_loc", "handlelength", "handletextpad", "columnspacing")
_LEGEND += ("borderpad", "labelspacing", "borderaxespad")
_NOTE = ("xy", "xyann", "xycoords", "textcoords", "_unscaled_dash_pattern")
_USUAL = ("visible=True", "clip_on=True", "clim=(None, None)", "fontweight=normal")
_USUAL += ("rotation=0", "va=baseline", "ha=left", "aspect=auto", "offsets=(0, 0)")
_USUAL += ("xscale=linear", "yscale=linear", "facecolor=#ffffffff", "zorder=2")
_USUAL += ("_unscaled_dash_pattern=(0, None)",)


def check_looks(figure, name):
    """Compare a figure with its file in ``looks``; delete that to record another."""
    lines = [f"{n} × {line}" for line, n in Counter(described(figure)).items()]
    file = Path(__file__).with_name("looks") / f"{name}.txt"
    if not file.exists():
        file.write_text("\n".join([*lines, ""]))
        pytest.fail(f"wrote {file}: check it, and run the test again")
    differ = "\n".join(unified_diff(file.read_text().splitlines(), lines, n=0))
    assert not differ, differ


def described(figure):
    """Return the lines of a figure: numbers with four digits, data by their moments."""
    layout = figure.get_layout_engine()
    size = {"size": figure.get_size_inches()} | (layout.get() if layout else {})
    lines = [line for artist in figure.get_children()[1:] for line in _lines(artist)]
    return [f"Figure {_fields(size)}", *lines]


def _lines(artist):
    name = type(artist).__name__.removeprefix("FillBetween")
    if isinstance(artist, Axes):
        place = _got(artist, _AXES) | _cell(artist.get_subplotspec())
        inside = [line for each in artist.get_children()[:-1] for line in _lines(each)]
        return [f"{name} {_fields(place)}", *inside]
    if isinstance(artist, Axis):
        ticks = {_side(key): is_on for key, is_on in artist.get_tick_params().items()}
        locator = artist.get_major_locator()
        if not isinstance(locator, AutoLocator):
            least, most = sorted(artist.get_view_interval())
            ticks |= {"at": [at for at in locator() if least <= at <= most]}
        return [f"{name} {_fields(ticks)}", *_lines(artist.label)]
    if isinstance(artist, Legend):
        looks = _fields({name: getattr(artist, name) for name in _LEGEND})
        widths = [each.get_linewidth() for each in artist.legend_handles]
        looks += f" frame={artist.get_frame_on()} keys={np.ravel(widths).tolist()}"
        texts = [artist.get_title(), *artist.get_texts()]
        named = " | ".join(text.get_text() for text in texts)
        return [f"{name} {looks} | {named}", *_lines(texts[-1])]
    return _plain(artist, name)


def _side(name):
    """Use the same names for both axes, because versions of matplotlib differ."""
    for side, like in (("left", "bottom"), ("right", "top")):
        name = name.replace(side, like)
    return name


def _cell(spec):
    """Return the cell of axes in a layout, and the ratios of its columns and rows."""
    if not spec:
        return {}
    grid = spec.get_gridspec()
    ratios = grid.get_width_ratios(), grid.get_height_ratios()
    columns, rows = (list(map(float, each)) for each in ratios)
    return {"cell": [spec.num1, spec.num2], "widths": columns, "heights": rows}


def _plain(artist, name):
    if isinstance(artist, Spine):
        hue = to_hex(artist.get_edgecolor())
        return [f"Spine {artist.spine_type} {hue}"] if artist.get_visible() else []
    found = _got(artist, (*_STYLE, *_DATA))
    if found.get("text") == "":
        return []
    if hasattr(artist, "get_paths") and not {"segments", "widths"} & set(found):
        found["path"] = np.concatenate([path.vertices for path in artist.get_paths()])
    noted = {name: getattr(artist, name) for name in _NOTE if hasattr(artist, name)}
    return [f"{name} {_fields(found | noted)}"]


def _got(artist, names):
    """Return what the getters of an artist return."""
    every = {name: getattr(artist, f"get_{name}", None) for name in names}
    return {name: get() for name, get in every.items() if get is not None}


def _fields(found):
    texts = {name: _short(value, "color" in name) for name, value in found.items()}
    pairs = [f"{name}={text}" for name, text in texts.items() if text]
    return " ".join(pair for pair in pairs if pair not in _USUAL)


def _short(value, is_colour=False):
    """Write a value, or nothing if it is not set or a label that matplotlib counts."""
    if value is None or str(value).startswith("_child"):
        return ""
    if isinstance(value, str | int | float | np.number):
        return str(value) if isinstance(value, str | bool) else f"{value:.4g}"
    if isinstance(value, list | tuple) and len(value) <= 4 and not is_colour:
        return f"({', '.join(_short(each) or 'None' for each in value)})"
    if is_colour:
        colours = np.reshape(value, (-1, np.shape(value)[-1]))
        return to_hex(colours[0], keep_alpha=True) if len(colours) else ""
    numbers = np.ma.filled(np.ma.asarray(value, dtype=float), np.nan)
    known = np.nan_to_num(numbers).ravel()
    if known.size <= 4:
        return f"({', '.join(f'{each:.4g}' for each in numbers.ravel())})"
    order = known @ np.arange(1, known.size + 1) / known.size  # depends on the order
    return f"{numbers.shape} {known.mean():.4g} {known.std():.4g} {order:.4g}"
