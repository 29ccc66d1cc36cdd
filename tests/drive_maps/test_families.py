# SPDX-License-Identifier: MIT
"""Simulated drives of every mapped family: what is shown before is what they hold; the gate before the first write."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pmsmtool.bus.connect import connect
from pmsmtool.drive import objects
from pmsmtool.drive.drive_node import DriveNode
from pmsmtool.drive.parameters import DriveParameters
from pmsmtool.drive.port import Identity
from pmsmtool.drive.stop import quick_stop
from pmsmtool.drive_maps.drive_map import REFERENCE_VENDOR, DriveMap, reference_map
from pmsmtool.drive_maps.drive_map_file import parse_drive_map
from pmsmtool.drive_maps.shipped_maps import family_names, family_of, load_family
from pmsmtool.errors import ConfigError, NotAvailable, SafetyRefusal, SdoAbort
from pmsmtool.flash.download import Download
from pmsmtool.flash.journal import JournalFolder
from pmsmtool.flash.map_gate import check_map, memory_of, remember_map
from pmsmtool.flash.restore import plan_download, take_backup
from pmsmtool.params.catalogue import CATALOGUE, INCREMENTS, TORQUE_PER_AMPERE
from pmsmtool.params.parameter_set import ParameterSet
from pmsmtool.sim.node.family import STANDARD

FOREIGN = [name for name in family_names() if name != "pmsmsim"]
HOLDING = [name for name in FOREIGN if load_family(name).cells]
WITH_OWN_OBJECTS = [
    name for name in HOLDING if any(cell.index not in STANDARD for cell in load_family(name).cells.values())
]
"""Families that hold more than the limits of CiA 402."""
DESIGNS, WRITTEN_OF = 250, 5


@contextmanager
def opened(family: str, *, nv: str = ":memory:") -> Iterator[DriveNode]:
    with connect("pmsmsim", f"interior-2k2?nv={nv}&drive={family}") as connection:
        node = DriveNode(connection, 1, drive_map=load_family(family))
        yield node
        node.close()


PROFILE = ("speed_rpm", "acceleration_rpm_per_s", "deceleration_rpm_per_s", "jerk_rpm_per_s2")


def random_design(rng: np.random.Generator) -> dict[str, float]:
    """A machine from a few watts to many kilowatts, its ratings, and gains for a random bandwidth."""

    def between(low: float, high: float) -> float:
        return float(math.exp(rng.uniform(math.log(low), math.log(high))))

    current, R_s, L_d = between(1.0, 100.0), between(0.01, 5.0), between(1e-4, 0.02)
    torque = between(0.1, 500.0)
    L_q, alpha = L_d * float(rng.uniform(1.0, 2.2)), between(300.0, 5000.0)
    return {
        "motor.pole_pairs": float(rng.integers(1, 12)),
        "motor.R_s_ohm": R_s,
        "motor.L_q_h": L_q,
        "motor.psi_f_wb": between(1e-3, 1.0),
        "motor.I_nom_apk": current,
        "motor.I_max_apk": 1.5 * current,
        "motor.I_max_time_s": float(rng.uniform(0.1, 20.0)),
        "motor.n_max_rpm": between(100.0, 20_000.0),
        "protection.U_dc_min_v": float(rng.uniform(10.0, 400.0)),  # the simulated link has 560 V
        "protection.U_dc_max_v": float(rng.uniform(650.0, 900.0)),
        "current.K_p_d_v_per_a": alpha * L_d,
        "current.K_i_d_v_per_as": alpha * R_s,
        "current.K_p_q_v_per_a": alpha * L_q,
        "current.K_i_q_v_per_as": alpha * R_s,
        "speed.K_p_nms_per_rad": between(1e-4, 10.0),
        "speed.K_i_nm_per_rad": between(1e-3, 100.0),
        "speed.tau_max_nm": torque,
        "reference.tau_rated_nm": torque / between(0.5, 10.0),
        "reference.torque_slope_nm_per_s": torque * between(0.1, 500.0),
        **{f"reference.profile_{key}": between(1.0, 1e5) for key in PROFILE},
        "position.K_p_per_s": between(1.0, 1000.0),
        "position.velocity_ff": float(rng.uniform(0.0, 1.0)),
        "position.inertia_ff_kgm2": between(1e-6, 1.0),
    }


K_T = 2.3
"""Torque of an ampere (N m/A), as the machine's or as the drive holds it."""


def in_amperes(drive_map: DriveMap, rng: np.random.Generator) -> dict[str, float]:
    """Gains that a family keeps in amperes or per increment, within its types, and what it scales them by."""
    resting = [cell for cell in drive_map.cells.values() if drive_map.scale_of(cell) == TORQUE_PER_AMPERE]
    gains = {cell.name: cell.factor * K_T * float(rng.uniform(1.0, 3e4)) for cell in resting}
    return gains | {TORQUE_PER_AMPERE: K_T, INCREMENTS: 8192.0}


