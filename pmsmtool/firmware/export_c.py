# SPDX-License-Identifier: MIT
"""A parameter set as C: a const instance of ``pmsm_params`` with its look-up words, and the core that runs it.

Core and application are those the simulated drive runs (``firmware/core``, ``firmware/application``): every file named
``pmsm_...``, so that none meets one of your program, and laws that the set does not use left out (``firmware/laws``).
The application's files are optional. Beside them ``<prefix>_cfg.h``,
``<prefix>_cfg.c`` and ``<prefix>_cfg.json`` with the same content, ``<prefix>_main.c``, an example that is compiled
only on request, and ``README.md``. Two motors in one program use two prefixes. The text depends on the set only: no
date, no path.

The example that is exported beside the control core: every call of the core around a machine at standstill.
"""

from __future__ import annotations

import json
import re
import struct
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import resources

from pmsmtool.errors import ConfigError
from pmsmtool.firmware.export_readme import readme_text
from pmsmtool.firmware.image import LUT_FORMAT_BINARY32, crc32, saturation_words, unpack_image
from pmsmtool.firmware.laws import LAWS, Law, files_left_out, laws_in_use, with_laws
from pmsmtool.firmware.params_header import SPDX, c_float, commented
from pmsmtool.params.catalogue import CATALOGUE, SCHEMA_VERSION, layout_signature

README, MEMORY = "README.md", "pmsm_memory.c"
CORE_PREFIX = "pmsm_"
"""In front of every file and function of the core, whatever the prefix of the configuration."""

_INCLUDE = re.compile(r'^#include "(\w+\.h)"', re.MULTILINE)
_PREFIX = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,30}\Z")
_WORD = re.compile(r"\w+")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_WORDS_PER_LINE = 6
_BY_APPLICATION = "read by the application alone"
_BY_NONE = "for your program, not read by this code"

FLAGS = (
    "-std=c99 -Wall -Wextra -Wdouble-promotion -Wfloat-conversion -Wshadow -Werror -ffp-contract=off -fno-math-errno"
)
"""Flags the generated code is checked with; contraction off keeps its bits equal to the simulator's."""


def c_files(image: bytes, *, prefix: str = "pmsm", design_id: str = "", all_laws: bool = False) -> dict[str, str]:
    """Return file name -> text of the configuration and of the core.

    Raises ConfigError: if the prefix is no C identifier, or the image is refused.

    Parameters
    ----------
    image : bytes
        Packed image (``firmware.image.pack_image``), the bytes of object 0x2001.
    prefix : str
        C identifier in front of every generated name.
    design_id : str
        Content hash of the design the set came from; printed, not interpreted.
    all_laws : bool
        Keep the laws that the set does not use: for sets that come later, or two motors on one core.
    """
    _check_prefix(prefix)
    values, lut = unpack_image(image)
    laws = LAWS if all_laws else laws_in_use(values)
    files = {
        f"{prefix}_cfg.h": _header(prefix, image, lut, design_id),
        f"{prefix}_cfg.c": _source(prefix, values, lut, laws),
        f"{prefix}_cfg.json": _json(values, image, design_id),
        f"{prefix}_main.c": example_source(prefix),
        **dict(core_files(laws)),
        **dict(application_files()),
        MEMORY: resources.files("pmsmtool.firmware").joinpath("freestanding", MEMORY).read_text(encoding="ascii"),
    }
    return {**files, README: readme_text(values, prefix, image_bytes=len(image), laws=laws, flags=FLAGS)}


def header_file(image: bytes, *, prefix: str = "pmsm", design_id: str = "") -> str:
    """Return the configuration alone as one header: the macros and a ``static const`` instance."""
    _check_prefix(prefix)
    values, lut = unpack_image(image)
    head = _header(prefix, image, lut, design_id)
    instance = _instance(prefix, values, lut, "static const", LAWS)
    declaration = f"extern const {prefix}_cfg_type {prefix}_cfg;\n"
    return head.replace(declaration, instance)


def _check_prefix(prefix: str) -> None:
    if not _PREFIX.match(prefix):
        raise ConfigError(
            f"{prefix!r} cannot be the prefix of C names",
            hint="use letters, digits and underscores, starting with a letter",
        )


def core_files(laws: Iterable[Law] = LAWS) -> Iterator[tuple[str, str]]:
    """Yield (name, text) of the files of the control core with these laws, in name order.

    Names without the core's own prefix get it, in ``#include`` lines, too; nothing else of the text changes but the
    switches of laws that are left out.
    """
    laws = tuple(laws)
    sources = _sources("core")
    for name in sorted(set(sources) - files_left_out(laws), key=_core_name):
        yield _core_name(name), _with_core_names(with_laws(name, sources[name], laws))


