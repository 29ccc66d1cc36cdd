# SPDX-License-Identifier: MIT
"""Generate the C side of the catalogue: ``pmsm_params.h`` (struct) and ``pmsm_params_table.c`` (bounds).

``python -m pmsmtool.firmware.params_header`` rewrites both files in ``firmware/core``; a test compares them with the
catalogue, so they cannot drift apart. The output depends on the catalogue only.
"""

from __future__ import annotations

import struct
import textwrap
from pathlib import Path

from pmsmtool.params.catalogue import (
    CATALOGUE,
    K_MAX_NOT_DETERMINED,
    LUT_CAPACITY_WORDS,
    SCHEMA_VERSION,
    Parameter,
    layout_signature,
)

CORE_DIRECTORY = Path(__file__).parent / "core"
SPDX = "/* SPDX-License-Identifier: MIT */"
"""First line of every C file, shipped or generated."""
BANNER = f"""{SPDX}
/* Generated from pmsmtool/params/catalogue.py by python -m pmsmtool.firmware.params_header: do not edit. */"""
_EXACT_IN_BINARY32 = 1 << 24
_LINE_LENGTH = 120


def c_float(value: float) -> str:
    """Return a binary32 literal that reads back to the same bits (``%.9g``, suffix ``F``)."""
    text = f"{struct.unpack('<f', struct.pack('<f', value))[0]:.9g}"
    return f"{text}F" if any(mark in text for mark in ".e") else f"{text}.0F"


def commented(code: str, text: str) -> str:
    """Return a line of C with a comment behind it, which goes on under itself where the line would get too long."""
    text = text.replace("*/", "* /")
    column = len(code) + 4
    lines = textwrap.wrap(text, _LINE_LENGTH - column - 3) or [""]
    return f"{code} /* " + f"\n{' ' * column}".join(lines) + " */"


def _member(row: Parameter, width: int) -> str:
    kind = "uint32_t" if row.is_integer else "float   "
    unit = "" if row.unit == "1" else f"[{row.unit}] "
    return commented(f"    {kind} {row.c_name + ';':<{width}}", unit + row.meaning)


def header_text() -> str:
    """Return ``pmsm_params.h``."""
    width = max(len(row.c_name) for row in CATALOGUE) + 1
    members = "\n".join(_member(row, width) for row in CATALOGUE)
    return f"""{BANNER}
#ifndef PMSM_PARAMS_H
#define PMSM_PARAMS_H

#include "pmsm_types.h"

#ifdef __cplusplus
extern "C" {{
#endif

#define PMSM_PARAMS_SCHEMA_VERSION {SCHEMA_VERSION}u
#define PMSM_PARAMS_SIGNATURE 0x{layout_signature():08X}u /* CRC-32 of name:type:dim:unit:scale in struct order */
#define PMSM_PARAMS_WORDS {len(CATALOGUE)}u
#define PMSM_PARAMS_LUT_WORDS_MAX {LUT_CAPACITY_WORDS}u
#define PMSM_K_MAX_NOT_DETERMINED {K_MAX_NOT_DETERMINED}u

/* Every member takes four bytes: the little-endian memory image is the packed image. SI units, peak values. */
typedef struct pmsm_params {{
{members}
}} pmsm_params;

typedef char pmsm_params_size_check[(sizeof(pmsm_params) == 4u * PMSM_PARAMS_WORDS) ? 1 : -1];

/* Inclusive bounds of one member; integer bounds are exact in binary32. */
typedef struct {{
    float minimum;
    float maximum;
    uint32_t is_integer;
}} pmsm_param_limit;

extern const pmsm_param_limit pmsm_param_limits[PMSM_PARAMS_WORDS];

#ifdef __cplusplus
}}
#endif

#endif
"""


def _limit(row: Parameter) -> str:
    if row.is_integer and row.maximum > _EXACT_IN_BINARY32:
        raise ValueError(f"{row.name}: integer bound {row.maximum} is not exact in binary32")
    kind = "1u" if row.is_integer else "0u"
    return f"    {{{c_float(row.minimum)}, {c_float(row.maximum)}, {kind}}}, /* {row.name} */"


def table_text() -> str:
    """Return ``pmsm_params_table.c``."""
    rows = "\n".join(_limit(row) for row in CATALOGUE)
    return f"""{BANNER}
#include "pmsm_params.h"

/* {{minimum, maximum, is integer}} in struct order. */
const pmsm_param_limit pmsm_param_limits[PMSM_PARAMS_WORDS] = {{
{rows}
}};
"""


def generated_files() -> dict[str, str]:
    """Return file name -> text of everything generated from the catalogue."""
    return {"pmsm_params.h": header_text(), "pmsm_params_table.c": table_text()}


def main() -> None:
    """Write the generated files."""
    for name, text in generated_files().items():
        (CORE_DIRECTORY / name).write_bytes(text.encode("ascii"))


if __name__ == "__main__":
    main()