def torque_of(design: dict[str, float], drive_map: DriveMap) -> dict[str, float]:
    """What a drive scales gains by, where it keeps any in amperes or per increment."""
    resting = any(cell.form == "current" for cell in drive_map.cells.values())
    scales = {TORQUE_PER_AMPERE: design[TORQUE_PER_AMPERE]} if resting else {}
    return scales | ({INCREMENTS: design[INCREMENTS]} if INCREMENTS in drive_map.cells else {})


@pytest.mark.chain
@pytest.mark.parametrize("family", HOLDING)
def test_what_is_shown_before_is_what_the_drive_holds(family: str) -> None:
    """Random designs: bytes and the SI values they mean; of every fifth also what the drive reads back."""
    rng = np.random.default_rng([7, len(family), ord(family[0])])
    with opened(family) as node:
        drive_map, parameters = node.map, DriveParameters(node)
        rounded = 0
        for k in range(DESIGNS):
            design = random_design(rng) | in_amperes(drive_map, rng)
            wanted = ParameterSet({name: design[name] for name in drive_map.cells} | torque_of(design, drive_map))
            encoded, shown = drive_map.encode(wanted), drive_map.quantised(wanted)
            if k % WRITTEN_OF == 0:
                parameters.replace(encoded)
                assert parameters.read(encoded) == encoded
            assert drive_map.decode(encoded, torque_of(design, drive_map)).values == shown.values
            rounded += shown.values != wanted.values
        whole = set(drive_map.cells) == {"motor.pole_pairs"}
        assert rounded == (0 if whole else DESIGNS)  # every design is rounded by what the family can hold


@pytest.mark.parametrize("family", WITH_OWN_OBJECTS)
def test_the_machine_behind_works_with_what_the_bytes_mean(family: str) -> None:
    with opened(family) as node:
        rng = np.random.default_rng(3)
        design = random_design(rng) | in_amperes(node.map, rng)
        wanted = ParameterSet({name: design[name] for name in node.map.cells} | torque_of(design, node.map))
        DriveParameters(node).replace(node.map.encode(wanted))
        held = node.map.quantised(wanted).values
        session = node.connection.bus.line.nodes[0].session  # type: ignore[attr-defined]
        # what the drive behind has; its own torque per ampere counts the rest
        known = {row.name for row in CATALOGUE if row.name in held and node.map.writes(row.name, {})}
        own = {name: held[name] for name in known if node.map.cells[name].index not in STANDARD}
        for name, value in own.items():
            assert session.parameters.active.get(name) == pytest.approx(value, rel=2e-7)


def test_one_pair_of_gains_acts_on_both_axes() -> None:
    with opened("epos4") as node:
        values = {"current.K_p_q_v_per_a": 1.2345678, "current.K_i_q_v_per_as": 99.9996}
        DriveParameters(node).replace(node.map.encode(ParameterSet(values)))
        active = node.connection.bus.line.nodes[0].session.parameters.active  # type: ignore[attr-defined]
        assert active.get("current.K_p_d_v_per_a") == active.get("current.K_p_q_v_per_a") == pytest.approx(1.234568)
        assert active.get("current.K_i_d_v_per_as") == pytest.approx(100.0)  # one count is 1 mV/(A s)


def test_the_bytes_survive_a_store_and_a_reset() -> None:
    """A count above 2^24 does not fit the binary32 behind it; the family's own bytes are kept all the same."""
    with opened("epos4") as node:
        encoded = node.map.encode(
            ParameterSet({"current.K_p_q_v_per_a": 123.456789, "current.K_i_q_v_per_as": 54_321.987})
        )
        parameters = DriveParameters(node)
        parameters.replace(encoded)
        node.identity()
        node.store()
        node.reset()
        assert parameters.read(encoded) == encoded


@pytest.mark.parametrize("family", FOREIGN)
def test_only_the_familys_objects_are_there(family: str) -> None:
    with opened(family) as node:
        identity, drive_map = node.identity(), node.map
        assert (identity.vendor, identity.product) == (drive_map.vendor, drive_map.product)
        shown = {(c.index, c.sub) for c in (*drive_map.cells.values(), *drive_map.signals.values())}
        for index, sub in [(0x2000, 2), (0x2020, 1), (0x2050, 13), (0x2060, 1), (0x2070, 1), (0x1021, 0)]:
            assert node.has(index, sub) == ((index, sub) in shown)
        for cell in (*drive_map.cells.values(), *drive_map.signals.values()):
            assert len(node.sdo.read(cell.index, cell.sub)) == cell.size
        modes = node.whole(objects.SUPPORTED_MODES)
        assert bool(modes & 0b1000) == bool(drive_map.capabilities.torque_mode)
        for mode in (-1, 4, 3):
            has = {4: drive_map.capabilities.torque_mode, 3: drive_map.capabilities.velocity_mode}.get(mode, False)
            if has:
                node.put(objects.MODE, mode)
            else:
                with pytest.raises(SdoAbort):
                    node.put(objects.MODE, mode)