def application_files() -> Iterator[tuple[str, str]]:
    """Yield (name, text) of the files of the application around the core, named as the core's are."""
    for name, text in _sources("application").items():
        yield _core_name(name), _with_core_names(text)


def _sources(folder: str) -> dict[str, str]:
    place = resources.files("pmsmtool.firmware").joinpath(folder)
    names = sorted(entry.name for entry in place.iterdir() if entry.name.endswith((".c", ".h")))
    return {name: place.joinpath(name).read_text(encoding="ascii") for name in names}


def _with_core_names(text: str) -> str:
    return _INCLUDE.sub(lambda found: f'#include "{_core_name(found[1])}"', text)


def _core_name(name: str) -> str:
    return name if name.startswith(CORE_PREFIX) else CORE_PREFIX + name


@cache
def not_read_by_core(laws: tuple[Law, ...] = LAWS) -> tuple[str, ...]:
    """Return the parameters that no source of the core with these laws reads.

    Computed from the sources: a declaration and the table of bounds read nothing, nor does a comment.
    """
    return _not_named_in(core_files(laws))


@cache
def not_read() -> tuple[str, ...]:
    """Return the parameters that neither the core, with all laws, nor the application reads."""
    return _not_named_in((*core_files(), *application_files()))


def _not_named_in(files: Iterable[tuple[str, str]]) -> tuple[str, ...]:
    code = "".join(_COMMENT.sub("", text) for name, text in files if not name.startswith("pmsm_params"))
    read = set(_WORD.findall(code))
    return tuple(row.name for row in CATALOGUE if row.c_name not in read)


def _readers() -> dict[str, str]:
    """Return what is to be said of the parameters that the core does not read, with any law."""
    return dict.fromkeys(not_read_by_core(), _BY_APPLICATION) | dict.fromkeys(not_read(), _BY_NONE)


def _banner(prefix: str, name: str, design_id: str) -> str:
    return (
        f"{SPDX}\n/* {prefix}_cfg{name}: generated by pmsmtool export, do not edit.\n"
        f" * design {design_id or 'not named'}, schema {SCHEMA_VERSION}\n"
        f" * checked with\n *     {FLAGS}\n"
        " * gnu99 contracts by default: without -ffp-contract=off the bits differ from the simulator's.\n"
        f"{_listed(_BY_APPLICATION)}{_listed(_BY_NONE)} */\n"
    )


def _listed(reader: str) -> str:
    names = ", ".join(name for name, known in _readers().items() if known == reader)
    return f" * {reader}:\n{textwrap.fill(names, 118, initial_indent=' *     ', subsequent_indent=' *     ')}\n"


def _header(prefix: str, image: bytes, lut: bytes, design_id: str) -> str:
    guard = f"{prefix.upper()}_CFG_H"
    member = f"    uint32_t lut[{len(lut) // 4}];\n" if lut else ""
    lut_macro = f"{prefix}_cfg.lut" if lut else "((const uint32_t *)0)"
    up = prefix.upper()
    return f"""{_banner(prefix, ".h", design_id)}#ifndef {guard}
#define {guard}

#include "pmsm_core.h"

#define {up}_CFG_SCHEMA_VERSION {SCHEMA_VERSION}u
#define {up}_CFG_SIGNATURE 0x{layout_signature():08X}u
#define {up}_CFG_CRC32 0x{crc32(image):08X}u /* over the {len(image)} bytes of {prefix}_cfg, little endian */
#define {up}_CFG_BYTES {len(image)}u
#define {up}_CFG_LUT {lut_macro}

#if {up}_CFG_SCHEMA_VERSION != PMSM_PARAMS_SCHEMA_VERSION
#error "{prefix}_cfg and pmsm_core are of different schema versions: export again"
#endif
#if {up}_CFG_SIGNATURE != PMSM_PARAMS_SIGNATURE
#error "{prefix}_cfg and pmsm_core have different layouts: export again"
#endif

#ifdef __cplusplus
extern "C" {{
#endif

/* Members of four bytes: the memory image is the packed image that the CRC covers. */
typedef struct {{
    pmsm_params params;
{member}}} {prefix}_cfg_type;

typedef char {prefix}_cfg_size_check[(sizeof({prefix}_cfg_type) == {len(image)}u) ? 1 : -1];

extern const {prefix}_cfg_type {prefix}_cfg;

#ifdef __cplusplus
}}
#endif

#endif
"""


def _source(prefix: str, values: Mapping[str, float], lut: bytes, laws: tuple[Law, ...]) -> str:
    return (
        f'{SPDX}\n/* {prefix}_cfg.c: generated by pmsmtool export, do not edit. */\n#include "{prefix}_cfg.h"\n\n'
        + _instance(prefix, values, lut, "const", laws)
    )


