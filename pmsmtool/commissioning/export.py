# SPDX-License-Identifier: MIT
"""A parameter set in the forms other programs take: DCF, concise DCF, C, CSV, fixed point.

Every value goes through the drive's map, so the bytes in a file are the bytes ``flash-params`` would send. Same set,
same bytes: no date, no path, no user.

Of the fixed-point governor (``firmware/fixed_point``) bases are powers of two at least twice the largest value the
drive's own limits allow, so that Q4.27 leaves a factor of sixteen above those; the voltage base is raised further where
gains or reactances need it. A value that does not fit is refused, never wrapped; the error of every rounded value is
printed.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources

from pmsmtool.drive import objects
from pmsmtool.drive.parameters import SetCommand
from pmsmtool.drive_maps.dcf import Entry, new_dcf, write_concise
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.map_tables import encode_table, look_up_words
from pmsmtool.drive_maps.sheet_check import contradictions, family_of_sheet, limits_of, types_of, unnamed_sheet
from pmsmtool.drive_maps.shipped_maps import nothing_to_write
from pmsmtool.errors import ConfigError
from pmsmtool.files import data_folder
from pmsmtool.firmware.image import crc32, pack_image
from pmsmtool.firmware.params_header import SPDX, c_float
from pmsmtool.params.catalogue import BY_NAME, CATALOGUE
from pmsmtool.params.parameter_set import ParameterSet, table_unit
from pmsmtool.plain_text import counted
from pmsmtool.units import rad_s_from_rpm

BITS = 27
ONE = 1 << BITS
RAISED = 8
"""The voltage base is at most so much above what the limits ask for."""
LARGEST = (1 << 30) - 1
"""Eight base values, where the C code saturates."""
_FAR_LIMITS = "the current or voltage limits are far from what the gains belong to"
_FLOATING = "correct the limits, or export without --fixed-point"

DECOUPLING_AND_EMF = 3
"""Bits of ``current.options`` that the governor's rows rest on."""


@dataclass(frozen=True, slots=True)
class QFormat:
    """Bases and constants of one motor."""

    I_base: float
    U_base: float
    omega_base: float
    """Base values (A, V, electrical rad/s), powers of two."""
    constants: Mapping[str, tuple[int, float]]
    """Member of ``pmsm_governor_q_constants`` -> Q4.27 number and its relative rounding error."""


def _power_of_two(x: float) -> float:
    return math.ldexp(1.0, math.ceil(math.log2(x)))


def q_format(values: Mapping[str, float]) -> QFormat:
    """Return bases and constants of a complete set of catalogue values.

    Raises ConfigError: a constant does not fit Q4.27, or the current controller works without decoupling or emf
    feed-forward.
    """
    if int(values["current.options"]) & DECOUPLING_AND_EMF != DECOUPLING_AND_EMF:
        raise ConfigError(
            "the fixed-point governor needs decoupling and emf feed-forward",
            where="current.options",
            hint="set bits 0 and 1",
        )
    if min(values[f"current.K_p_{axis}_v_per_a"] for axis in "dq") <= 0.0:
        raise ConfigError(
            "the fixed-point governor needs a proportional current controller",
            where="current.K_p",
            hint="`pmsmtool tune` gives one; without --fixed-point none is needed",
        )
    I_base = _power_of_two(2.0 * max(values["motor.I_max_apk"], values["governor.I_transient_apk"]))
    U_base = _power_of_two(2.0 * values["inverter.voltage_utilisation"] * values["protection.U_dc_max_v"])
    speed = max(values["motor.n_max_rpm"], values["protection.n_trip_rpm"])
    omega_base = _power_of_two(rad_s_from_rpm(2.0 * values["motor.pole_pairs"] * speed))
    numbers = _numbers(values, I_base, U_base, omega_base)
    most = RAISED * U_base
    while U_base < most and max(numbers.values()) > LARGEST / ONE:
        U_base *= 2.0
        numbers = _numbers(values, I_base, U_base, omega_base)
    return QFormat(I_base, U_base, omega_base, {name: _rounded(name, x) for name, x in numbers.items()})


