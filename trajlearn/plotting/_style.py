"""Colours and lines that can be told apart in grey and by colour-blind readers."""

from typing import TYPE_CHECKING, Any

from trajlearn.trajectories._extras import import_extra

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["GREY", "INK", "axes_or_new", "line_style", "pyplot", "tidy"]

# Okabe and Ito's palette (2008), less yellow, which is too light for a line
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_DASHES: tuple[Any, ...] = (
    "solid",
    (0, (5, 1.5)),
    (0, (1, 1)),
    (0, (6, 1.5, 1, 1.5)),
    (0, (3, 1, 1, 1, 1, 1)),
)
INK, GREY = "#222222", "#777777"


def line_style(i: int) -> dict[str, Any]:
    """Colour and dashes of the i-th curve; 30 curves differ."""
    return {"color": _COLOURS[i % len(_COLOURS)], "linestyle": _DASHES[i % len(_DASHES)]}


def pyplot(by: str) -> Any:
    """`matplotlib.pyplot`, or an ImportError that names the extra to install."""
    return import_extra("matplotlib.pyplot", "plot", by=by)


def axes_or_new(ax: "Axes | None", by: str, size: tuple[float, float]) -> "Axes":
    """`ax`, or the axes of a new figure."""
    plt = pyplot(by)
    return plt.subplots(figsize=size, layout="constrained")[1] if ax is None else ax


def tidy(ax: "Axes") -> None:
    """Leave out what carries nothing: the frame on two sides."""
    ax.spines[["top", "right"]].set_visible(False)
