"""Kinds of files that programs and people write, many of each: read right, or refused in one line; never a guess."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from idam.errors import InputError
from idam.io import move_file, read_point_cloud

TWO = [[10.5, 20.5, 30.5], [11.5, 21.5, 31.5]]
ROWS = [["10.5", "20.5", "30.5"], ["11.5", "21.5", "31.5"]]


def read(folder: Path, content: bytes | str, name: str = "a.csv") -> np.ndarray:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return read_point_cloud(folder / name).points


def refused(folder: Path, content: bytes | str, name: str = "a.csv") -> str:
    with pytest.raises(InputError) as error:
        read(folder, content, name)
    message = str(error.value).removeprefix(f"{folder / name}: ")
    assert message.isprintable() and len(message) < 400 and ("damaged" in message or ":" in message)
    assert not any(word in message for word in ("object", "attribute", "np.", "local variable", "not defined"))
    return message


def table(names: list[str], rows: list[list[str]], separator: str = ",") -> str:
    return "".join(separator.join(row) + "\n" for row in [names, *rows])


# --- how columns stand apart, and what is a comment ------------------------------------------------------------------

SEPARATORS = [" ", "\t", ",", ";", "|", "  ", " \t ", ", ", "; ", " , ", " | "]


@pytest.mark.parametrize("separator", SEPARATORS)
def test_separators_with_and_without_names_and_at_the_end(tmp_path: Path, separator: str) -> None:
    lines = [separator.join(row) for row in ROWS]
    names = separator.join("xyz")
    for rows in (lines, [names, *lines], [f"{line}{separator}" for line in (names, *lines)]):
        np.testing.assert_array_equal(read(tmp_path, "\n".join(rows) + "\n"), TWO)


@pytest.mark.parametrize("mark", ["#", "##", "//", "%", "!", ";"])
def test_comments(tmp_path: Path, mark: str) -> None:
    first, second = (" ".join(row) for row in ROWS)
    for comment in ("made by hand", "1 2 3", "points: 2, of 2020-01-01"):
        np.testing.assert_array_equal(read(tmp_path, f"{mark} {comment}\n{first}\n{mark} {comment}\n{second}\n"), TWO)
    swapped = f"{mark} id y x z\n5 20.5 10.5 30.5\n9 21.5 11.5 31.5\n"
    np.testing.assert_array_equal(read(tmp_path, swapped, "a.txt"), TWO)


@pytest.mark.parametrize("mark", ["*", "--", "'", "REM", "$", "@", "/*"])
def test_what_no_program_starts_comments_with_is_refused(tmp_path: Path, mark: str) -> None:
    refused(tmp_path, f"{mark} made by hand\n10.5 20.5 30.5\n11.5 21.5 31.5\n")


ENDS = ["\n", "\r\n", "\r", "\n\r", "\r\r\n", "\x0b", "\x0c", "\u2028"]


@pytest.mark.parametrize("end", ENDS)
def test_line_ends(tmp_path: Path, end: str) -> None:
    for separator in ", ":
        content = end.join(["x y z".replace(" ", separator), *(separator.join(row) for row in ROWS)])
        np.testing.assert_array_equal(read(tmp_path, content), TWO)
        np.testing.assert_array_equal(read(tmp_path, content + end + "\x1a"), TWO)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "latin-1", "cp1252"])
def test_encodings(tmp_path: Path, encoding: str) -> None:
    content = "Rechtswert;Hochwert;Höhe [m]\n10,5;20,5;30,5\n11,5;21,5;1.#IND\n11,5;21,5;31,5\n"
    np.testing.assert_array_equal(read(tmp_path, content.encode(encoding)), TWO)


# --- names -----------------------------------------------------------------------------------------------------------

NAMES = [
    "X,Y,Z", " x , y , z ", "//X,Y,Z", "#X,Y,Z", "%X,Y,Z", "<X>,<Y>,<Z>", "[x],[y],[z]", "_x,_y,_z", ".x,.y,.z",
    "X [m],Y [m],Z [m]", "X(m),Y(m),Z(m)", "x in m,y in m,z in m", "X / m,Y / m,Z / m", "X_m,Y_m,Z_m", "X,Y,Z [m]",
    "posX,posY,posZ", "position.x,position.y,position.z", "position[0],position[1],position[2]", "px,py,pz",
    "Points:0,Points:1,Points:2", "Points_0,Points_1,Points_2", "coords_0,coords_1,coords_2", "X_UTM,Y_UTM,Z_UTM",
    "UTM_X,UTM_Y,UTM_Z", "X-coord,Y-coord,Z-coord", "X Coordinate,Y Coordinate,Z Coordinate", "cartesianX,cartesianY,cartesianZ",
    "xcoord,ycoord,zcoord", "POINT_X,POINT_Y,POINT_Z", "field.x,field.y,field.z", "X坐标,Y坐标,Z坐标",
    "Coordonnée X,Coordonnée Y,Coordonnée Z", "X_Axis,Y_Axis,Z_Axis", "X-Wert,Y-Wert,Z-Wert", "scan_x,scan_y,scan_z",
    "Easting,Northing,Height", "EASTING (US ft),NORTHING (US ft),ALTITUDE (US ft)", "E,N,H", "East,North,Elev",
    "Rechts,Hoch,Höhe", "Rechtswert,Hochwert,Hoehe", "Ost,Nord,Höhe", "Este,Norte,Cota", "Est,Nord,Quota",
    "X,Y,Elevation", "X,Y,Height", "X,Y,H",
]  # fmt: skip


@pytest.mark.parametrize("names", NAMES)
def test_names_of_coordinates(tmp_path: Path, names: str) -> None:
    separated = names.removeprefix("//").removeprefix("#").removeprefix("%").split(",")
    mark = names[: names.index(separated[0])]
    np.testing.assert_array_equal(read(tmp_path, f"{names}\n" + table([], ROWS)[1:]), TWO)
    numbered = [["7.25", *row] for row in ROWS]  # a further column in front: only the names tell
    np.testing.assert_array_equal(read(tmp_path, mark + table(["q", *separated], numbered)), TWO)
    order = [1, 2, 0]
    moved = [[row[place] for place in order] for row in ROWS]
    np.testing.assert_array_equal(read(tmp_path, mark + table([separated[place] for place in order], moved)), TWO)
    assert "names 3 columns but its rows hold 4" in refused(tmp_path, names + "\n" + table([], numbered)[1:])
    tabbed = mark + table([name.strip() for name in separated], ROWS, "\t")
    np.testing.assert_array_equal(read(tmp_path, tabbed, "a.txt"), TWO)


@pytest.mark.parametrize(
    "names", ["V1,V2,V3", "Column1,Column2,Column3", "x1,x2,x3", "nx,ny,nz", "i,j,k", "theta,phi,r", "x,y,depth", "x,y",
              "lon,lat,h", "Latitude,Longitude,Altitude", "0,1,2", "vx,vy,vz", "range,azimuth,elevation"],
)  # fmt: skip
def test_names_of_something_else_are_refused(tmp_path: Path, names: str) -> None:
    refused(tmp_path, table(names.split(","), ROWS))


TWO_COORDINATES = [
    "easting,east,northing,height", "easting,northing,elevation,height", "X [m],Y [m],Z [m],X [ft],Y [ft],Z [ft]",
    "pos_x,pos_y,pos_z,utm_x,utm_y,utm_z", "x,y,z,x", "x,y,z,X", "east,north,alt,altitude", "x,y,z (m),z (ft)",
]  # fmt: skip


@pytest.mark.parametrize("names", TWO_COORDINATES)
def test_two_columns_that_may_be_one_coordinate_are_refused(tmp_path: Path, names: str) -> None:
    width = len(names.split(","))
    refused(tmp_path, table(names.split(","), [["1.5"] * width, ["2.5"] * width]))


@pytest.mark.parametrize(
    "names",
    ["easting,northing,height,x,y,z", "utm_x,utm_y,utm_z,x,y,z", "nx,ny,nz,x,y,z", "Points:0,Points:1,Points:2,x,y,z"],
)
def test_plain_x_y_z_count_before_all_others(tmp_path: Path, names: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, table(names.split(","), [["1", "0", "0", *row] for row in ROWS])), TWO)


INDEX = ["", "id", "index", "Unnamed: 0", "No.", "pt", "Point ID", "n", "fid", "OBJECTID", "vertexId", "q"]


@pytest.mark.parametrize("name", INDEX)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_columns_that_number_the_rows(tmp_path: Path, name: str, separator: str) -> None:
    for first in (["0", "1"], ["P1", "P2"]):
        rows = [[number, *row] for number, row in zip(first, ROWS, strict=True)]
        np.testing.assert_array_equal(read(tmp_path, table([name, "x", "y", "z"], rows, separator)), TWO)


def test_names_that_pandas_makes_up(tmp_path: Path) -> None:
    rows = [[str(number), *row] for number, row in enumerate(ROWS)]
    np.testing.assert_array_equal(read(tmp_path, table(["", "0", "1", "2"], rows)), TWO)
    assert "(0 1 2) may be a point" in refused(tmp_path, table(["0", "1", "2"], ROWS))
    assert len(read(tmp_path, "0 1 2\n3 4 5\n6 7 8\n")) == 3


@pytest.mark.parametrize("units", ["[m],[m],[m]", "m,m,m", "(mm),(mm),(mm)", "m,m,m,"])
def test_a_line_of_units(tmp_path: Path, units: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, "X,Y,Z\n" + units + "\n" + table([], ROWS)[1:]), TWO)
    assert "different units" in refused(tmp_path, "X,Y,Z\nm,m,mm\n" + table([], ROWS)[1:])


# --- columns without names -------------------------------------------------------------------------------------------

GRID = [(row, column) for row in range(3) for column in range(4)]
NO_NAMES = {
    "numbers from 0": [f"{n} {n + 0.5} {n * 0.7 + 0.1} 30.5" for n in range(5)],
    "numbers from 100": [f"{100 + n} {n + 0.5} {n * 0.7 + 0.1} 30.5" for n in range(5)],
    "numbers and whole heights": [f"{100 + n} {n + 0.5} {n * 0.7 + 0.1} 30" for n in range(5)],
    "two rows": [f"{n} {n + 0.5} {n * 0.7 + 0.1} 30.5" for n in range(2)],
    "numbers downwards": [f"{9 - n} {n + 0.5} {n * 0.7 + 0.1} 30.5" for n in range(5)],
    "numbers with gaps": [f"{n * n} {n + 0.5} {n * 0.7 + 0.1} 30.5" for n in range(5)],
    "numbers and a code": [f"{5 + n} {n + 0.5} {n * 0.7 + 0.1} 30.5 TREE" for n in range(5)],
    "labels": [f"{n % 3} 10.5 {n + 0.5} {n * 0.7 + 0.1}" for n in range(6)],
    "times": [f"{1.6e9 + n / 10:.6f} 10.5 {n + 0.5} 30.5 0 0 0 1" for n in range(6)],
    "times in milliseconds": [f"{1600000000000 + n * 100} 10 {n + 0.5} 30.5" for n in range(6)],
    "rows and columns": [f"{r} {c} {r + 0.5} {c + 0.25} {r * c + 0.125} 10 20 30" for r, c in GRID],
    "columns and rows": [f"{c} {r} {r + 0.5} {c + 0.25} {r * c + 0.125} 0.5" for r, c in GRID],
    "rows and columns with gaps": [f"{r} {c} {r + 0.5} {c + 0.25} 1.5" for r, c in GRID if (7 * r + c) % 3],
    "rows and columns shuffled": [f"{r} {c} {r + 0.5} {c + 0.25} 1.5" for r, c in sorted(GRID, key=lambda g: g[0] * 7 % 3 + g[1] * 5 % 4)],
    "three rows of coordinates": [" ".join(str(axis * 7.5 + n * 1.25) for n in range(40)) for axis in range(3)],
    "all in one line": [" ".join(str(n * 1.25) for n in range(60))],
    "thousands": ["1,010.5,2,020.5,3,030.5", "1,011.5,2,021.5,3,031.5"],
    "thousands in part": ["412,341.066,5,412,336.049,350.2", "412,342.566,5,412,337.549,351.7"],
    "decimal commas": ["10,1234,20,1234,30,1234", "-11,1234,21,1234,31,1234"],
    "decimal commas and spaces": ["10,5, 20,5, 30,5", "11,5, 21,5, 31,5"],
}  # fmt: skip


@pytest.mark.parametrize("kind", NO_NAMES)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_columns_without_names_that_may_not_be_x_y_z(tmp_path: Path, kind: str, end: str) -> None:
    refused(tmp_path, end.join([*NO_NAMES[kind], ""]), "a.txt")


PLAIN = {
    "whole numbers": ["1 2 3", "4 5 6", "7 8 10"],
    "a profile": [f"{n} {n * n % 7 / 4} 0.5" for n in range(6)],
    "intensity": [f"{n / 4} {n * n % 7 / 4} 0.5 {n}" for n in range(6)],
    "a label last": [f"{n} {n * n % 7} 0.5 {n % 2}" for n in range(0, 12, 2)],
    "colours": ["10.5,20.5,30.5,255,255,255", "11.5,20.5,30.5,100,200,255"],
    "UTM": ["412341.066,5412336.049,350.2", "412342.066,5412336.049,351.2"],
    "UTM in millimetres": ["412341066.5,5412336049.5,350200.5,7", "412342066.5,5412337049.5,350300.5,8"],
    "three digits before the point": ["412,341.5,512.25", "413,342.5,513.25"],
}


@pytest.mark.parametrize("kind", PLAIN)
def test_columns_without_names_that_are_x_y_z(tmp_path: Path, kind: str) -> None:
    expected = [[float(word) for word in line.replace(",", " ").split()[:3]] for line in PLAIN[kind]]
    np.testing.assert_array_equal(read(tmp_path, "\n".join(PLAIN[kind])), expected)


# --- numbers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("number", ["1.05E+01", "1.05e1", "1.05D+01", "1.05d1", ".105E+02", "105e-1", "+10.5", "010.5"])
def test_numbers_of_programs(tmp_path: Path, number: str) -> None:
    for content in (f"{number} 20.5 30.5\n11.5 21.5 31.5\n", f"x;y;z\n{number};20.5;30.5\n11.5;21.5;31.5\n"):
        np.testing.assert_array_equal(read(tmp_path, content), TWO)
    np.testing.assert_array_equal(read(tmp_path, "\u221210.5 1 2\n0.5 1 2\n")[0], [-10.5, 1, 2])


@pytest.mark.parametrize(
    "number", ["10.5m", "10.5'", "$10.5", "10..5", "10.5.", "1_0.5", "(10.5)", "=10.5", "--10.5", "0x1.5p3", "10:30:00",
               "1/2", "1.05*10^1", "²", "True", "10.5j", "?", "*", "--", ".", "NaT", "n.a."],
)  # fmt: skip
def test_what_is_no_number_is_refused(tmp_path: Path, number: str) -> None:
    refused(tmp_path, f"x\ty\tz\n11.5\t21.5\t31.5\n{number}\t20.5\t30.5\n")
    refused(tmp_path, f"11.5 21.5 31.5\n10.5 {number} 30.5\n", "a.xyz")
    for name, content in TEXT_FORMATS.items():
        refused(tmp_path, content.format(number), name)


PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n"
PTX = "3\n1\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
BODY = "10.5 20.5 30.5\n1 {} 2\n11.5 21.5 31.5\n"
TEXT_FORMATS = {
    "a.ply": PLY + BODY,
    "a.pcd": PCD + BODY,
    "a.off": "OFF\n3 0 0\n" + BODY,
    "a.obj": "v 10.5 20.5 30.5\nv 1 {} 2\nv 11.5 21.5 31.5\n",
    "a.ptx": PTX + BODY.replace("\n", " 1\n"),
    "a.pts": "3\n" + BODY.replace("\n", " 1\n"),
    "a.xyz": BODY,
    "a.csv": "x,y,z,i\n" + BODY.replace(" ", ",").replace("\n", ",1\n"),
}
NAN = [
    "nan", "NaN", "-nan", "+nan", "inf", "-inf", "Infinity", "1.#QNAN", "1.#QNAN0", "-1.#IND", "-1.#IND00", "1.#INF", "1.#SNAN",
    "-1.#INF00", "1.#R", "-1.$", "1.#QO", "-1.#J", "+1.#QNAN", "nan(ind)", "-nan(ind)", "-NaN(IND)", "nan(snan)", "nan(0x7)", "#N/A", "#NV", "#WERT!", "#DIV/0!",
]  # fmt: skip


@pytest.mark.parametrize("nan", NAN)
@pytest.mark.parametrize("name", TEXT_FORMATS)
def test_numbers_that_are_none_in_every_text_format(tmp_path: Path, nan: str, name: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, TEXT_FORMATS[name].format(nan), name), TWO)
    if name.endswith(("ply", "off", "obj")):
        move_file(tmp_path / name, np.eye(4), tmp_path / f"moved-{name}")
        np.testing.assert_array_equal(read_point_cloud(tmp_path / f"moved-{name}").points, TWO)


@pytest.mark.parametrize("nan", ["-1,#IND", "1,#QNAN", "1,#INF"])
def test_numbers_that_are_none_with_a_decimal_comma(tmp_path: Path, nan: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, f"x;y;z\n10,5;20,5;30,5\n1;{nan};2\n11,5;21,5;31,5\n"), TWO)
    np.testing.assert_array_equal(read(tmp_path, f"10,5 20,5 30,5\n1 {nan} 2\n11,5 21,5 31,5\n"), TWO)


GROUPED = {
    "comma_and_point": 'x;y;z\n412,341.066;5,412,336.049;350.2\n',
    "point_and_comma": "x;y;z\n412.341,066;5.412.336,049;350,2\n",
    "space": "x;y;z\n412 341.066;5 412 336.049;350.2\n",
    "apostrophe": "412'341.066 5'412'336.049 350.2\n",
    "quoted": '"412,341.066","5,412,336.049","350.2"\n',
    "quoted_in_part": 'x,y,z\n"412,341.066","5,412,336.049",350.2\n',
    "tabs": '"412,341.066"\t"5,412,336.049"\t350.2\n',
}  # fmt: skip


@pytest.mark.parametrize("kind", GROUPED)
def test_marks_between_thousands(tmp_path: Path, kind: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, GROUPED[kind] * 1), [[412341.066, 5412336.049, 350.2]])


@pytest.mark.parametrize(
    "content",
    [
        "x;y;z\n10.5;20,5;30.5\n",
        "10.5 20,5 30.5\n",
        'x,y,z\n"4,12,341.066","5,412,336.049",350.2\n',
        "x,y,z\n412,341.066,5,412,336.049,350.2\n",
        "x,y,z\n10,5,20,5,30,5\n",
        'x,y,z\n"412,341","5,412",350\n"412,341","412",350\n'.replace("5,412", "512,336"),
        '"10.5,20.5,30.5"\n"11.5,21.5,31.5"\n',
        "[10.5, 20.5, 30.5]\n[11.5, 21.5, 31.5]\n",
        "x=10.5 y=20.5 z=30.5\n",
        "1:10.5 2:20.5 3:30.5\n",
        "<html><td>10.5</td></html>",
    ],
)
def test_marks_that_can_be_read_in_two_ways(tmp_path: Path, content: str) -> None:
    refused(tmp_path, content)


@pytest.mark.parametrize(
    "content",
    [
        "x,y,z\n10.5,20.5,30.5\n11.5,21.5,31.5,4\n",
        "10.5 20.5 30.5\n11.5 21.5\n",
        "x,y,z\n10.5,20.5,30.5\n12.5,2",
        "x,y\n10.5,20.5,30.5\n",
        "x,y,z,i,j\n10.5,20.5,30.5\n",
        "10.5,20.5\n11.5,21.5\n",
        "x,y,z\n",
        "x,y,z\n10.5,20.5,30.5\nx,y,z\n11.5,21.5,31.5\n",
        "x,y,z\n10.5,20.5,30.5\ntotal: 1\n",
        "ncols 3\nnrows 2\nxllcorner 0\n1 2 3\n3 4 5\n",
        "# x y z\n7.25 10.5 20.5 30.5\n7.25 11.5 21.5 31.5\n",
    ],
)
def test_fields_that_are_too_many_or_missing(tmp_path: Path, content: str) -> None:
    refused(tmp_path, content)


@pytest.mark.parametrize("name", ["a.pts", "a.txt", "a.xyz"])
def test_counts_of_points(tmp_path: Path, name: str) -> None:
    first, second = (" ".join(row) for row in ROWS)
    for content in (
        f"2\n{first}\n{second}\n",
        f" 2 \r\n{first}\r\n{second}\r\n",
        f"\ufeff2\n{first}\n{second}\n",
        f"2 # points\n{first}\n{second}\n",
        f"2\nx y z\n{first}\n{second}\n",
        f"x y z\n2\n{first}\n{second}\n",
        f"1\n{first}\n1\n{second}\n",
        f"1\n{first}\n\n0\n\n1\n{second} 0.5\n\n",
        f"2\n{first} -1024 1 2 3\n{second} 77 4 5 6\n",
    ):
        np.testing.assert_array_equal(read(tmp_path, content, name), TWO)
    for content in (
        f"3\n{first}\n{second}\n",
        f"1\n{first}\n{second}\n",
        f"1\n{first}\n2\n{second}\n",
        f"1,000\n{first}\n",
    ):
        refused(tmp_path, content, name)


# --- binary formats and their text ---------------------------------------------------------------------------------------

POINTS = np.array(TWO)


def test_ply_lines_of_other_lengths_are_not_mixed(tmp_path: Path) -> None:
    refused(tmp_path, PLY + "10.5 20.5 30.5 4\n11.5 21.5\n12.5 0.5 1.5\n", "a.ply")  # as many numbers as promised
    np.testing.assert_array_equal(
        read(tmp_path, PLY.replace("3", "2", 1) + "10.5\n20.5 30.5 11.5\n21.5 31.5\n", "a.ply"), TWO
    )


def test_fractions_stay_where_integers_are_declared(tmp_path: Path) -> None:
    body = "10.5 20.5 30.5\n11.5 21.5 31.5\n"
    header = PLY.replace("vertex 3", "vertex 2").replace("float", "int")
    np.testing.assert_array_equal(read(tmp_path, header + body, "a.ply"), TWO)
    move_file(tmp_path / "a.ply", np.eye(4), tmp_path / "b.ply")
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "b.ply").points, TWO)
    pcd = PCD.replace("F F F", "I I I").replace("WIDTH 3", "WIDTH 2").replace("POINTS 3", "POINTS 2")
    np.testing.assert_array_equal(read(tmp_path, pcd + body, "a.pcd"), TWO)


def test_a_property_named_twice_is_refused(tmp_path: Path) -> None:
    twice = PLY.replace("property float x\n", "property float x\nproperty float x\n")
    refused(tmp_path, twice + "1 10.5 20.5 30.5\n" * 3, "a.ply")
    pcd = (
        PCD.replace("x y z", "x y z x")
        .replace("4 4 4", "4 4 4 4")
        .replace("F F F", "F F F F")
        .replace("1 1 1", "1 1 1 1")
    )
    refused(tmp_path, pcd + "10.5 20.5 30.5 1\n" * 3, "a.pcd")


def test_text_that_says_binary_is_refused(tmp_path: Path) -> None:
    body = "10.5 20.5 30.5\n11.5 21.5 31.5\n12.5 0.5 1.5\n"
    assert "as text" in refused(tmp_path, PLY.replace("ascii", "binary_little_endian") + body, "a.ply")
    assert "as text" in refused(tmp_path, PCD.replace("ascii", "binary") + body, "a.pcd")
    refused(tmp_path, PLY.encode() + POINTS.astype("<f4").tobytes(), "a.ply")


@pytest.mark.parametrize("wrong", ["WIDTH 2", "HEIGHT 2", "POINTS 2", "POINTS 4"])
def test_pcd_counts_that_disagree_are_refused(tmp_path: Path, wrong: str) -> None:
    name = wrong.split()[0]
    right = next(line for line in PCD.splitlines() if line.startswith(name))
    refused(tmp_path, PCD.replace(right, wrong) + BODY.format(1), "a.pcd")


@pytest.mark.parametrize("row", ["10.5 20.5 30.5 9", "10.5 20.5"])
def test_pcd_lines_of_another_length_are_refused(tmp_path: Path, row: str) -> None:
    assert "say 3" in refused(tmp_path, PCD + f"{row}\n" * 3, "a.pcd")


def test_an_obj_with_a_byte_order_mark_keeps_its_first_vertex(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(tmp_path, "\ufeffv 10.5 20.5 30.5\nv 11.5 21.5 31.5\n", "a.obj"), TWO)


@pytest.mark.parametrize("width", [5, 6, 7])
def test_rows_of_bin_of_another_width_are_refused(tmp_path: Path, width: int) -> None:
    random = np.random.default_rng(0)
    rows = random.random((420, width), np.float32) * np.array([60, 60, 60, 1, 9, 9, 9][:width], np.float32)
    assert f"rows of {width}" in refused(tmp_path, rows.tobytes(), "a.bin")
    refused(tmp_path, rows[:, :4].astype("<i4").tobytes(), "a.bin")
    refused(tmp_path, rows.astype("<f8").tobytes(), "a.bin")
    assert len(read(tmp_path, rows[:, :4].tobytes(), "a.bin")) == 420


@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_arrays_on_their_side_are_refused(tmp_path: Path, name: str) -> None:
    array = np.random.default_rng(0).normal(size=(3, 100))
    np.save(tmp_path / name, array) if name == "a.npy" else np.savez(tmp_path / name, points=array)
    with pytest.raises(InputError, match="transpose it"):
        read_point_cloud(tmp_path / name)