def test_live_values_in_the_familys_counts() -> None:
    with opened("ingenia") as node:
        U_dc = np.frombuffer(node.sdo.read(0x2060, 0), "<f4")[0]
        assert 500.0 < U_dc < 600.0  # interior-2k2: 560 V
        node.sdo.download(0x2021, 0, np.float32(2.5).tobytes())  # rev/s
        dictionary = node.connection.bus.line.nodes[0].session.dictionary  # type: ignore[attr-defined]
        assert dictionary["cia402.target_velocity"].number() == pytest.approx(150_000, abs=1)
    with opened("epos4") as node:
        node.sdo.download(0x60FF, 0, (300).to_bytes(4, "little"))  # rpm
        dictionary = node.connection.bus.line.nodes[0].session.dictionary  # type: ignore[attr-defined]
        assert dictionary["cia402.target_velocity"].number() == 300_000


@pytest.mark.chain
@settings(max_examples=300, deadline=None)
@given(K_p=st.floats(1e-6, 4000.0), T_n=st.floats(1e-6, 0.06), step=st.sampled_from(["V/A", "mV/A", "0.1 V/A"]))
def test_an_integral_time_is_read_back_as_shown(K_p: float, T_n: float, step: str) -> None:
    text = f"""
schema = "pmsmtool.drive-map/1"
name = "tn"
vendor = 1
product = 1
[objects]
"current.K_p_q_v_per_a" = {{ index = 0x2002, sub = 1, type = "UNSIGNED32", unit = "{step}" }}
[objects."current.K_i_q_v_per_as"]
index = 0x2002
sub = 2
type = "UNSIGNED16"
unit = "us"
gain = "current.K_p_q_v_per_a"
"""
    drive_map = parse_drive_map(text)
    wanted = ParameterSet({"current.K_p_q_v_per_a": K_p, "current.K_i_q_v_per_as": K_p / T_n})
    encoded = drive_map.encode(wanted)
    shown = drive_map.decode(encoded).values
    counts = int.from_bytes(encoded["current.K_i_q_v_per_as"], "little")
    assert abs(counts - 1e6 * T_n) <= 0.5 + 1e-6
    if counts:  # the drive's integral gain is what its own K_p and T_n make of it
        expected = shown["current.K_p_q_v_per_a"] / (1e-6 * counts)
        assert shown["current.K_i_q_v_per_as"] == pytest.approx(expected, rel=1e-12)


def test_a_plan_says_why_a_value_is_left_out_and_what_is_rounded() -> None:
    with opened("epos4") as node:
        wanted = ParameterSet({"current.K_i_q_v_per_as": 12.3457, "current.K_p_d_v_per_a": 1.0, "motor.R_s_ohm": 0.1})
        lines = plan_download(node, wanted).lines()
    assert any("12.346 V/(A s)" in line and "asked for 12.3457" in line for line in lines)
    assert any("K_p_d_v_per_a: one pair of gains" in line for line in lines)
    assert any("motor.R_s_ohm: 0x3002:01" in line for line in lines)


def test_a_value_the_type_cannot_hold_is_refused_before_anything_is_written() -> None:
    with opened("copley") as node:
        before = DriveParameters(node).read(node.map.cells)
        with pytest.raises(ConfigError, match="does not fit") as caught:
            node.map.encode(ParameterSet({"motor.I_max_apk": 400.0, "motor.I_nom_apk": 3.0}))
        assert "0x2110:00" in str(caught.value)
        assert DriveParameters(node).read(node.map.cells) == before


# ---- the gate -------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> JournalFolder:
    return JournalFolder(Identity(1, 0xFB, 0x61500000, 1, 7), tmp_path)


def test_a_map_without_a_vendor_writes_nothing(folder: JournalFolder) -> None:
    with pytest.raises(ConfigError, match="does not state whose drive"):
        check_map(replace(load_family("copley"), vendor=0), Identity(1, 0xAB, 1, 1, 7), folder)


def test_another_identity_is_refused(folder: JournalFolder) -> None:
    with pytest.raises(ConfigError, match="is for vendor 0x000000fb"):
        check_map(load_family("epos4"), Identity(1, 0xFB, 0x63220000, 1, 7), folder)


