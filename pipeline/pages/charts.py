"""Charts as inline SVG that takes the page's colours and font."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from pipeline.artifacts.cameras import Camera
from pipeline.pages.directions import Similarity, frustum, scene_frame
from pipeline.pages.remembered import remembered

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = npt.NDArray[np.float64]

#: Colours by role; those that stand for the page's own are replaced in the SVG.
INK, FAINT = "#010203", "#040506"
PAGE_COLORS = {INK: "currentColor", FAINT: "var(--line)"}
#: Series colours that tell apart for the colour-blind (Okabe and Ito), on light and dark pages.
SERIES = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#8a8a8a")
#: Letters of a line of a method's name in a legend, and of a photograph's name beside a matrix.
WIDEST_NAME, WIDEST_PHOTO = 22, 16
#: Ratio of largest to least value from which on a logarithmic axis has enough ticks.
WIDE_RANGE = 20
#: Pixels along the long side of the picture of the points under the cameras.
CLOUD_PIXELS = 520


@dataclass(frozen=True)
class Chart:
    """A chart on the page.

    Attributes:
        svg: the whole `<svg>` element.
        alt: what it shows, in words.
        caption: beneath it.
    """

    macro: ClassVar[str] = "plot"
    svg: str
    alt: str
    caption: str = ""


STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "dentalsplat",
    "font.size": 11.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.titlesize": 11.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "legend.frameon": False,
    "legend.fontsize": 10.0,
    "axes.linewidth": 0.8,
}


def draw(
    paint: Callable[[Axes], Any], alt: str, caption: str = "",
    size: tuple[float, float] = (5.2, 3.3),
) -> Chart:  # fmt: skip
    """Make a chart.

    Args:
        paint: draws into the axes.
        alt: what it shows.
        caption: beneath it.
        size: (width, height) in inches of 72 units.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE), warnings.catch_warnings():
        # a name in letters that its own font lacks is drawn by the browser, in the page's
        warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from font")
        figure = Figure(figsize=size, layout="constrained")
        figure.patch.set_alpha(0)
        axes = figure.add_subplot()
        axes.patch.set_alpha(0)
        paint(axes)
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, dpi=110)
    return Chart(_for_the_page(stream.getvalue(), alt), alt, caption)


def _plain(text: str) -> str:
    """A text as matplotlib shows it as it is: between two dollar signs it would read formulas."""
    return text.replace("$", r"\$")


def _broken(name: str) -> str:
    """A name on two lines at most."""
    return fill(_plain(name), WIDEST_NAME, max_lines=2, placeholder=" …")


def _ends(name: str) -> str:
    """Beginning and end of a name; where it is too long, what is between them is left out."""
    half = WIDEST_PHOTO // 2
    return _plain(name if len(name) <= WIDEST_PHOTO else f"{name[: half - 1]}…{name[-half:]}")


def _for_the_page(text: str, alt: str) -> str:
    from markupsafe import escape

    svg = text[text.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S)
    svg = re.sub(r"font: ([\d.]+px) [^;\"]*", r"font: \1 var(--sans)", svg)
    for color, page_color in PAGE_COLORS.items():
        svg = svg.replace(color, page_color)
    # Several charts share a page: what others may not refer to needs no id.
    used = set(re.findall(r"(?:url\(#|href=\"#)([\w-]+)", svg))
    svg = re.sub(
        r' id="([\w-]+)"', lambda found: found[0] if found[1] in used else "", svg
    )  # fmt: skip
    head = re.compile(r"<svg[^>]*>").search(svg)
    assert head is not None
    box = re.search(r'viewBox="([^"]+)"', head[0])
    assert box is not None
    widest = 1.25 * float(box[1].split()[2])
    opening = (
        f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" xmlns="http://www.w3.org/2000/svg" '
        f'class="chart" viewBox="{box[1]}" style="max-width: {widest:.0f}px" '
        f'role="img" aria-label="{escape(alt)}">'
    )
    return opening + svg[head.end() :]


