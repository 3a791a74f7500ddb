"""One picture of a region: imagery, buildings and a ratio map side by side, for a README or a first look."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rasterio.enums import Resampling
from scipy import ndimage

from brmgeo.codes import BUILDING, UNKNOWN
from brmgeo.errors import InputError
from brmgeo.extras import extra
from brmgeo.files import whole_file
from brmgeo.geo.crs import crs_name
from brmgeo.geo.grid import Bounds
from brmgeo.geo.raster import opened

with extra("maps", "a picture of the maps"):
    from matplotlib import colormaps, font_manager, rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import FuncNorm, to_rgb
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch, Polygon, Rectangle

WIDTH_PX, DPI = 1600, 100
INK, PAPER, FAINT = "#1d2430", "#ffffff", "#5d6777"
LEFT, RIGHT, PANEL_W = (
    0.04,
    0.503,
    0.44,
)  # where the panels begin, and how wide they are, as shares of the width
TOP_PX, BOTTOM_PX = 92, 104
GROUND, ROOF, NOT_KNOWN = "#e9ebe4", "#ff5436", "#b9c0ca"
# Titles and attributions may be Korean; the first font that has a sign draws it.
FONTS = (
    "DejaVu Sans",
    "Noto Sans CJK KR",
    "Noto Sans CJK JP",
    "NanumGothic",
    "Malgun Gothic",
    "Apple SD Gothic Neo",
)


def write_preview(
    path: Path,
    *,
    buildings: Path,
    ratio: Path,
    imagery: Path | None = None,
    title: str,
    attribution: str = "",
    band: int = 1,
) -> Path:
    """A picture (PNG, 1600 px wide) of a region's maps, written to ``path`` and returned.

    Left the imagery with the buildings over it (plain ground where there is no imagery), right band ``band`` of the
    ratio map with its colour bar; scale bar, north arrow, legend, coordinates and CRS. The rasters are on one lattice.
    They are read through their overviews near the picture's own size, so memory does not grow with the region.

    Raises InputError when a raster cannot be read.
    """
    with opened(buildings) as src:
        b, crs, full = src.bounds, crs_name(src.crs.to_wkt()), src.shape
    bounds = (b.left, b.bottom, b.right, b.top)
    page = _page(bounds)
    scale = max(full[0] / page.panel_h_px, full[1] / page.panel_px, 1.0)
    shape = (max(round(full[0] / scale), 1), max(round(full[1] / scale), 1))

    # Several mask pixels to one of the picture, or houses would come and go with the sampling.
    finer = min(3, math.floor(scale))
    mask = _decimated(buildings, [1], (finer * shape[0], finer * shape[1]), Resampling.nearest)[0].data
    shares, radius = _ratio(ratio, band, shape)
    with rc_context(
        {"font.family": _fonts(), "font.size": 10, "text.color": INK, "axes.unicode_minus": False}
    ):
        figure = Figure(figsize=(WIDTH_PX / DPI, page.height_px / DPI), dpi=DPI, facecolor=PAPER)
        FigureCanvasAgg(figure)
        extent = (b.left, b.right, b.bottom, b.top)
        left, right = (figure.add_axes(page.box(x)) for x in (LEFT, RIGHT))
        left.imshow(_with_buildings(mask, finer, imagery), extent=extent, interpolation="nearest")
        # Square root: countryside lives below a tenth, and the scale still ends at 1 so that regions compare.
        norm = FuncNorm((np.sqrt, np.square), vmin=0.0, vmax=1.0)
        colours = colormaps["viridis"].with_extremes(bad=NOT_KNOWN)
        picture = right.imshow(shares, extent=extent, norm=norm, cmap=colours, interpolation="nearest")
        for axes in (left, right):
            _frame(axes, extent)
        right.tick_params(labelleft=False)
        _heading(left, "Imagery and buildings" if imagery is not None else "Buildings", page)
        within = f" within {radius:.4g} m" if radius is not None else f", band {band}"
        _heading(right, f"Share of building{within}", page)
        _scale_bar(left, extent)
        _north(left, page)
        _legend(left, mask, _strength(imagery), page.panel_h_px)
        _colour_bar(figure, picture, page)
        _captions(figure, page, title, crs, bounds, attribution)
        with whole_file(path) as scratch, warnings.catch_warnings():
            # Without any Korean font the signs become boxes, which is no reason to have no picture.
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            figure.savefig(scratch, dpi=DPI, metadata={"Software": None}, format="png")
    return path


@dataclass(frozen=True, slots=True)
class _Page:
    """Sizes of the picture and of its two panels, pixels."""

    panel_px: int
    panel_h_px: int

    @property
    def height_px(self) -> int:
        return TOP_PX + self.panel_h_px + BOTTOM_PX

    def box(self, x: float) -> tuple[float, float, float, float]:
        """(left, bottom, width, height) of the panel that begins at ``x``, as shares of the picture."""
        return (x, BOTTOM_PX / self.height_px, PANEL_W, self.panel_h_px / self.height_px)


def _page(bounds: Bounds) -> _Page:
    aspect = (bounds[3] - bounds[1]) / (bounds[2] - bounds[0])
    panel_px = round(WIDTH_PX * PANEL_W)
    # Long strips would make a picture of any height: beyond these the panel is letterboxed.
    return _Page(panel_px, round(panel_px * min(max(aspect, 0.45), 1.6)))


def _heading(axes: Any, text: str, page: _Page) -> None:
    above = 1 + 12 / page.panel_h_px
    axes.text(0, above, text, transform=axes.transAxes, fontsize=11.5, fontweight="bold", color=INK)


def _colour_bar(figure: Any, picture: Any, page: _Page) -> None:
    _, bottom, _, height = page.box(RIGHT)
    bar = figure.add_axes((RIGHT + PANEL_W + 0.008, bottom, 0.009, height))
    colour_bar = figure.colorbar(picture, cax=bar, ticks=[0, 0.01, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0])
    colour_bar.ax.set_yticklabels(
        ["0", "1 %", "5 %", "10 %", "20 %", "40 %", "60 %", "80 %", "100 %"], fontsize=8
    )
    colour_bar.outline.set_edgecolor("#c3c9d1")
    bar.tick_params(length=2, color=FAINT, labelcolor=FAINT, pad=2)


def _captions(figure: Any, page: _Page, title: str, crs: str, bounds: Bounds, attribution: str) -> None:
    """Title, CRS and size above the panels, the attribution below."""
    above = 1 - 42 / page.height_px
    figure.text(LEFT, above, title, fontsize=19, fontweight="bold", va="baseline")
    size = f"{(bounds[2] - bounds[0]) / 1000:.2f} x {(bounds[3] - bounds[1]) / 1000:.2f} km"
    figure.text(0.515 + PANEL_W, above, f"{crs}, {size}", fontsize=10, color=FAINT, ha="right")
    figure.text(LEFT, 22 / page.height_px, attribution, fontsize=8.5, color=FAINT)


def _decimated(path: Path, bands: list[int], shape: tuple[int, int], resampling: Resampling) -> Any:
    """(bands, rows, cols) masked array of a whole raster brought to ``shape``, read through its overviews."""
    with opened(path) as src:
        return src.read(bands, out_shape=(len(bands), *shape), resampling=resampling, masked=True)


def _ratio(path: Path, band: int, shape: tuple[int, int]) -> tuple[NDArray[np.float64], float | None]:
    """One band as shares in [0, 1], NaN where unknown, and its radius in metres where the band tells it."""
    with opened(path) as src:
        if not 1 <= band <= src.count:
            raise InputError(f"{path}: band {band} was asked for, it has {src.count}; choose one of those")
        scale, offset, radius = src.scales[band - 1], src.offsets[band - 1], src.tags(band).get("radius_m")
    stored = _decimated(path, [band], shape, Resampling.average)[0]
    shares = np.asarray(np.ma.filled(stored.astype(np.float64) * scale + offset, np.nan), dtype=np.float64)
    shares = np.asarray(np.clip(shares, 0.0, 1.0))
    return shares, None if radius is None else float(radius)


def _strength(imagery: Path | None) -> float:
    """How much of a roof the tint covers: on imagery the roof shines through."""
    return 1.0 if imagery is None else 0.45


def _with_buildings(mask: NDArray[np.uint8], finer: int, imagery: Path | None) -> NDArray[np.float64]:
    """(rows, cols, 3) in [0, 1]: the ground, buildings tinted and outlined, unknown ground washed out.

    ``mask`` has ``finer`` x ``finer`` pixels to one of the picture.
    """
    rows, cols = mask.shape[0] // finer, mask.shape[1] // finer
    ground = np.full((rows, cols, 3), to_rgb(GROUND if imagery is None else NOT_KNOWN))
    if imagery is not None:
        with opened(imagery) as src:
            bands = [1, 2, 3] if src.count >= 3 else [1, 1, 1]
        pixels = _decimated(imagery, bands, (rows, cols), Resampling.average)
        seen = ~np.ma.getmaskarray(pixels).any(axis=0)
        ground[seen] = np.moveaxis(pixels.data, 0, -1)[seen] / 255.0

    def share(of: NDArray[np.bool_]) -> NDArray[np.float64]:
        return np.asarray(of.reshape(rows, finer, cols, finer).mean(axis=(1, 3))[..., None], dtype=np.float64)

    building = mask == BUILDING
    inner = ndimage.binary_erosion(building, iterations=finer, border_value=1)
    tint, grey = np.array(to_rgb(ROOF)), np.array(to_rgb(NOT_KNOWN))
    opacity = _strength(imagery) * share(inner) + 0.9 * share(building & ~inner)
    ground = (1.0 - opacity) * ground + opacity * tint
    washed = 0.6 * share(mask == UNKNOWN)
    picture: NDArray[np.float64] = (1.0 - washed) * ground + washed * grey
    return picture


def _frame(axes: Any, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, top = extent
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_facecolor(PAPER)
    step = _nice((right - left) / 3.5)
    axes.set_xticks(np.arange(math.ceil(left / step), right / step) * step)
    axes.set_yticks(np.arange(math.ceil(bottom / step), top / step) * step)
    axes.ticklabel_format(style="plain", useOffset=False)
    axes.tick_params(length=3, color=FAINT, labelcolor=FAINT, labelsize=8)
    for label in axes.get_yticklabels():
        label.update({"rotation": 90, "va": "center"})
    for spine in axes.spines.values():
        spine.set_edgecolor("#c3c9d1")


def _nice(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(f for f in (1, 2, 5) if f * power <= value * (1 + 1e-9)) * power)


def _scale_bar(axes: Any, extent: tuple[float, float, float, float]) -> None:
    left, right, bottom, _ = extent
    length = _nice((right - left) / 4)
    unit = (right - left) / 700
    x, y, thick = left + 22 * unit, bottom + 24 * unit, 6 * unit
    axes.add_patch(
        Rectangle(
            (x - 10 * unit, y - 12 * unit), length + 20 * unit, 42 * unit, color=PAPER, alpha=0.82, lw=0
        )
    )
    for i in range(4):
        colour = INK if i % 2 == 0 else PAPER
        axes.add_patch(
            Rectangle((x + i * length / 4, y), length / 4, thick, facecolor=colour, edgecolor=INK, lw=0.8)
        )
    text = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    axes.text(x + length / 2, y + thick + 5 * unit, text, ha="center", va="bottom", fontsize=9)


def _north(axes: Any, page: _Page) -> None:
    w, h = page.panel_px, page.panel_h_px
    box = axes.inset_axes((1 - 62 / w, 1 - 86 / h, 50 / w, 74 / h))
    box.set_axis_off()
    box.set_xlim(-1, 1)
    box.set_ylim(-1, 1.6)
    box.add_patch(Rectangle((-1, -1), 2, 2.6, color=PAPER, alpha=0.82, lw=0))
    box.add_patch(
        Polygon([(0, 0.75), (-0.45, -0.75), (0, -0.4)], closed=True, facecolor=INK, edgecolor=INK, lw=0.8)
    )
    box.add_patch(
        Polygon([(0, 0.75), (0.45, -0.75), (0, -0.4)], closed=True, facecolor=PAPER, edgecolor=INK, lw=0.8)
    )
    box.text(0, 0.8, "N", ha="center", va="bottom", fontsize=8.5, fontweight="bold")


def _legend(axes: Any, mask: NDArray[np.uint8], strength: float, panel_h_px: int) -> None:
    entries = [Patch(facecolor=(*to_rgb(ROOF), strength), edgecolor=ROOF, label="Building")]
    if (mask == UNKNOWN).any():
        entries.append(Patch(facecolor=NOT_KNOWN, edgecolor=NOT_KNOWN, label="Unknown: no sheet here"))
    axes.legend(
        handles=entries,
        loc="upper left",
        bbox_to_anchor=(0.0, -30 / panel_h_px),
        ncols=2,
        frameon=False,
        fontsize=9,
        handlelength=1.4,
        borderaxespad=0.0,
        borderpad=0.0,
    )


def _fonts() -> list[str]:
    installed = {font.name for font in font_manager.fontManager.ttflist}
    return [name for name in FONTS if name in installed] or ["sans-serif"]