def _numbers(values: Mapping[str, float], I_base: float, U_base: float, omega_base: float) -> dict[str, float]:
    """Members of the C structure per unit of their bases."""
    ohm, henry = I_base / U_base, I_base * omega_base / U_base
    K_p = {axis: values[f"current.K_p_{axis}_v_per_a"] * ohm for axis in "dq"}
    return {
        "K_p_d": K_p["d"],
        "K_p_q": K_p["q"],
        "inverse_K_p_d": 1.0 / K_p["d"],
        "inverse_K_p_q": 1.0 / K_p["q"],
        "R_s": values["motor.R_s_ohm"] * ohm,
        "L_d": values["motor.L_d_app_h"] * henry,
        "L_q": values["motor.L_q_app_h"] * henry,
        "psi_f": values["motor.psi_f_wb"] * omega_base / U_base,
        "steady_share": 1.0 - values["governor.eps"],
        "slack": values["governor.slack"],
    }


def _rounded(name: str, x: float) -> tuple[int, float]:
    q = round(x * ONE)
    if q > LARGEST:
        raise ConfigError(
            f"{name} is {x:.6g} of its base value, more than Q4.27 of the fixed-point governor holds (8)",
            likely=_FAR_LIMITS,
            hint=_FLOATING,
        )
    if q == 0 and x != 0.0:
        raise ConfigError(
            f"{name} is {x:.3g} of its base value and vanishes in Q4.27", likely=_FAR_LIMITS, hint=_FLOATING
        )
    return q, (q / ONE - x) / x if x else 0.0


def q_files(values: Mapping[str, float], *, prefix: str = "pmsm", design_id: str = "") -> dict[str, str]:
    """Return file name -> text of the fixed-point governor and of its constants."""
    q = q_format(values)
    return {
        f"{prefix}_cfg_q.h": _header(q, prefix, design_id),
        f"{prefix}_cfg_q.c": _source(q, prefix),
        **dict(fixed_point_files()),
    }


def fixed_point_files() -> Iterator[tuple[str, str]]:
    """Yield (name, text) of every C file of the fixed-point governor, in name order."""
    folder = resources.files("pmsmtool.firmware").joinpath("fixed_point")
    for entry in sorted(folder.iterdir(), key=lambda item: item.name):
        if entry.name.endswith((".c", ".h")):
            yield entry.name, entry.read_text(encoding="ascii")


def _header(q: QFormat, prefix: str, design_id: str) -> str:
    up, guard = prefix.upper(), f"{prefix.upper()}_CFG_Q_H"
    return f"""{SPDX}
/* {prefix}_cfg_q.h: generated by pmsmtool export, do not edit.
 * design {design_id or "not named"}
 * Constants and signals of the fixed-point governor are Q4.27 of these base values. They are powers of two, at least
 * twice what the limits of the drive allow.
 */
#ifndef {guard}
#define {guard}

#include "pmsm_governor_q.h"

#define {up}_Q_I_BASE_A {c_float(q.I_base)}
#define {up}_Q_U_BASE_V {c_float(q.U_base)}
#define {up}_Q_OMEGA_BASE_RAD_S {c_float(q.omega_base)} /* electrical */

#ifdef __cplusplus
extern "C" {{
#endif

extern const pmsm_governor_q_constants {prefix}_cfg_q;

#ifdef __cplusplus
}}
#endif

#endif
"""