@remembered
def match_matrix(names: Sequence[str], table: Mapping[tuple[int, int], int]) -> Chart:
    """Verified matches of every pair of views.

    Args:
        names: of the views.
        table: pair of positions -> count.
    """
    count = len(names)
    counts = np.full((count, count), np.nan)
    for (i, j), value in table.items():
        counts[i, j] = counts[j, i] = value

    shown_names = [_ends(name) for name in names]
    upright = count > 6 or max(map(len, names), default=0) > 4

    def paint(axes: Axes) -> None:
        axes.grid(visible=False)
        shown = np.log10(np.maximum(counts, 0) + 1)
        axes.imshow(shown, cmap="YlGnBu", vmin=0, vmax=max(1.0, np.nanmax(shown, initial=0)))
        axes.set_xticks(range(count), shown_names, rotation=90 if upright else 0)
        axes.set_yticks(range(count), shown_names)
        axes.tick_params(length=0, labelsize=10 if count <= 14 else 7)
        if count <= 14:
            middle = 0.55 * max(1.0, float(np.nanmax(shown, initial=0)))
            for i, j in np.argwhere(np.isfinite(counts)):
                color = "white" if shown[i, j] > middle else "black"
                axes.text(
                    j, i, f"{counts[i, j]:.0f}", ha="center", va="center", color=color,
                    fontsize=9 if count <= 8 else 7,
                )  # fmt: skip

    side = min(5.2, 2.4 + 0.25 * count)
    best = ", ".join(
        f"{names[i]} and {names[j]}: {value}"
        for (i, j), value in sorted(table.items(), key=lambda item: (-item[1], item[0]))[:3]
    )
    return draw(
        paint, f"Matrix of verified matches for each pair of photographs. Most: {best}.",
        "Verified matches of each pair (colour: logarithm). Empty: not compared.", (side, side),
    )  # fmt: skip


@remembered
def camera_plot(
    series: Sequence[tuple[str, Sequence[Camera], Similarity | None]],
    points: npt.NDArray[np.floating], colors: npt.NDArray[np.floating], axis: str,
) -> Chart:  # fmt: skip
    """Cameras as pyramids around the points, seen from above or from in front.

    Args:
        series: (name of the stage, its cameras, what brings them into the last one's world); the
            last is drawn boldest, with names.
        points: [N, 3] in the last one's world; none: cameras alone are drawn.
        colors: [N, 3] in 0..1.
        axis: ``"top"`` or ``"front"``.
    """
    cameras = series[-1][1]
    frame = scene_frame(cameras)
    places = np.array([camera.centre for camera in cameras]).reshape(-1, 3)
    around = points if len(points) else places
    centre = np.median(around, axis=0) if len(around) else np.zeros(3)
    rows = frame[[0, 2]] if axis == "top" else frame[[0, 1]]

    def flat(world: npt.NDArray[np.floating]) -> Array:
        return np.asarray((np.asarray(world, np.float64) - centre) @ rows.T)

    distances = np.linalg.norm(places - centre, axis=1)
    # Of cameras alone the farthest from their middle is about as far as a scene would be.
    far = float(np.median(distances) if len(points) else distances.max(initial=0.0))
    depth = 0.12 * far or 1.0
    behind = scene_frame(cameras)[1 if axis == "top" else 2]
    near_last = np.argsort(-((np.asarray(points, np.float64) - centre) @ behind), kind="stable")

    def paint(axes: Axes) -> None:
        if len(points):
            cloud, extent = flat_cloud(flat(points[near_last]), colors[near_last])
            axes.imshow(cloud, extent=extent, origin="lower", interpolation="nearest")
        for number, (name, several, onto) in enumerate(series):
            last = number == len(series) - 1
            color = SERIES[(len(series) - 1 - number) % len(SERIES)]
            for position, camera in enumerate(several):
                corners = flat(frustum(camera, onto, depth))
                path = corners[[0, 1, 2, 0, 3, 4, 0, 1, 4, 3, 2]]
                axes.plot(
                    path[:, 0], path[:, 1], color=color, lw=1.4 if last else 0.9,
                    ls="-" if last else (0, (3, 2)), label=_plain(name) if position == 0 else None,
                    solid_joinstyle="round",
                )  # fmt: skip
                if last and len(several) <= 30:
                    away = corners[0] - corners[1:].mean(0)
                    away = away / max(float(np.linalg.norm(away)), 1e-12) * depth * 0.5
                    x, y = corners[0] + away
                    axes.text(
                        x, y, _ends(camera.name), ha="center", va="center", fontsize=9,
                        color=color,
                    )  # fmt: skip
        axes.use_sticky_edges = False
        axes.margins(0.06)
        axes.set_aspect("equal", adjustable="datalim")
        if axis == "front":
            axes.invert_yaxis()
        axes.set_xticklabels([])
        axes.set_yticklabels([])
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        if len(series) > 1:
            axes.legend(loc="upper left")

    where = "above" if axis == "top" else "in front"
    return draw(
        paint,
        f"{len(cameras)} cameras drawn as pyramids around the points, seen from {where}.",
        f"Seen from {where}. Pyramids open towards what the camera sees.", (5.2, 3.9),
    )  # fmt: skip


