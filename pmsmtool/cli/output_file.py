"""Files a command writes, and the run directory or file it is given."""

from __future__ import annotations

from pathlib import Path

from pmsmtool.errors import ConfigError


def write_file(path: Path, content: bytes | str) -> None:
    """Write a file; raises ``ConfigError`` naming it when that fails."""
    try:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    except OSError as error:
        raise ConfigError(
            f"cannot be written: {error.strerror}", where=str(path), hint="choose another folder"
        ) from None


def inside(path: Path, name: str) -> Path:
    """Return a file, or the file of that name in a run directory."""
    return path / name if path.is_dir() else path
