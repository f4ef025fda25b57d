"""Figures without matplotlib's global state, so that they work in threads and without a display.

matplotlib is imported with the first figure, because the import takes a second and the extra is optional.
"""

from __future__ import annotations

import importlib.util
import io
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tflane_jax.errors import UserError, install, missing_extra
from tflane_jax.files.atomic import replacing
from tflane_jax.plots import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TITLE_WIDTH = 44
"""Characters of a line above a panel of 3.7 inches, of 9 points."""
# On a side of a picture: matplotlib's limit.
_MOST_PIXELS = 2**16


def can_draw() -> bool:
    """Return whether matplotlib is installed; where it is not, say so in a line that names the extra."""
    if importlib.util.find_spec("matplotlib") is not None:
        return True
    print(f"no pictures, which need matplotlib: {install('plot')}", file=sys.stderr)
    return False


def new_figure(
    rows: int = 1, columns: int = 1, *, panel: tuple[float, float] = (4.0, 3.0), footer: float = 0.0
) -> tuple[Figure, np.ndarray]:
    """Return a figure and its (rows, columns) array of axes.

    Args:
        rows, columns: numbers of panels.
        panel: width and height of one panel, inches.
        footer: additional height for a legend, inches.

    Raises UserError if matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
        from matplotlib.text import Text
    except ImportError as error:
        raise missing_extra("pictures need matplotlib", "plot") from error

    class NotebookFigure(Figure):
        """A figure that a notebook shows when it is the last value of a cell, in 256 colours: half the bytes.

        Texts are drawn as they are, also those with dollar signs: names of files, rows and logs are no formulas.
        """

        def draw(self, renderer: Any) -> None:
            for text in self.findobj(Text):
                if "$" in text.get_text() and r"\mathdefault" not in text.get_text():  # which labels of axes have
                    text.set_parse_math(False)
            with warnings.catch_warnings():
                warnings.filterwarnings("ignore", "Glyph .* missing from font", UserWarning)
                super().draw(renderer)

        def _repr_png_(self) -> bytes:
            from PIL import Image  # matplotlib needs it too

            picture, small = io.BytesIO(), io.BytesIO()
            self.savefig(picture, dpi=90, format="png")
            colours = _in_256_colours(Image.open(picture).convert("RGB"))
            colours.save(small, "png", optimize=True)
            return small.getvalue()

    figure = NotebookFigure((columns * panel[0], rows * panel[1] + footer), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_prop_cycle(color=style.SERIES)
    return figure, axes


def _in_256_colours(picture: Any) -> Any:
    """Return a PIL image with a palette: half of it for the commonest colours, exactly, half to cover the others.

    By default PIL counts pixels, so that the grains of the evidence take nearly all colours, and a legend shows a bus
    in brown; colours that cover all, alone, merge lines of a curve.
    """
    from PIL import Image

    red, green, blue = np.moveaxis(np.asarray(picture, np.uint32), -1, 0)
    found, place, counts = np.unique(red << 16 | green << 8 | blue, return_inverse=True, return_counts=True)
    colours = np.stack([found >> 16, found >> 8 & 255, found & 255], -1).astype(np.float32)
    common = colours[np.argsort(-counts, kind="stable")[:128]]
    covering = picture.quantize(256 - len(common), Image.Quantize.MAXCOVERAGE, kmeans=1).getpalette()
    palette = np.concatenate([common, np.reshape(covering, (-1, 3)).astype(np.float32)])[:256]
    nearest = (np.square(palette).sum(-1) - 2.0 * colours @ palette.T).argmin(-1)  # PIL's own search is rough
    shown = Image.fromarray(nearest.astype(np.uint8)[place].reshape(red.shape))
    shown.putpalette(palette.astype(np.uint8).ravel().tolist())
    return shown


def columns_for(panels: int) -> int:
    """Return the number of columns of a grid of curves: three, or two where the last row would hold a single panel."""
    return min(panels, 2 if panels == 4 else 3)


def save_figure(figure: Figure, path: Path, *, dpi: int = 110) -> Path:
    """Write the figure whole or not at all, in the format of the file's suffix, and return the path.

    Raises UserError where the file cannot be written, matplotlib does not know the format, or the picture is too large.
    """
    path = Path(path)
    kind, known = path.suffix.removeprefix(".").lower() or "png", figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise UserError(f"cannot write {path}: no picture ends in .{kind}; choose .png, .pdf, .svg or .jpg")
    width, height = figure.get_size_inches() * dpi
    if max(width, height) >= _MOST_PIXELS:
        raise UserError(
            f"cannot write {path}: a picture of {width:.0f} x {height:.0f} pixels is too large; ask for fewer panels"
        )
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format=kind)
    return path


def hide_unused(axes: np.ndarray, used: int) -> None:
    """Blank the panels of a grid after the first `used`, in reading order."""
    ax: Axes
    for ax in axes.flat[used:]:
        ax.set_axis_off()