def flat_cloud(
    spots: Array, colors: npt.NDArray[np.floating]
) -> tuple[npt.NDArray[np.uint8], tuple[float, float, float, float]]:
    """Points [N, 2] with colours [N, 3], later ones on top, as a picture with holes.

    Returns:
        ([H, W, 4] uint8, row 0 at the least y; (left, right, bottom, top) of it).
    """
    low, high = np.percentile(spots, 0.5, axis=0), np.percentile(spots, 99.5, axis=0)
    size = max(float((high - low).max()), 1e-9)
    cells = np.floor((spots - low) / size * CLOUD_PIXELS).astype(np.int64)
    width, height = (np.ceil((high - low) / size * CLOUD_PIXELS).astype(int) + 1).tolist()
    inside = (cells >= 0).all(1) & (cells < (width, height)).all(1)
    picture = np.zeros((height, width, 4), np.uint8)
    rgb = np.rint(np.clip(colors, 0, 1) * 255).astype(np.uint8)
    picture[cells[inside, 1], cells[inside, 0], :3] = rgb[inside]
    picture[cells[inside, 1], cells[inside, 0], 3] = 255
    pixel = size / CLOUD_PIXELS
    left, bottom = low.tolist()
    return picture, (left, left + width * pixel, bottom, bottom + height * pixel)


@remembered
def line_chart(
    x: Sequence[float], lines: Mapping[str, Sequence[float]], labels: tuple[str, str],
    alt: str, *, log: bool = False,
) -> Chart:  # fmt: skip
    """One or several curves over the same x.

    Args:
        labels: of the two axes.
        log: logarithmic y axis where values spread far.
    """

    def paint(axes: Axes) -> None:
        for number, (name, values) in enumerate(lines.items()):
            axes.plot(x, values, color=SERIES[number % len(SERIES)], lw=1.8, label=_plain(name))
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        every = [value for values in lines.values() for value in values]
        if log:
            _log_if_wide(axes, every)
        if len(lines) > 1:
            axes.legend()

    return draw(paint, alt)


def _log_if_wide(axes: Axes, values: Sequence[float]) -> None:
    """A logarithmic y axis where the values spread far enough for several ticks on it."""
    if values and min(values) > 0 and max(values) > WIDE_RANGE * min(values):
        axes.set_yscale("log")


def series_chart(
    series: Mapping[str, Mapping[float, float]], labels: tuple[str, str], alt: str,
    caption: str = "", dashed: Mapping[str, Mapping[float, float]] | None = None,
    log: bool = False,
) -> Chart:  # fmt: skip
    """Points joined by lines, one colour per name; `dashed` shares the colours of equal names.

    Args:
        series: name -> {x: y}.
        dashed: the same, to compare with.
    """
    names = [*series, *(name for name in dashed or {} if name not in series)]
    color = {name: SERIES[number % len(SERIES)] for number, name in enumerate(names)}
    marks = "osD^vPX"

    def paint(axes: Axes) -> None:
        for style, those in (("-", series), ((0, (4, 3)), dashed or {})):
            for name, values in those.items():
                x = sorted(values)
                axes.plot(
                    x, [values[k] for k in x], ls=style, color=color[name], lw=1.6, ms=5,
                    marker=marks[names.index(name) % len(marks)],
                    markerfacecolor=color[name] if style == "-" else "none",
                    label=_broken(name) if style == "-" or name not in series else None,
                )  # fmt: skip
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        every = [y for those in (series, dashed or {}) for v in those.values() for y in v.values()]
        if log:
            _log_if_wide(axes, every)
        axes.set_xticks(
            sorted({k for those in (series, dashed or {}) for v in those.values() for k in v})
        )
        figure = axes.get_figure(root=True)
        assert figure is not None
        figure.legend(loc="outside lower center", ncols=2)

    return draw(paint, alt, caption, (5.2, 4.2))


@dataclass(frozen=True)
class Bar:
    """A name with its value and one to compare with."""

    name: str
    value: float | None
    other: float | None = None


def bar_chart(bars: Sequence[Bar], label: str, alt: str, caption: str = "") -> Chart:
    """Horizontal bars; what they are compared with stands behind them as an outline."""

    def paint(axes: Axes) -> None:
        for row, bar in enumerate(bars):
            if bar.value is not None:
                axes.barh(row, bar.value, height=0.55, color=SERIES[0])
                axes.annotate(
                    f"{bar.value:.4g}", (bar.value, row), (4, 0), textcoords="offset points",
                    va="center", fontsize=9,
                )  # fmt: skip
            else:
                axes.annotate("failed", (0, row), (4, 0), textcoords="offset points", va="center")
            if bar.other is not None:
                axes.plot([bar.other] * 2, [row - 0.42, row + 0.42], color=SERIES[1], lw=3)
        axes.set_yticks(range(len(bars)), [_broken(bar.name) for bar in bars])
        axes.set_ylim(len(bars) - 0.4, -0.6)
        axes.set_xlabel(label)
        axes.grid(visible=False, axis="y")
        axes.margins(x=0.14)

    return draw(paint, alt, caption, (5.2, 0.9 + 0.42 * len(bars)))