def _instance(prefix: str, values: Mapping[str, float], lut: bytes, storage: str, laws: tuple[Law, ...]) -> str:
    remarks = dict.fromkeys(not_read_by_core(laws), "; of a law that is left out")
    remarks |= {name: f"; {reader}" for name, reader in _readers().items()}
    fields = []
    for row in CATALOGUE:
        value = values[row.name]
        literal = f"{int(value)}u" if row.is_integer else c_float(value)
        unit = "" if row.unit == "1" else f"[{row.unit}] "
        fields.append(commented(f"        .{row.c_name} = {literal},", unit + row.meaning + remarks.get(row.name, "")))
    tables = _lut_initialiser(values, lut)
    body = "    .params = {\n" + "\n".join(fields) + "\n    }" + (",\n" + tables if tables else "") + "\n"
    return f"{storage} {prefix}_cfg_type {prefix}_cfg = {{\n{body}}};\n"


def _lut_initialiser(values: Mapping[str, float], lut: bytes) -> str:
    """Axes and tables as words, one table row (torque, all speeds) under a comment with its torque."""
    if not lut:
        return ""
    words = struct.unpack(f"<{len(lut) // 4}I", lut)
    end = len(words) - saturation_words(values)
    lines = [
        "    .lut = {",
        *_look_up_lines(values, lut[: 4 * end], words[:end]),
        *_saturation_lines(values, words[end:]),
    ]
    return "\n".join([*lines, "    }"])


def _saturation_lines(values: Mapping[str, float], words: tuple[int, ...]) -> list[str]:
    """The nodes along i_q under a comment with their i_d."""
    n_d = int(values["saturation.n_d"])
    row = len(words) // max(n_d, 1)
    low, high = values["saturation.i_d_min_a"], values["saturation.i_d_max_a"]
    lines = ["        /* saturation: psi_d [Wb], psi_q/i_q, dpsi_d/di_d, dpsi_q/di_q [H] */"] if words else []
    for k in range(n_d):
        lines += [f"        /* at i_d = {low + k * (high - low) / (n_d - 1):.9g} A */"]
        lines += _word_lines(words[k * row : (k + 1) * row])
    return lines


def _look_up_lines(values: Mapping[str, float], lut: bytes, words: tuple[int, ...]) -> list[str]:
    if not words:
        return []
    n_x, n_y, n_z = (int(values[f"lut.n_{axis}"]) for axis in "xyz")
    second = "speed [rpm]" if values["lut.axis_kind"] == 0 else "flux limit [Wb]"
    lines = []
    start = 0
    for count, what in ((n_x, "torque [N m]"), (n_y, second), (n_z, "U_dc [V]")):
        numbers = ", ".join(f"{number:.9g}" for number in struct.unpack_from(f"<{count}f", lut, 4 * start))
        lines += [f"        /* axis {what}: {numbers} */", *_word_lines(words[start : start + count])]
        start += count
    size = (len(words) - start) // 2
    row_words = n_y * n_z if values["lut.format"] == LUT_FORMAT_BINARY32 else size
    torques = struct.unpack_from(f"<{n_x}f", lut)
    for table in ("i_d [A]", "i_q [A]"):
        for offset in range(0, size, row_words):
            at = f" at {torques[offset // row_words]:.9g} N m" if row_words < size else ", two int16 a word"
            lines += [f"        /* {table}{at} */", *_word_lines(words[start + offset : start + offset + row_words])]
        start += size
    return lines


def _word_lines(words: tuple[int, ...]) -> list[str]:
    return [
        "        " + " ".join(f"0x{word:08X}u," for word in words[k : k + _WORDS_PER_LINE])
        for k in range(0, len(words), _WORDS_PER_LINE)
    ]


