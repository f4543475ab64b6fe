"""Beds of spheres from files: what LIGGGHTS 3.8.0 and LAMMPS wrote (tests/run/beds), and others made here. Beds that
overlap as soft contacts do are opened without a speed."""

from __future__ import annotations

import base64
import gzip
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial import cKDTree

import pctt
from dem.scene import Scene
from dem.shapes import Plane
from pctt.beds import read_spheres
from pctt.options import OptionError

BEDS = Path(__file__).parent / "beds"
HALF = 0.02  # m; half the width of the box of the bed of LIGGGHTS


def written(tmp_path, text, name="bed"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


# -- files of LIGGGHTS and LAMMPS ------------------------------------------------------------------------------


def test_data_and_dump_of_liggghts_hold_the_same_bed():
    data, dump = read_spheres(BEDS / "liggghts.data.gz"), read_spheres(BEDS / "liggghts.dump.gz")
    assert set(data) == set(dump) == {"positions", "radius", "density", "velocity", "angular_velocity", "material"}
    for name, error in (("positions", 1e-7), ("radius", 0), ("density", 0.01), ("velocity", 1e-8)):
        assert data[name] == pytest.approx(dump[name], abs=error)  # dumps have six digits
    assert np.bincount(np.round(1e3 * data["radius"]).astype(int)).tolist()[4:] == [
        data["material"].count("type 2"),
        data["material"].count("type 1"),
    ]
    assert np.abs(data["positions"][:, :2]).max() < HALF
    assert data["density"] == pytest.approx(2500.0)


def test_one_type_of_the_spheres_becomes_one_material_of_a_scene():
    scene, big = Scene(0.4), read_spheres(BEDS / "liggghts.data.gz", type=1)
    assert (big["radius"] == 0.005).all()
    scene.add_spheres(**read_spheres(BEDS / "liggghts.data.gz"))
    scene.set_pair("type 1", "type 2", friction=0.1)
    grains = scene.grains()
    names = [scene.materials[number] for number in grains.material]
    assert names == read_spheres(BEDS / "liggghts.data.gz")["material"]
    assert (scene.grains(30, 50).material == grains.material[30:50]).all()
    assert grains.mass == pytest.approx(2500 * 4 / 3 * np.pi * grains.size[:, 0] ** 3)


def test_places_of_a_tilted_cell_are_the_same_scaled_or_not(tmp_path):
    whole = (BEDS / "lammps_tilted.dump").read_text()
    plain = read_spheres(BEDS / "lammps_tilted.dump", frame=0)
    of_data = read_spheres(BEDS / "lammps_hybrid.data")
    scaled = read_spheres(written(tmp_path, whole.replace(" x y z ", " a b c ").replace(" xu yu zu ", " d e f ")))
    assert plain["positions"] == pytest.approx(of_data["positions"], abs=1e-5)
    assert plain["positions"] == pytest.approx(scaled["positions"], abs=1e-5)
    assert plain["density"] == pytest.approx(of_data["density"], rel=1e-5)  # of mass and radius
    assert of_data["radius"] == pytest.approx(0.05)


def test_a_frame_of_a_dump_is_chosen(tmp_path):
    frame = "ITEM: TIMESTEP\n{0}\nITEM: NUMBER OF ATOMS\n1\nITEM: ATOMS x y z diameter density\n{0} 0 1 .2 900\n"
    path = written(tmp_path, "".join(frame.format(k) for k in range(4)))
    assert [read_spheres(path, frame=k)["positions"][0, 0] for k in (0, 2, -1)] == [0, 2, 3]
    with pytest.raises(ValueError, match=r"frame 4: the file has 4; allowed is -4 to 3"):
        read_spheres(path, frame=4)
    with pytest.raises(ValueError, match=r"frame 0.5: allowed is a whole number, -1 for the last one"):
        read_spheres(path, frame=0.5)


# -- other files ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [
    "#format x_y_z_r_matId\n{0}\t{1}\t{2}\t{3}\t1\n",
    "# spheres of a packing\n\n{0} {1} {2} {3}\n",
    '"Points:0","Points:1","Points:2",radii\n{0},{1},{2},{3}\n',
    "id;x [mm]; y [mm];z [mm];Diameter (mm)\n1;{0};{1};{2};{4}\n",
    "\ufeffx y z r\r\n{0} {1} {2} {3}\r\n",
    "# a packing\n# x y z diameter\n{0} {1} {2} {4}\n",
    "# id x [mm] y [mm] z [mm] radius (mm)\n1 {0} {1} {2} {3}\n",
    "#columns: radius, x, y, z\n{3},{0},{1},{2}\n",
    "# spheres with x y z radius\n{0} {1} {2} {3}\n",
    "# diameter and place x y z of spheres\n{4} {0} {1} {2}\n",
])  # fmt: skip
def test_tables_of_yade_paraview_and_others(tmp_path, text):
    found = read_spheres(written(tmp_path, text.format(3.0, -4.0, 5.5, 0.25, 0.5)), density=1200.0, length=1e-3)
    assert found["positions"] == pytest.approx(np.array([[3e-3, -4e-3, 5.5e-3]]))
    assert found["radius"] == pytest.approx([0.25e-3])
    assert found["density"] == 1200.0