def _source(q: QFormat, prefix: str) -> str:
    worst = max(abs(error) for _, error in q.constants.values())
    lines = [
        f"        .{name} = {number}, /* {number / ONE:.9g}, rounded by {error:+.1e} of the value */"
        for name, (number, error) in q.constants.items()
    ]
    return "\n".join(
        [
            f"{SPDX}\n/* {prefix}_cfg_q.c: generated by pmsmtool export, do not edit.",
            f" * Largest rounding error of a constant: {worst:.1e} of its value.",
            " */",
            f'#include "{prefix}_cfg_q.h"',
            "",
            f"const pmsm_governor_q_constants {prefix}_cfg_q = {{",
            *(line[4:] for line in lines),
            "};",
            "",
        ]
    )


CSV_HEAD = ("name", "value", "unit", "held", "object", "type", "bytes", "meaning", "not written because")

MOST_NAMED = 8
"""Rows that the refusal of another drive's file lists; they are all rows of a map where it is the wrong one."""


def checked(wanted: ParameterSet) -> ParameterSet:
    """Return the set, or raise ``ConfigError`` listing every value out of bounds."""
    violations = wanted.violations()
    if violations:
        raise ConfigError(
            "the parameter set cannot be exported",
            where=wanted.name,
            violations=violations,
            hint="`pmsmtool param help NAME` shows a parameter's bounds",
        )
    return wanted


def image_of(wanted: ParameterSet) -> bytes:
    """Return the packed image of a complete set (object 0x2001), look-up words included.

    Raises ConfigError: parameters are missing or out of bounds, or the tables do not fit their descriptor.
    """
    checked(wanted)
    tables = {name: encode_table(name, table, wanted.values) for name, table in wanted.tables.items()}
    return pack_image(wanted.values, look_up_words(tables))


def dcf_file(
    wanted: ParameterSet,
    *,
    drive_map: DriveMap | None = None,
    base: bytes | None = None,
    node_id: int = 1,
    where: str = "EDS",
) -> bytes:
    """Return a device configuration file (CiA 306-1).

    Raises ConfigError: values that do not fit, or objects the base does not describe; NotAvailable: the map has no
    object for any value.

    Parameters
    ----------
    wanted : ParameterSet
        What the drive shall hold; what its map does not know is left out.
    drive_map : DriveMap, optional
        The reference drive's when not given.
    base : bytes, optional
        EDS or DCF the values are laid into, every other byte kept; the EDS of the reference drive when not given.
    node_id : int
        Into the DeviceComissioning section when the base has none.
    where : str
        Name of the base for messages.
    """
    given, drive_map = drive_map is not None, drive_map or reference_map()
    if base is None:
        base = (data_folder("firmware-params") / drive_map.name / f"{drive_map.name}.eds").read_bytes()
    sheet = parse_eds(base, where)
    encoded = drive_map.limited(limits_of(sheet)).encode(checked(wanted))
    rows = [name for name in encoded if name in drive_map.cells]
    wrong = contradictions(drive_map, types_of(sheet), rows)
    if wrong:
        more = len(wrong) - MOST_NAMED
        family = family_of_sheet(sheet)
        if family is None and not given:
            raise unnamed_sheet(sheet, where)
        other = family is not None and family.name != drive_map.name
        its = f"--map {family.name}" if family is not None and other else "a map of the drive with --map"
        raise ConfigError(
            f"the file contradicts {counted(len(wrong), 'row')} of the map {drive_map.name!r}",
            where=where, violations=[*wrong[:MOST_NAMED], *([f"and {more} more"] if more > 0 else [])],
            likely="the file belongs to another drive or firmware",
            hint=f"give the EDS of the drive that the map is for, or {its}; nothing was written",
        )  # fmt: skip
    values = {drive_map.address(name): data for name, data in encoded.items()}
    if not values:
        raise nothing_to_write(drive_map, where)
    return new_dcf(base, values, node_id=node_id, node_name=wanted.name, where=where)


