# SPDX-License-Identifier: Apache-2.0
"""Matplotlib figures that need no display: made here, and written as whole files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from paul_ros.errors import PictureError
from paul_ros.extras import require
from paul_ros.files import write_atomically

#: Suffix -> metadata without date and version, so that an equal figure gives an equal file.
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None},
    ".pdf": {"CreationDate": None},
}


def new_figure(width: float, height: float, extra: str = "bags", **options: Any) -> Any:
    """Return a matplotlib figure.

    Args:
        width: inches.
        height: inches.
        extra: extra of this package that installs matplotlib for the caller, for the error.
        options: more options of matplotlib's Figure; the default layout is 'constrained'.

    Raises:
        MissingPackageError: matplotlib is not installed.
    """
    require(extra, "matplotlib.figure")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", **options})
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: str | Path, dpi: int = 110) -> None:
    """Write a figure atomically, in the format of the suffix (.png, .svg, .pdf).

    Raises:
        PictureError: matplotlib cannot write this format.
    """
    suffix = Path(path).suffix
    buffer = io.BytesIO()
    try:
        figure.savefig(buffer, format=suffix.lstrip(".") or "png", dpi=dpi, metadata=_METADATA.get(suffix, {}))
    except ValueError as error:
        raise PictureError(f"{path}: {error}") from error
    write_atomically(path, buffer.getvalue())
