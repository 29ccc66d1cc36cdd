# SPDX-License-Identifier: MIT
"""The machine files that ship with the package, and how a machine is named: a file, a run directory or a profile."""

from __future__ import annotations

from pathlib import Path

from pmsmtool.errors import ConfigError
from pmsmtool.files import near_names
from pmsmtool.resources import data_folder

NAMED = "`pmsmtool sim list` names the profiles, `pmsmtool machine new` writes a file from a data sheet"
"""Next step where a machine is not found."""


def profile_names() -> list[str]:
    """Return the names of the profiles that ship with the package."""
    return sorted(path.stem for path in data_folder("profiles").glob("*.toml"))


def machine_path(source: str | Path) -> Path:
    """Return the machine file of a path, a run directory or a profile name; a path that ends in .toml may be missing.

    Raises ConfigError: there is neither such a file nor such a profile.
    """
    path = Path(source)
    if path.suffix == ".toml" or path.is_file():
        return path
    if (path / "machine.toml").is_file():
        return path / "machine.toml"
    profile = data_folder("profiles") / f"{source}.toml"
    if profile.is_file():
        return profile
    if path.is_dir():
        raise ConfigError(
            "there is no machine.toml in this folder",
            where=str(path),
            hint="give the machine file itself, a run directory of identify or commission, or the name of a profile",
        )
    from difflib import get_close_matches

    near = get_close_matches(str(source).lower(), profile_names(), 3)
    raise ConfigError(
        f"no profile and no file is named {str(source)!r}",
        likely=f"did you mean {' or '.join(near)}?" if near else near_names(path),
        hint=NAMED,
    )