def concise_dcf(wanted: ParameterSet, *, drive_map: DriveMap | None = None) -> bytes:
    """Return a concise DCF (CiA 302-2, object 0x1F22), which a CANopen manager plays object by object at boot-up.

    For a drive that stages, a complete set is framed by its staging commands, so that the drive takes it as a whole
    and only if its CRC-32 is right. An incomplete set has no CRC of its own and is written directly; the look-up
    table cannot be written that way.

    Raises ConfigError: values that do not fit, or a look-up table in an incomplete set.
    """
    drive_map = drive_map or reference_map()
    entries = [Entry(*drive_map.address(name), data) for name, data in drive_map.encode(checked(wanted)).items()]
    if drive_map.staging:
        complete = all(row.name in wanted.values for row in CATALOGUE)
        if complete:
            entries = [*_stage(SetCommand.BEGIN), *entries, *_take(crc32(image_of(wanted)))]
        elif wanted.tables or any(name.startswith(("lut.", "saturation.")) for name in wanted.values):
            raise ConfigError(
                "a table can be sent to this drive only together with the whole set",
                where=wanted.name,
                hint="export the design, or a complete params.toml",
            )
    return write_concise(entries)


def _stage(command: SetCommand) -> Iterator[Entry]:
    item = objects.SET_COMMAND
    yield Entry(item.index, item.sub, item.encode(command))


def _take(crc: int) -> Iterator[Entry]:
    item = objects.SET_CRC_EXPECTED
    yield Entry(item.index, item.sub, item.encode(crc))
    yield from _stage(SetCommand.VALIDATE)
    yield from _stage(SetCommand.ACTIVATE)


def csv_text(wanted: ParameterSet, *, drive_map: DriveMap | None = None) -> str:
    """Return a table for people and spreadsheets: one row per value, asked for and held, with its object and bytes.

    A value that the drive's object does not hold has the reason in its row, and so has what acts only with it.
    A look-up table gives one row per axis or table and one per number (``lut.i_d_a[17]``, row-major).
    """
    drive_map = drive_map or reference_map()
    drive_map = drive_map.without(drive_map.refused(checked(wanted)))
    encoded = drive_map.encode(wanted)
    held = drive_map.decode(encoded)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(CSV_HEAD)
    writer.writerows(_scalar_rows(wanted, drive_map, encoded, held.values))
    writer.writerows(_table_rows(wanted, drive_map, encoded, held))
    return out.getvalue()


Row = tuple[str, str, str, str, str, str, str, str, str]


def _scalar_rows(
    wanted: ParameterSet, drive_map: DriveMap, encoded: Mapping[str, bytes], held: Mapping[str, float]
) -> Iterator[Row]:
    lacking = drive_map.not_written(wanted.values)
    for name, value in wanted.values.items():
        row, cell = BY_NAME[name], drive_map.cells.get(name)
        if cell is None or name not in encoded:
            yield name, _number(value), row.unit, "", "", "", "", row.meaning, lacking[name]
        else:
            where = f"0x{cell.index:04X}:{cell.sub:02X}"
            data = encoded[name].hex()
            yield name, _number(value), row.unit, _number(held[name]), where, cell.wire, data, row.meaning, ""


def _table_rows(
    wanted: ParameterSet, drive_map: DriveMap, encoded: Mapping[str, bytes], held: ParameterSet
) -> Iterator[Row]:
    for name, table in wanted.tables.items():
        unit = table_unit(name)
        known = name in drive_map.tables
        where = "0x{:04X}:{:02X}".format(*drive_map.tables[name]) if known else ""
        size = f"{len(encoded[name])} bytes" if known else ""
        lacking = "; ".join(drive_map.not_written([name]).values())
        yield name, f"{len(table)} numbers", unit, "", where, "DOMAIN" if known else "", size, "look-up table", lacking
        for k, value in enumerate(table):
            kept = _number(held.tables[name][k]) if known else ""
            yield f"{name}[{k}]", _number(value), unit, kept, "", "", "", "", lacking


def _number(value: float) -> str:
    whole = math.isfinite(value) and value == int(value) and abs(value) < 2**53
    return str(int(value)) if whole else repr(float(value))
