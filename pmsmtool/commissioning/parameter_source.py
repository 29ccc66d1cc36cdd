# SPDX-License-Identifier: MIT
"""Where parameters come from: a parameter set, a design, a run directory, a device configuration file or a table."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pmsmtool.commissioning.axis_design import axis_parameters
from pmsmtool.design import design_file
from pmsmtool.design.design_file import parse_design
from pmsmtool.design.loops.designed_loops import SMALLER, smaller_gains
from pmsmtool.drive_maps.dcf import values_of
from pmsmtool.drive_maps.drive_map import DriveMap, reference_map
from pmsmtool.drive_maps.eds import parse_eds
from pmsmtool.drive_maps.sheet_check import family_of_sheet, other_identity, unnamed_sheet
from pmsmtool.errors import ConfigError, next_step
from pmsmtool.files import read_bytes, read_text
from pmsmtool.machine.machine_file import SCHEMA as MACHINE_SCHEMA
from pmsmtool.machine.machine_file import no_design, profile_names
from pmsmtool.params import parameter_set
from pmsmtool.params.parameter_set import ParameterSet, parse_parameter_set
from pmsmtool.toml_file import parse_toml, refuse_schema

NEXT_STEP = "give a parameter set, a design, a DCF, a table of `lut`, or a run directory"

AS_TUNE_WRITES = "give design.toml or params.toml as `tune` writes them"
_IN_A_RUN = ("params.toml", "design.toml")
_DCF_SUFFIXES = (".dcf", ".eds")


@next_step(NEXT_STEP)
def load_parameters(path: str | Path, drive_map: DriveMap | None = None) -> ParameterSet:
    """Return the parameter set that a file or a run directory holds.

    Parameters
    ----------
    path : Path
        ``params.toml``, ``design.toml`` (told apart by their schema), a ``.dcf``, a run directory, or a look-up table
        as ``lut`` writes it (``.npz``): that gives the table alone.
    drive_map : DriveMap, optional
        What the objects of a DCF mean, the map of its drive's family when not given; of a design or a set for a drive
        with one pair of current gains the smaller of both axes are taken.

    Raises
    ------
    ConfigError
        It cannot be read, is none of these, or what is wrong with it.
    """
    path = _file(Path(path))
    if path.suffix.lower() in _DCF_SUFFIXES:
        return _from_dcf(path, drive_map)
    if path.suffix.lower() == ".npz":
        from pmsmtool.design.lookup.file import table_parameters
        from pmsmtool.npz_file import read_npz

        return table_parameters(read_npz(path), str(path))
    text = read_text(path)
    schema = parse_toml(text, where=str(path)).get("schema")
    if schema == design_file.SCHEMA:
        design = parse_design(text, where=str(path))
        if design.request.get("axis"):  # the rest of the drive stays as it is
            return axis_parameters(design)
        return _for_drive(design.parameter_set(), drive_map)
    advice = no_design(schema, str(path), AS_TUNE_WRITES)
    refuse_schema(schema, design_file.SCHEMA, parameter_set.SCHEMA, where=str(path), **advice)
    return _for_drive(parse_parameter_set(text, str(path)), drive_map)


def _for_drive(found: ParameterSet, drive_map: DriveMap | None) -> ParameterSet:
    if drive_map is None or drive_map.staging:
        return found
    gains = smaller_gains(found.values, drive_map.cells)
    provenance = {**found.provenance, **dict.fromkeys(gains, SMALLER)}
    return replace(found, values={**found.values, **gains}, provenance=provenance)


def _file(path: Path) -> Path:
    if not path.exists() and str(path) in profile_names():
        raise ConfigError("is a profile, no design", where=str(path), **no_design(MACHINE_SCHEMA, str(path)))
    if not path.is_dir():
        return path
    found = next((path / name for name in _IN_A_RUN if (path / name).is_file()), None)
    if found is None:
        ended = (path / "run.json").is_file()
        raise ConfigError(
            "there is no design in this folder", where=str(path),
            likely="the run ended before its stage tune" if ended else "",
            hint=f"`pmsmtool commission --resume {path}` goes on with it" if ended else "`pmsmtool tune` writes one",
        )  # fmt: skip
    return found


def _from_dcf(path: Path, drive_map: DriveMap | None) -> ParameterSet:
    sheet = parse_eds(read_bytes(path), str(path))
    family = family_of_sheet(sheet)
    nobodys = drive_map is None and family is None
    drive_map = drive_map or family or reference_map()
    differs = other_identity(sheet, drive_map)
    if differs and nobodys:
        raise unnamed_sheet(sheet, str(path))
    if differs:
        its = "the map that this file is for with --map" if family is None else f"--map {family.name}"
        raise ConfigError(
            differs, where=str(path), likely="the file of another drive, whose objects mean something else",
            hint=f"give {its}, or the file of the map's drive",
        )  # fmt: skip
    addresses = {name: drive_map.address(name) for name in (*drive_map.cells, *drive_map.tables)}
    values = values_of(sheet, frozenset(addresses.values()))
    found = {name: values[address] for name, address in addresses.items() if address in values}
    if not found and nobodys:
        raise unnamed_sheet(sheet, str(path))
    if not found:
        raise ConfigError(
            f"holds no parameter of the drive family {drive_map.name}",
            where=str(path),
            likely="an EDS without values, or the file of another drive",
        )
    return drive_map.decode(found)