@pytest.mark.parametrize("data", [
    "x,y,z,r,type\n0,0,0,1,1.0\n3,0,0,1,2.0\n6,0,0,1,clay\n",
    "# x y z r type\n0 0 0 1 1.000e+00\n3 0 0 1 2.000e+00\n6 0 0 1 clay\n",
])  # fmt: skip
def test_types_that_are_whole_numbers_are_called_so(tmp_path, data):
    path = written(tmp_path, data)
    assert read_spheres(path, density=1.0)["material"] == ["type 1", "type 2", "clay"]
    for type_ in (2, 2.0, "2"):
        assert read_spheres(path, density=1.0, type=type_)["positions"][:, 0].tolist() == [3.0]


X, R = np.arange(12.0).reshape(4, 3), np.array([0.1, 0.2, 0.3, 0.4])


def legacy(binary, cells_first=False):
    def block(array, kind):
        return array.astype(kind).tobytes() + b"\n" if binary else " ".join(map(str, array.ravel())).encode() + b"\n"

    cells = np.array([[1, k] for k in range(4)])
    form = b"BINARY" if binary else b"ASCII"
    of_cells = b"CELL_DATA 2\nSCALARS radius float\nLOOKUP_TABLE default\n" + block(np.array([7.0, 8.0]), ">f4")
    return b"".join([
        b"# vtk DataFile Version 3.0\nspheres\n" + form + b"\nDATASET POLYDATA\n",
        b"POINTS 4 double\n" + block(X, ">f8") + b"VERTICES 4 8\n" + block(cells, ">i4"),
        of_cells * cells_first + b"POINT_DATA 4\nSCALARS radius float\nLOOKUP_TABLE default\n" + block(R, ">f4"),
        b"VECTORS velocity double\n" + block(-X, ">f8") + b"FIELD FieldData 2\n",
        b"mass 1 4 double\n" + block(7 * R**3, ">f8") + b"kind 1 4 int\n" + block(cells[:, 1], ">i4"),
    ])


def in_xml(form, packed=False, word="<u4"):
    def bytes_of(array):
        raw = array.astype("<f8").tobytes()
        if not packed:
            return np.array(len(raw), word).tobytes() + raw, b""
        parts = [zlib.compress(raw[:40]), zlib.compress(raw[40:])] if len(raw) > 40 else [zlib.compress(raw)]
        rest = len(raw) - 40 if len(raw) > 40 else 0
        return np.array([len(parts), 40, rest, *map(len, parts)], word).tobytes(), b"".join(parts)

    arrays, appended = {"Points": X, "radius": R, "velocity": -X, "mass": 7 * R**3}, b""
    texts = {}
    for name, array in arrays.items():
        given = f'type="Float64" Name="{name}" NumberOfComponents="{array.size // 4}" format="{form[0]}"'
        blocks = [block if form[1] == "raw" else base64.b64encode(block) for block in bytes_of(array)]
        body = " ".join(map(str, array.ravel())) if form[0] == "ascii" else b"".join(blocks).decode("latin1")
        if form[0] == "appended":
            given, body, appended = f'{given} offset="{len(appended)}"', "", appended + b"".join(blocks)
        texts[name] = f"<DataArray {given}>{body}</DataArray>"
    points, data = texts.pop("Points"), "".join(texts.values())
    compressor = ' compressor="vtkZLibDataCompressor"' * packed
    header = {"<u4": "UInt32", "<u8": "UInt64"}[word]
    start = '<?xml version="1.0"?>\n<VTKFile type="PolyData" byte_order="LittleEndian" '
    start += f'header_type="{header}"{compressor}>'
    piece = f"<PolyData><Piece><PointData>{data}</PointData><Points>{points}</Points></Piece></PolyData>"
    end = f'<AppendedData encoding="{form[1]}">_'.encode() + appended + b"</AppendedData>" if appended else b""
    return (start + piece).encode() + end + b"</VTKFile>"


