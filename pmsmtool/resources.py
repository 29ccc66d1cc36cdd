# SPDX-License-Identifier: MIT
"""Folders of the installation and of the user, found the same way from a wheel and from a checkout."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Literal

from pmsmtool.errors import ConfigError, PmsmtoolError

DataFolder = Literal["profiles", "firmware-params"]

_PACKAGE = Path(__file__).parent
ELSEWHERE = "check your rights there and the space on the disk; PMSMTOOL_HOME names another folder"
"""Next step where the user's folder cannot be written."""
USER_ROOM = 1 << 20
"""Bytes that the user's folder must take before anything moves: a journal with tables has 0.1 MB."""
BUNDLE = "_data"
"""Folder inside the installed package that the wheel fills; a checkout has none."""


def data_folder(name: DataFolder) -> Path:
    """Return the folder of the machine profiles or of the firmware parameter maps.

    A wheel carries them inside the package, a checkout (also one installed with ``pip install -e``) at its top.

    Raises PmsmtoolError: the folder is in neither place.
    """
    bundled = _PACKAGE / BUNDLE / name
    if bundled.is_dir():
        return bundled
    checkout = _PACKAGE.parent / name
    if checkout.is_dir() and (_PACKAGE.parent / "pyproject.toml").is_file():
        return checkout
    raise PmsmtoolError(
        f"the folder {name} is missing",
        where=str(bundled),
        likely="the installation is damaged",
        hint="install pmsmtool again",
    )


def user_folder() -> Path:
    """Return the folder for what must outlive a run: journals, crash reports; not created here.

    ``PMSMTOOL_HOME`` if set, else the platform's place for application data.

    Raises ConfigError: the user has no home folder (a container with a bare user number).
    """
    chosen = os.environ.get("PMSMTOOL_HOME")
    if chosen:
        return Path(chosen)
    try:
        home = Path.home()
    except RuntimeError as error:
        raise ConfigError("this user has no home folder", hint="set PMSMTOOL_HOME to a folder") from error
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local") / "pmsmtool"
    if sys.platform == "darwin":
        return home / "Library" / "Application Support" / "pmsmtool"
    return Path(os.environ.get("XDG_DATA_HOME") or home / ".local" / "share") / "pmsmtool"
