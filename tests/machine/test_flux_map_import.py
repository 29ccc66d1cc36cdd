# SPDX-License-Identifier: MIT
"""Flux maps from files: every accepted form gives the same map, every bad file one clear error."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from benchmarks.analytic_saturation import saturated_pmsyrm_map
from pmsmtool.errors import ConfigError
from pmsmtool.machine.flux_map import FluxMap
from pmsmtool.machine.flux_map_import import flux_map_csv, flux_map_npz, load_flux_map, read_flux_map

MEASURED_MAP = Path(__file__).parents[2].parent / "shared" / "maps" / "baldor_400rpm_map.npz"


@pytest.fixture(scope="module")
def small():
    """A 7 x 9 part of the analytic machine."""
    full = saturated_pmsyrm_map()
    rows, columns = np.arange(0, 53, 8), np.arange(2, 51, 6)
    part = np.ix_(rows, columns)
    return FluxMap(
        full.i_d_a[rows], full.i_q_a[columns], full.psi_d_wb[part], full.psi_q_wb[part], "bicubic", (20, 21),
        {"origin": "test"},
    )  # fmt: skip


def assert_same_grid(found, expected):
    for name in ("i_d_a", "i_q_a", "psi_d_wb", "psi_q_wb"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize("suffix", ["npz", "csv"])
@pytest.mark.parametrize("kind", ["bicubic", "bilinear"])
def test_own_formats_keep_everything(tmp_path, small, suffix, kind):
    flux_map = FluxMap(small.i_d_a, small.i_q_a, small.psi_d_wb, small.psi_q_wb, kind, (20, 21), small.meta)
    path = tmp_path / f"map.{suffix}"
    content = flux_map_npz(flux_map) if suffix == "npz" else flux_map_csv(flux_map).encode()
    path.write_bytes(content)
    found = load_flux_map(path)
    assert_same_grid(found, flux_map)
    assert (found.kind, found.inverse_nodes, dict(found.meta)) == (kind, (20, 21), dict(small.meta))
    assert found.content_hash() == flux_map.content_hash()
    again = flux_map_npz(found) if suffix == "npz" else flux_map_csv(found).encode()
    assert again == content


def foreign(small):
    """The forms other tools write, by name."""
    i_d, i_q = np.meshgrid(small.i_d_a, small.i_q_a, indexing="ij")
    psi_d, psi_q = small.psi_d_wb, small.psi_q_wb
    return {
        "complex": {"i_s_dq": i_d + 1j * i_q, "psi_s_dq": psi_d + 1j * psi_q},
        "complex transposed": {"i_s_dq": (i_d + 1j * i_q).T, "psi_s_dq": (psi_d + 1j * psi_q).T},
        "vectors": {"Id": small.i_d_a, "Iq": small.i_q_a, "Fd": psi_d, "Fq": psi_q},
        "vectors transposed": {"Id": small.i_d_a, "Iq": small.i_q_a, "Fd": psi_d.T, "Fq": psi_q.T},
        "meshgrid xy": {"id": i_d.T, "iq": i_q.T, "psi_d": psi_d.T, "psi_q": psi_q.T},
        "falling axis": {"id": i_d[::-1], "iq": i_q[::-1], "psi_d": psi_d[::-1], "psi_q": psi_q[::-1]},
    }


FORMS = ["complex", "complex transposed", "vectors", "vectors transposed", "meshgrid xy", "falling axis"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("suffix", ["npz", "mat"])
def test_foreign_forms(tmp_path, small, form, suffix):
    path = tmp_path / f"map.{suffix}"
    arrays = foreign(small)[form]
    if suffix == "npz":
        np.savez(path, **arrays)
    else:
        savemat(path, arrays)
    found = load_flux_map(path)
    assert_same_grid(found, small)
    assert bool(found.meta.get("notes")) == (form not in ("complex", "vectors"))  # every turn is told


def test_matlab_struct(tmp_path, small):
    path = tmp_path / "map.mat"
    savemat(path, {"motor": {"FluxMap": foreign(small)["vectors"], "name": "x"}})
    assert_same_grid(load_flux_map(path), small)


def test_a_square_foreign_map_is_judged_by_its_slopes(tmp_path):
    full = saturated_pmsyrm_map()
    for flip in (False, True):
        path = tmp_path / f"{flip}.npz"
        psi_d, psi_q = (full.psi_d_wb.T, full.psi_q_wb.T) if flip else (full.psi_d_wb, full.psi_q_wb)
        np.savez(path, Id=full.i_d_a, Iq=full.i_q_a, Fd=psi_d, Fq=psi_q)
        found = load_flux_map(path)
        assert_same_grid(found, full)
        assert bool(found.meta.get("notes")) == flip


def test_csv_in_any_order_and_other_units(tmp_path, small):
    lines = flux_map_csv(small).splitlines()
    body = [line.split(",") for line in lines[2:-1]]
    rows = [f"{i_q};{float(psi_q) * 1e3!r};{i_d};x;{float(psi_d) * 1e3!r}" for i_d, i_q, psi_d, psi_q in body[::-1]]
    path = tmp_path / "map.csv"
    path.write_text("\n".join(["iq;psi_q;id;comment;psi_d", "A;mVs;Apk;;mWb", *rows]))
    found = load_flux_map(path)
    assert np.array_equal(found.i_d_a, small.i_d_a)
    assert np.allclose(found.psi_d_wb, small.psi_d_wb, rtol=1e-15, atol=0)
    assert np.allclose(found.psi_q_wb, small.psi_q_wb, rtol=1e-15, atol=1e-18)


def test_rms_currents_in_the_unit_row(tmp_path, small):
    text = flux_map_csv(small).replace("A,A,Wb,Wb", "Arms,Arms,Wb,Wb")
    path = tmp_path / "map.csv"
    path.write_text(text)
    assert np.allclose(load_flux_map(path).i_d_a, small.i_d_a * np.sqrt(2), rtol=1e-15)


# -- holes ------------------------------------------------------------------------------------------------------------


def test_holes_are_named_and_filled_on_request(tmp_path, small):
    psi_d = small.psi_d_wb.copy()
    psi_d[2, 3] = psi_d[0, 0] = np.nan
    path = tmp_path / "map.npz"
    np.savez(path, i_d_a=small.i_d_a, i_q_a=small.i_q_a, psi_d_wb=psi_d, psi_q_wb=small.psi_q_wb)
    with pytest.raises(ConfigError, match="2 of 63 nodes are holes") as caught:
        load_flux_map(path)
    assert f"({small.i_d_a[0]:g}, {small.i_q_a[0]:g}) A" in str(caught.value)
    assert read_flux_map(path).grid.holes.sum() == 2
    found = load_flux_map(path, fill=True)
    assert np.all(np.isfinite(found.psi_d_wb))
    assert "2 of 63" in found.meta["repairs"][0]
    kept = np.isfinite(psi_d)
    assert np.array_equal(found.psi_d_wb[kept], psi_d[kept])


def test_missing_rows_of_a_csv_are_holes(tmp_path, small):
    lines = flux_map_csv(small).splitlines()
    path = tmp_path / "map.csv"
    path.write_text("\n".join(lines[:20] + lines[23:]))
    with pytest.raises(ConfigError, match="3 of 63 nodes are holes"):
        load_flux_map(path)


# -- bad files ---------------------------------------------------------------------------------------------------------


HEAD = "i_d_a,i_q_a,psi_d_wb,psi_q_wb\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is empty"),
        ("a,b\n1,2\n", "first row must name"),
        (HEAD, "holds no points"),
        (HEAD + "0,0,0.1,zero\n", "'zero' in psi_q_wb is not a number"),
        (HEAD + "0,0,0.1,0\n0,1,0.1\n", "ends before psi_q_wb"),
        (HEAD + "0,0,0.1,0\n0,,0.1,0\n", "ends before i_q_a"),
        (HEAD + "0,0,0.1,0\n0,0,0.1,0\n", "given twice"),
        (HEAD + "A,A,Wb,V\n0,0,0.1,0\n", "unit row: 'V'"),
        (HEAD + "inf,0,0.1,0\n", "not finite"),
        (HEAD + "".join(f"{k},{k * k},0,0\n" for k in range(20)), "not a grid"),
        (HEAD + '0,0,0.1,0\n# {"kind"', "not JSON"),
    ],
)
def test_a_bad_csv_says_why(tmp_path, text, says):
    path = tmp_path / "map.csv"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_flux_map(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


def good(small):
    return {name: getattr(small, name) for name in ("i_d_a", "i_q_a", "psi_d_wb", "psi_q_wb")}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"psi_q_wb": None}, "holds no psi_q_wb"),
        ({"psi_q_wb": np.array(["a"])}, "not numeric"),
        ({"psi_q_wb": np.zeros((3, 3))}, "not one grid"),
        ({"Fd": np.zeros((7, 9))}, "two arrays could be psi_d_wb"),
        ({"i_d_a": np.array([-26.0, -18.0, -10.0, -12.0, 6.0, 14.0, 22.0])}, "does not increase"),
        ({"kind": np.array("quintic")}, "'quintic'"),
        ({"meta": np.array("{")}, "meta is not JSON"),
        ({"meta": np.array("[1, 2]")}, "meta is not JSON with names"),
        ({"inverse_nodes": np.array([2, 2])}, "inverse_nodes is 2"),
        ({"inverse_nodes": np.array([64])}, "not two whole numbers"),
        ({"inverse_nodes": np.array(["a", "b"])}, "not two whole numbers"),
    ],
)
def test_a_bad_npz_says_why(tmp_path, small, change, says):
    path = tmp_path / "map.npz"
    arrays = {name: value for name, value in {**good(small), **change}.items() if value is not None}
    np.savez(path, **arrays)
    with pytest.raises(ConfigError) as caught:
        load_flux_map(path)
    assert says in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_warped_grid_is_refused(tmp_path, small):
    i_d, i_q = np.meshgrid(small.i_d_a, small.i_q_a, indexing="ij")
    path = tmp_path / "map.npz"
    np.savez(path, id=i_d + 0.01 * i_q, iq=i_q, psi_d=small.psi_d_wb, psi_q=small.psi_q_wb)
    with pytest.raises(ConfigError, match="not on a rectangular grid"):
        load_flux_map(path)


@pytest.mark.parametrize("suffix", ["npz", "mat", "csv"])
def test_truncated_files(tmp_path, small, suffix):
    path = tmp_path / f"map.{suffix}"
    if suffix == "mat":
        savemat(path, good(small))
    else:
        path.write_bytes(flux_map_npz(small) if suffix == "npz" else flux_map_csv(small).encode())
    data = path.read_bytes()
    for share in (0.05, 0.5, 0.95):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(ConfigError):
            load_flux_map(path)


@pytest.mark.parametrize("suffix", ["npz", "mat", "csv"])
def test_missing_files(tmp_path, suffix):
    with pytest.raises(ConfigError, match="no such file"):
        load_flux_map(tmp_path / f"none.{suffix}")


def test_other_suffixes(tmp_path):
    with pytest.raises(ConfigError, match="no flux-map format"):
        load_flux_map(tmp_path / "map.xlsx")


@pytest.mark.skipif(not MEASURED_MAP.is_file(), reason="the measured map is not on this machine")
def test_a_measured_complex_map():
    found = load_flux_map(MEASURED_MAP)
    with np.load(MEASURED_MAP) as archive:
        assert np.array_equal(found.psi_d_wb, archive["psi_s_dq"].real)
    assert (found.i_d_a[0], found.i_q_a[-1]) == (-20.0, 26.0)