@pytest.mark.parametrize("data", [
    legacy(False), legacy(True), legacy(False, True), legacy(True, True),
    in_xml(("ascii", "")), in_xml(("binary", "base64")), in_xml(("binary", "base64"), True),
    in_xml(("appended", "raw"), word="<u8"), in_xml(("appended", "raw"), True),
    in_xml(("appended", "base64"), True, "<u8"),
], ids=range(10))  # fmt: skip
def test_points_of_vtk_files(tmp_path, data):
    found = read_spheres(written(tmp_path, data))
    assert found["positions"] == pytest.approx(X)
    assert found["radius"] == pytest.approx(R)
    assert found["velocity"] == pytest.approx(-X)
    assert found["density"] == pytest.approx(7 / (4 / 3 * np.pi))


DUMP = "ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n1\nITEM: ATOMS {0} radius density\n1 1 1 1 1\n"


@pytest.mark.parametrize(("text", "given", "words"), [
    ("x,y,z\n1,2,3\n", {}, r"bed: has no radius or diameter; its columns are x, y, z; give radius= in metres"),
    ("x,y,z,r\n1,2,3,4\n", {}, r"has no density or mass; .* give density= in kg/m\^3"),
    ("x,y,z,r\n1,2,3,4\n1,nan,3,4\n", {"density": 1}, r"line 3: y is nan; allowed is a finite number"),
    ("x,y,z,r\n1,2,3,4\n1,2,3,-4\n", {"density": 1}, r"line 3: radius is -4; allowed is a positive number"),
    ("x,y,z,r\n1,2,3,4\n1,2,three,4\n", {"density": 1}, r"line 3: z is 'three', no number"),
    ("x,y,z,r\n1,2,3,4\n1,2", {"density": 1}, r"line 3: 2 values where 4 are needed .*truncated"),
    ("x,y,z,r\n1,2,3,4\n1,2\n", {"density": 1}, r"line 3: 2 values where 4 are needed \(x y z r\)$"),
    ("x,y,z,r\n1,2,3,4\n1,2,3,4,5", {"density": 1}, r"line 3: 5 values where 4 are needed \(x y z r\)$"),
    ("# spheres at x y z\n1 2 3 4\n", {"density": 1}, r"line 2: 4 values where 5 are needed \(spheres at x y z\)$"),
    ("x,y,z,r\n1,2,3,4\n", {"density": 1, "length": 0}, "length must be positive, got 0"),
    ("x,y,z,r\n1,2,3,4\n", {"density": 1, "length": -1}, "length must be positive, got -1"),
    ("x [mm],y [mm],z [mm],r [mm]\n1,2,3,4\n", {"density": 1}, r"its heading has \[mm\]; give length="),
    ("1,2,3\n", {"density": 1}, "has no radius or diameter; its columns are x, y, z; give radius="),
    ("x,y,z,r\n1,2,3,4\n", {"density": 1, "type": 2}, r"type 2: has no type; its columns are x, y, z, radius"),
    ("x,y,z,r,type\n1,2,3,4,5\n", {"density": 1, "type": 2}, r"type 2: no sphere has it; there are 5"),
    ("", {}, r"bed: has no sphere"),
    (DUMP.format("xs ys z"), {}, r"bed: line 5: xs needs ys and zs; the columns are xs, ys, z, radius, density"),
    (DUMP.format("x ys zs"), {}, r"bed: has no x, y, z; its columns are x, ys, zs, radius, density"),
    (b"\0\1\2", {}, r"a binary file that is no VTK; .*binary2txt"),
    ("LAMMPS\n\n3 atoms\n\nAtoms # tri\n\n1 1 1\n", {}, r"line 5: atoms of style tri; allowed is one of sphere"),
])  # fmt: skip
def test_a_bad_file_is_told_with_its_line(tmp_path, text, given, words):
    with pytest.raises(ValueError, match=words):
        read_spheres(written(tmp_path, text), **given)


@pytest.mark.parametrize("name", ["liggghts.data.gz", "liggghts.dump.gz", "lammps_hybrid.data", "vtk"])
def test_a_truncated_file_is_refused_wherever_it_ends(tmp_path, name):
    whole = legacy(True)[:-20] if name == "vtk" else (BEDS / name).read_bytes()
    whole = gzip.decompress(whole) if name.endswith("gz") else whole
    for part in np.random.default_rng(5).uniform(0.15, 0.97, 20):
        path = written(tmp_path, whole[: int(part * len(whole))])
        with pytest.raises(ValueError, match=r"^\S*bed: .*(truncated|needed|no points|has no|allowed is)"):
            read_spheres(path)
    with pytest.raises(ValueError, match="compressed file is truncated"):
        read_spheres(written(tmp_path, (BEDS / "liggghts.data.gz").read_bytes()[:3000]))


