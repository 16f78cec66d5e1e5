"""`report.html`: one self-contained page that a field engineer reads in two minutes (`templates/report.html`)."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from nsde_torch.diagnosis.pictures import pictures, save_pictures
from nsde_torch.diagnosis.text import rendered
from nsde_torch.whole_files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nsde_torch.diagnosis.content import Content
    from nsde_torch.diagnosis.result import Diagnosis

_DPI = 100  # of the pictures


def write_report(path: Path, found: Diagnosis, content: Content) -> None:
    """Write the page, and its pictures into `plots` beside it.

    Args:
        path: The page.
        found: The diagnosis.
        content: Its content, as `diagnosis.json` has it.
    """
    figures = pictures(found, content)
    save_pictures(figures, path.parent / "plots")
    write_whole(path, page(content, figures, width=found.width))


def page(content: Content, figures: Mapping[str, Figure], *, width: float) -> str:
    """The page as HTML.

    Args:
        content: As `diagnosis.json` has it.
        figures: By name, as `pictures` makes them.
        width: Length of the means in the pictures [s].
    """
    shown = {name: {"alt": f.get_suptitle(), "png": _png(f)} for name, f in figures.items()}
    return rendered("report.html", content, content=content, figures=shown, width=width)


def _png(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return base64.b64encode(buffer.getvalue()).decode("ascii")