def _json(values: Mapping[str, float], image: bytes, design_id: str) -> str:
    content = {
        "schema": "pmsmtool.cfg/1",
        "parameter_schema": SCHEMA_VERSION,
        "signature": layout_signature(),
        "crc32": crc32(image),
        "design": design_id,
        "values": dict(values),
        "not_read_by_core": not_read_by_core(),
        "not_read": not_read(),
        "lut_words": image[4 * len(CATALOGUE) :].hex(),
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


_TEXT = """/* SPDX-License-Identifier: MIT */
/* @_main.c: the control core around a machine with locked rotor; generated by pmsmtool, to copy from.
 *
 * Built only with PMSM_EXAMPLE_MAIN defined, for example (flags: see @_cfg.h)
 *     cc -std=c99 -O2 -ffp-contract=off -fno-math-errno -DPMSM_EXAMPLE_MAIN *.c -o example -lm
 * Exit code 0: the current was reached; 1: it was not; 2: the configuration is damaged (the likely cause is printed).
 * In a drive, control_period() is what the PWM interrupt calls: samples in, duty ratios out.
 */
#include "@_cfg.h"
#include "pmsm_image.h"

#ifdef PMSM_EXAMPLE_MAIN

#ifdef PMSM_NO_C_LIBRARY
#define SAY(text) ((void)(text))
#else
#include <stdio.h> /* not found: without a C library add -DPMSM_NO_C_LIBRARY */
#define SAY(text) ((void)puts(text))
#endif

#define PERIODS 6000u
#define SETTLED 0.02F /* of the request */

typedef struct { /* windings at rest, d axis on phase a */
    float i_d, i_q;         /* A */
    float u_d, u_q;         /* V, acting from the next period on when the drive computes for a period */
} windings;

static pmsm_state state; /* the controller's memory: one for each motor */

static void control_period(const windings *motor, float i_q_request, pmsm_output *output)
{
    const pmsm_params *params = &@_cfg.params;
    pmsm_measurement sampled;
    pmsm_reference request = {0};
    sampled.i_a = motor->i_d;
    sampled.i_b = -0.5F * motor->i_d + 0.866025404F * motor->i_q;
    sampled.i_c = -0.5F * motor->i_d - 0.866025404F * motor->i_q;
    sampled.theta_e = 0.0F;
    sampled.omega_e = 0.0F;
    sampled.U_dc = params->inverter_U_dc_nom_v;
    sampled.T_winding = params->motor_T_ref_c;
    request.mode = PMSM_MODE_CURRENT;
    request.i_q_ref = i_q_request;
    pmsm_step(&state, params, @UP@_CFG_LUT, &sampled, &request, output);
}

/* One period of the windings; u_alpha is u_d and u_beta is u_q while the rotor is locked at angle 0. */
static void advance(windings *motor, const pmsm_output *output)
{
    const pmsm_params *params = &@_cfg.params;
    const uint32_t parts = 16u;
    const float T = (float)params->inverter_T_s_ns * 1e-9F / (float)parts;
    const uint32_t delayed = (params->inverter_delay_periods >= 1.0F) ? 1u : 0u;
    const float u_d = (delayed != 0u) ? motor->u_d : output->u_alpha;
    const float u_q = (delayed != 0u) ? motor->u_q : output->u_beta;
    for (uint32_t k = 0u; k < parts; k++) {
        motor->i_d += T / params->motor_L_d_h * (u_d - params->motor_R_s_ohm * motor->i_d);
        motor->i_q += T / params->motor_L_q_h * (u_q - params->motor_R_s_ohm * motor->i_q);
    }
    motor->u_d = output->u_alpha;
    motor->u_q = output->u_beta;
}

static const char *cause(const pmsm_output *output)
{
    return (state.fault == (uint32_t)PMSM_FAULT_INPUT)
               ? "fault 1: a sample or a request is not a number or too large: see sampled and request"
           : (state.fault != 0u)    ? "fault 2: no usable result: is it the image that pmsm_image_check saw?"
           : (output->gates == 0u) ? "the gates are off: is request.mode set?"
                                   : "the current was not reached: check order and signs of i_a, i_b, i_c, theta_e";
}

int main(void)
{
    const uint8_t *image = (const uint8_t *)&@_cfg;
    const float request = 0.5F * @_cfg.params.motor_I_nom_apk;
    windings motor = {0.0F, 0.0F, 0.0F, 0.0F};
    pmsm_output output;
    if (pmsm_image_check(image, @UP@_CFG_BYTES, @UP@_CFG_SCHEMA_VERSION, @UP@_CFG_SIGNATURE, @UP@_CFG_CRC32) !=
        (uint32_t)PMSM_IMAGE_OK) {
        SAY("@_cfg.c is not as it was exported (changed by hand?): export again with the values wanted");
        return 2;
    }
    pmsm_init(&state);
    for (uint32_t k = 0u; k < PERIODS; k++) {
        control_period(&motor, request, &output);
        advance(&motor, &output);
    }
    const float error = motor.i_q - request;
    const int reached = error <= SETTLED * request && error >= -SETTLED * request;
    SAY(reached ? "the current was reached" : cause(&output));
    return reached ? 0 : 1;
}

#endif
"""


def example_source(prefix: str) -> str:
    """Return ``<prefix>_main.c``; ``prefix`` is a C identifier that was checked."""
    return _TEXT.replace("@UP@", prefix.upper()).replace("@", prefix)