# -- overlaps of soft beds -----------------------------------------------------------------------------------


def soft_bed():
    scene = Scene(0.4)
    scene.add_spheres(**read_spheres(BEDS / "liggghts.data.gz"))
    walls = [Plane(side * np.eye(3)[k], -side * HALF * np.eye(3)[k]) for k in (0, 1) for side in (-1, 1)]
    scene.add_body("box", [Plane((0, 0, 1)), *walls])
    return scene


def worst_overlap(positions, radius):
    """Over the smaller radius, of pairs."""
    pairs = cKDTree(positions).query_pairs(2 * radius.max(), output_type="ndarray")
    apart = np.linalg.norm(positions[pairs[:, 0]] - positions[pairs[:, 1]], axis=1)
    return float(((radius[pairs].sum(axis=1) - apart) / radius[pairs].min(axis=1)).max())


def test_a_bed_of_liggghts_is_opened_without_a_speed():
    given, scene = read_spheres(BEDS / "liggghts.data.gz"), soft_bed()
    assert worst_overlap(given["positions"], given["radius"]) > 0.03
    with pytest.raises(OptionError, match=r"overlapping start: grain \d+ and grain \d+ .* where 0.01 are allowed"):
        pctt.Simulation(soft_bed())
    sim = pctt.Simulation(scene, overlap="relax")
    assert (sim.time, sim.steps) == (0.0, 0)
    assert worst_overlap(sim.positions, given["radius"]) < 2e-3
    assert sim.velocities == pytest.approx(np.hstack([given["velocity"], given["angular_velocity"]]))
    assert np.abs(sim.positions - given["positions"]).max() < 0.5 * given["radius"].min()
    fall = 9.81 * (scene.grains().mass * given["radius"]).sum()
    seen = []
    sim.run(steps=20, call=lambda sim: seen.append((sim.kinetic_energy, sim.figures["worst_overlap [m]"])))
    assert max(seen)[0] < 0.03 * fall
    assert max(overlap for _, overlap in seen) < 5e-3 * given["radius"].min()


def test_an_overlap_is_allowed_up_to_the_number_given():
    assert pctt.Simulation(soft_bed(), overlap=0.05, dt=1e-3).settings.overlap == "0.05"
    with pytest.raises(OptionError, match="overlap much: allowed is a number >= 0, or relax"):
        pctt.Simulation(soft_bed(), overlap="much")


def test_spheres_without_room_are_told():
    scene = Scene(0.4)
    scene.add_spheres([[0, 0, z] for z in (0.1, 0.29, 0.48)], 0.1, 1000.0)
    scene.add_body("press", [Plane((0, 0, 1)), Plane((0, 0, -1), (0, 0, 0.58))])
    scene.add_body("sides", [Plane(s * np.eye(3)[k], -s * 0.1 * np.eye(3)[k]) for k in (0, 1) for s in (-1, 1)])
    with pytest.raises(OptionError, match="overlap relax: there is no room to push bodies apart"):
        pctt.Simulation(scene, overlap="relax")


def test_an_overlap_has_no_effect_on_a_checkpoint_and_that_is_told(tmp_path):
    """It is not refused: the program that made the checkpoint goes on."""
    given = {"overlap": "relax", "dt": 1e-3}
    pctt.Simulation(soft_bed(), **given).save(tmp_path / "bed.h5")
    with pytest.warns(UserWarning, match="overlap='relax' has no effect, as the simulation goes on from a checkpoint"):
        loaded = pctt.Simulation.load(tmp_path / "bed.h5", soft_bed(), **given)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded.copy()
        loaded.reset()


@pytest.mark.parallel(2)
def test_ranks_open_overlaps_as_one_does():
    alone = pctt.Simulation(soft_bed(), comm=MPI.COMM_SELF, overlap="relax", tol=1e-8)
    shared = pctt.Simulation(soft_bed(), overlap="relax", tol=1e-8)
    assert shared.positions == pytest.approx(alone.positions, abs=1e-5)
    assert shared.velocities == pytest.approx(alone.velocities, abs=1e-12)


def test_places_alone_take_the_radius_that_is_given(tmp_path):
    found = read_spheres(written(tmp_path, "0 0 1\n0 2 3\n"), density=1200.0, radius=0.1)
    assert found["positions"].tolist() == [[0, 0, 1], [0, 2, 3]]
