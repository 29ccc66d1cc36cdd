# SPDX-License-Identifier: MIT
"""Files a command writes, and the run directory or file it is given."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pmsmtool.errors import ConfigError
from pmsmtool.files import write_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def make_folder(path: Path) -> None:
    """Make a folder and those above it; raises ``ConfigError`` when that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from None


def save_figure(figure: Figure, path: Path) -> None:
    """Save a figure in the format of the suffix, the same bytes for the same figure.

    Raises
    ------
    ConfigError
        A suffix matplotlib does not know, or a file that cannot be written.
    """
    import io

    import matplotlib

    suffix = figure_format(path)
    if figure.get_layout_engine() is None:
        figure.set_layout_engine("constrained")  # laid out before, for the fonts of a page
    out = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "pmsmtool", "svg.fonttype": "path"}):
        figure.savefig(out, format=suffix, metadata=_FIGURE_METADATA[suffix])
    write_file(path, out.getvalue())


_FIGURE_METADATA: dict[str, dict[str, None]] = {
    "svg": {"Date": None},
    "png": {"Software": None},
    "pdf": {"CreationDate": None},
}


def figure_format(path: Path) -> str:
    """Return the format that the suffix of a figure asks for; raises ``ConfigError`` when there is none."""
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in _FIGURE_METADATA:
        raise ConfigError(f"{path.name} has no figure format", where=str(path), hint="use .svg, .png or .pdf")
    return suffix


def inside(path: Path, name: str) -> Path:
    """Return a file, or the file of that name in a run directory."""
    return path / name if path.is_dir() else path


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"cannot be written: {error.strerror}", where=str(path), hint="choose another folder")