def test_a_folder_that_cannot_be_written_names_the_other_one(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    folder = JournalFolder(Identity(1, 0xFB, 0x61500000, 1, 7), tmp_path / "file")
    with pytest.raises(ConfigError) as refused:
        remember_map(load_family("epos4"), folder)
    assert "PMSMTOOL_HOME" in refused.value.hint


def test_another_map_for_the_same_drive_is_refused(folder: JournalFolder) -> None:
    epos4 = load_family("epos4")
    identity = Identity(1, 0xFB, 0x68500000, 1, 7)
    check_map(epos4, identity, folder)
    remember_map(epos4, folder)
    check_map(epos4, identity, folder)
    cell = epos4.cells["current.K_p_q_v_per_a"]
    edited = replace(epos4, cells={**epos4.cells, cell.name: replace(cell, unit="mV/A", factor=1e-3)})
    with pytest.raises(SafetyRefusal, match="last written through another map"):
        check_map(edited, identity, folder)
    memory_of(folder).unlink()
    check_map(edited, identity, folder)
    memory_of(folder).write_text("{}")
    with pytest.raises(ConfigError, match="damaged"):
        check_map(epos4, identity, folder)


def flash(node: DriveNode, values: dict[str, float], root: Path) -> None:
    identity = node.identity()
    plan = plan_download(node, ParameterSet(values))
    Download(node, identity, plan, {}, JournalFolder(identity, root)).run()


def test_a_download_to_another_family_holds_stores_and_remembers(tmp_path: Path) -> None:
    with opened("epos4") as node:
        values = {"current.K_p_q_v_per_a": 3.3333333, "current.K_i_q_v_per_as": 1234.5678, "motor.R_s_ohm": 0.1}
        flash(node, values, tmp_path)
        assert DriveParameters(node).read_value("current.K_p_q_v_per_a") == pytest.approx(3.333333)
        backup = take_backup(node, node.identity())
        assert {entry.name for entry in backup.entries} >= set(node.map.cells)
        cell = node.map.cells["current.K_p_q_v_per_a"]
        changed = replace(cell, sub=2)
        node.map = replace(node.map, cells={cell.name: changed})
        with pytest.raises(SafetyRefusal, match="another map"):
            flash(node, {cell.name: 1.0}, tmp_path)
        assert int.from_bytes(node.sdo.read(0x30A0, 2), "little") == 1_234_568


def test_a_map_whose_type_is_not_the_drives_is_found_before_the_first_write(tmp_path: Path) -> None:
    with opened("epos4") as node:
        cell = node.map.cells["current.K_p_q_v_per_a"]
        for wrong in (replace(cell, wire="UNSIGNED16", factor=1e-3), replace(cell, index=0x30A9)):
            node.map = replace(load_family("epos4"), cells={cell.name: wrong})
            before = node.sdo.read(0x30A0, 1)
            with pytest.raises(NotAvailable):
                flash(node, {cell.name: 1.0}, tmp_path / wrong.wire / hex(wrong.index))
            assert node.sdo.read(0x30A0, 1) == before


def test_families_by_identity() -> None:
    def name(drive_map: DriveMap | None) -> str:
        return "" if drive_map is None else drive_map.name

    assert name(family_of(0xFB, 0x68500000)) == "epos4"
    assert name(family_of(0xFB, 0x63220000)) == "epos2"
    assert name(family_of(REFERENCE_VENDOR, 1)) == "pmsmsim"
    assert family_of(0, 0) is None and family_of(0xFB, 1) is None
    assert family_of(0xFB, 0x68500000) is load_family("epos4"), "every search read 11 files again, 7 ms each"
    with pytest.raises(ConfigError, match="did you mean epos4"):
        load_family("epos5")


def test_nothing_of_the_reference_drive_is_written_to_another(tmp_path: Path) -> None:
    """A stop and a flash without a map that fits: 0x2000, 0x2050 and 0x2052 of another maker stay untouched."""
    with opened("epos4") as node:
        node.map = reference_map()  # what commands without --map take
        sent: list[tuple[int, int]] = []
        download = node.sdo.download

        def noted(index: int, sub: int, *rest: object, **more: object) -> object:
            sent.append((index, sub))
            return download(index, sub, *rest, **more)  # type: ignore[arg-type]

        node.sdo.download = noted  # type: ignore[method-assign, assignment]
        quick_stop(node)
        assert sent and not [where for where in sent if 0x2000 <= where[0] < 0x6000]
        node.map = load_family("epos4")
        flash(node, {"current.K_p_q_v_per_a": 2.0}, tmp_path)
        assert {where for where in sent if 0x2000 <= where[0] < 0x6000} == {(0x30A0, 1)}
