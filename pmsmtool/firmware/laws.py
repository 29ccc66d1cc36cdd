# SPDX-License-Identifier: MIT
"""Which control laws a parameter set uses, and what of the core an export can leave out without them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pmsmtool.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Law:
    """A control law that can be left out."""

    name: str
    """What people call it."""
    macro: str
    """Its switch in ``pmsm_laws.h``."""
    mode: str
    """Parameter that chooses it."""
    last_without: int
    """Largest value of ``mode`` that does not need it."""
    sources: tuple[str, ...]
    """Files of ``firmware/core`` that only this law needs, and those it shares with others."""

    @property
    def room(self) -> str:
        """Prefix of its parameters."""
        return self.mode.split(".")[0] + "."


LAWS = (
    Law(
        "reference governor",
        "PMSM_LAW_GOVERNOR",
        "governor.mode",
        0,
        (
            "governor.c",
            "governor_observer.c",
            "governor_rows.c",
            "governor_solve.c",
            "half_planes.c",
            "minimum_time.c",
            "projection.c",
        ),
    ),
    Law(
        "field weakening without a table",
        "PMSM_LAW_FIELD_WEAKENING",
        "field_weakening.mode",
        1,
        ("field_weakening.c", "projection.c"),
    ),
    Law("polar control", "PMSM_LAW_POLAR", "polar.mode", 0, ("polar.c", "polar_phase.c", "polar_unified.c", "polar.h")),
)


def laws_in_use(values: Mapping[str, float]) -> tuple[Law, ...]:
    """Return the laws that a set of catalogue values chooses."""
    return tuple(law for law in LAWS if values[law.mode] > law.last_without)


def files_left_out(laws: Iterable[Law]) -> frozenset[str]:
    """Return the files of the core that none of the laws needs."""
    needed = {name for law in laws for name in law.sources}
    return frozenset(name for law in LAWS for name in law.sources) - needed


def with_laws(name: str, text: str, laws: Iterable[Law]) -> str:
    """Return a file of the core as it stands beside these laws alone.

    The switches of the others become 0, and the largest allowed value of their mode the last one that does not need
    them: the image check then refuses a set that would.
    """
    for law in set(LAWS) - set(laws):
        if name == "pmsm_laws.h":
            text = _replaced(text, f"#define {law.macro} 1", f"#define {law.macro} 0", name)
        elif name == "pmsm_params_table.c":
            line = next((line for line in text.splitlines() if line.endswith(f"/* {law.mode} */")), "")
            low = line.split(",")[0]
            narrowed = f"{low}, {law.last_without}.0F, 1u}}, /* {law.mode}: {law.name} is left out */"
            text = _replaced(text, line, narrowed, name)
    return text


def _replaced(text: str, old: str, new: str, where: str) -> str:
    if not old or text.count(old) != 1:
        raise ConfigError(
            f"does not hold {old or 'the bound'!r} once", where=f"core file {where}", hint="reinstall pmsmtool"
        )
    return text.replace(old, new)
