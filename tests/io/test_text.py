"""Text as people and programs write it: read right, or refused where it can be read in two ways."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from idam.errors import InputError
from idam.io import PointCloud, read_point_cloud, read_scans, write_point_cloud

TWO = [[10.5, 20.5, 30.5], [11.5, 21.5, 31.5]]
UTM = [[412341.066, 5412336.049, 350.2], [412342.5, 5412337.5, 351.7]]


def read(folder: Path, content: bytes | str, name: str = "a.csv") -> PointCloud:
    (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return read_point_cloud(folder / name)


NUMBERS = {
    "decimal commas in quotes": 'X,Y,Z\n"412341,066","5412336,049","350,2"\n"412342,5","5412337,5","351,7"\n',
    "without a header": '"412341,066","5412336,049","350,2"\n"412342,5","5412337,5","351,7"\n',
    "thousands in quotes": 'X,Y,Z\n"412,341.066","5,412,336.049","350.2"\n"412,342.5","5,412,337.5","351.7"\n',
    "only one in quotes": 'X,Y,Z\n"412,341.066",5412336.049,350.2\n"412,342.5",5412337.5,351.7\n',
    "German": "X;Y;Z\n412.341,066;5.412.336,049;350,2\n412.342,5;5.412.337,5;351,7\n",
    "Swiss": "X;Y;Z\n412'341.066;5'412'336.049;350.2\n412'342.5;5'412'337.5;351.7\n",
    "French": "X;Y;Z\n412 341,066;5 412 336,049;350,2\n412\u202f342,5;5\u202f412\u202f337,5;351,7\n",
    "English thousands and tabs": "x\ty\tz\n412,341.066\t5,412,336.049\t350.2\n412,342.5\t5,412,337.5\t351.7\n",
    "exponents": "x;y;z\n4,12341066e5;5412336,049;350,2\n4,123425E+05;5412337,5;351,7\n",
    "survey's names": "Easting;Northing;Height\n412341,066;5412336,049;350,2\n412342,5;5412337,5;351,7\n",
    "north first": "Northing,Easting,Elev (m)\n5412336.049,412341.066,350.2\n5412337.5,412342.5,351.7\n",
    "Excel": "sep=;\nX;Y;Z\n412341,066;5412336,049;350,2\n412342,5;5412337,5;351,7\n",
    "German names": "Punkt;Rechtswert;Hochwert;Höhe\nP1;412341,066;5412336,049;350,2\nP2;412342,5;5412337,5;351,7\n",
}


@pytest.mark.parametrize("kind", NUMBERS)
def test_numbers_as_people_write_them(tmp_path: Path, kind: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, NUMBERS[kind]).points, UTM)


@pytest.mark.parametrize(
    "kind", ["German", "Swiss", "French", "English thousands and tabs", "survey's names", "German names"]
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_encodings_of_windows(tmp_path: Path, kind: str, encoding: str) -> None:
    text = NUMBERS[kind].replace("\u202f", "\u00a0").replace("\n", "\r\n")
    np.testing.assert_array_equal(read(tmp_path, text.encode(encoding)).points, UTM)


TABLES = {
    "R's row names": '"x" "y" "z"\n"1" 10.5 20.5 30.5\n"2" 11.5 21.5 31.5\n',
    "R's row names of a part": '"x" "y" "z"\n"17" 10.5 20.5 30.5\n"42" 11.5 21.5 31.5\n',
    "R without quotes": "x y z\n1 10.5 20.5 30.5\n2 11.5 21.5 31.5\n",
    "row names of text": "x y z\nfirst 10.5 20.5 30.5\nsecond 11.5 21.5 31.5\n",
    "R with commas": '"x","y","z"\n"1",10.5,20.5,30.5\n"2",11.5,21.5,31.5\n',
    "R's other columns": '"x" "y" "z" "what"\n"1" 10.5 20.5 30.5 "a b"\n"2" 11.5 21.5 31.5 "c"\n',
    "pandas as text": "      x     y     z\n0  10.5  20.5  30.5\n1  11.5  21.5  31.5\n",
    "a column of text first": "name,x,y,z\nP1,10.5,20.5,30.5\nP2,11.5,21.5,31.5\n",
    "a column of text last": "x;y;z;note\n10,5;20,5;30,5;a, b\n11,5;21,5;31,5;\n",
    "text with a hash and a comma": 'label,x,y,z\n"Tree #5, old",10.5,20.5,30.5\nTree#6,11.5,21.5,31.5\n',
    "dates": "time,x,y,z\n2024-01-01 10:00:00,10.5,20.5,30.5\n2024-01-01 10:00:01,11.5,21.5,31.5\n",
    "text without a header": "10.5 20.5 30.5 ground\n11.5 21.5 31.5 tree\n",
    "a name without a header": "P1,10.5,20.5,30.5\nP2,11.5,21.5,31.5\n",
    "units": "X [m],Y [m],Z [m]\n10.5,20.5,30.5\n11.5,21.5,31.5\n",
    "units and spaces": "X [m] Y [m] Z [m]\n10.5 20.5 30.5\n11.5 21.5 31.5\n",
    "units in quotes": '"X (mm)";"Y (mm)";"Z (mm)"\n10.5;20.5;30.5\n11.5;21.5;31.5\n',
    "units behind a line": "x_mm;y_mm;z_mm\n10.5;20.5;30.5\n11.5;21.5;31.5\n",
    "units as a quotient": "X/m,Y/m,Z/m\n10.5,20.5,30.5\n11.5,21.5,31.5\n",
    "long names": '"Pos X (m)","Pos Y (m)","Pos Z (m)"\n10.5,20.5,30.5\n11.5,21.5,31.5\n',
    "ArcGIS": "OID_,POINT_X,POINT_Y,POINT_Z\n-1,10.5,20.5,30.5\n-1,11.5,21.5,31.5\n",
    "R's row names and tabs": '"x"\t"y"\t"z"\n"1"\t10.5\t20.5\t30.5\n"2"\t11.5\t21.5\t31.5\n',
    "VTK": "Points:0,Points:1,Points:2\n10.5,20.5,30.5\n11.5,21.5,31.5\n",
    "ParaView": '"Points_0","Points_1","Points_2"\n10.5,20.5,30.5\n11.5,21.5,31.5\n',
    "names in a comment": "# row col x y z\n0 0 10.5 20.5 30.5\n0 1 11.5 21.5 31.5\n",
    "FARO with names": "row column x y z\n0 0 10.5 20.5 30.5\n0 1 11.5 21.5 31.5\n",
    "missing values": "x,y,z\n10.5,20.5,30.5\nNA,NA,NA\n,,\n#N/A,1,2\nnull,1,2\n11.5,21.5,31.5\n",
    "a comma at the end": "x,y,z\n10.5,20.5,30.5,\n11.5,21.5,31.5,\n",
    "text and commas at the end": "n,x,y,z,\na,10.5,20.5,30.5,\nb,11.5,21.5,31.5,\n",
    "blank lines": "\n\nx y z\n\n10.5 20.5 30.5\n\n11.5 21.5 31.5\n\n",
}  # fmt: skip


@pytest.mark.parametrize("kind", TABLES)
def test_tables_as_programs_write_them(tmp_path: Path, kind: str) -> None:
    np.testing.assert_array_equal(read(tmp_path, TABLES[kind]).points, TWO)


AMBIGUOUS = {
    "commas for both": "x,y,z\n0,123,0,456,0,789\n1,123,1,456,1,789\n",
    "commas for both without names": "0,123,0,456,0,789\n1,123,1,456,1,789\n",
    "commas for both that look like colours": "10,20,30,25,04,9\n11,20,30,25,00,9\n",
    "commas for both with a space": "x, y, z\n0,123, 0,456, 0,789\n1,123, 1,456, 1,789\n",
    "thousands or decimals": 'X,Y,Z\n"412,341","512,336","350,200"\n',
    "points and commas before decimals": "x;y;z\n412341.066;5412336,049;350,2\n",
    "more fields than names": "x y z\n1.5 10.5 20.5 30.5\n2.5 11.5 21.5 31.5\n",
    "fewer fields than names": "id,x,y,z\n1.5,10.5,20.5\n2.5,11.5,21.5\n",
    "comment that names other columns": "# id x y z\n1.5 10.5 20.5 30.5 1\n2.5 11.5 21.5 31.5 1\n",
    "numbered points without names": "1,5000.0,4000.0,100.0,TREE\n2,5001.0,4000.0,100.0,TREE\n3,5000.0,4003.0,100,MH\n",
    "FARO without names": "0 0 1.5 2.5 3.5 10 20 30\n0 1 1.6 2.5 3.5 10 20 30\n1 0 1.7 2.6 3.5 11 21 31\n",
    "FARO column by column": "0 0 1.5 2.5 3.5\n1 0 1.6 2.5 3.5\n0 1 1.7 2.6 3.5\n",
    "two columns of one name": "x,y,z,x\n1,2,3,4\n",
    "different units": "X [m],Y [m],Z [ft]\n1,2,3\n",
    "different units behind a line": "x_m,y_m,z_mm\n1,2,3\n",
    "degrees": "lat,lon,h\n48.1,11.2,500\n",
    "more points than counted": "1\n0 0 0\n1 0 0\n",
    "rows of different length": 'x,y,z,n\n1,2,3,"a"\n1,2,3\n',
    "text in a coordinate": "name,x,y,z\na,1,2,3\nb,1,two,3\n",
    "a title": "Scan of site A\nx y z\n1 2 3\n",
    "spaces inside numbers between commas": "1 2, 3, 4\n1 2, 3, 4\n",
}


@pytest.mark.parametrize("kind", AMBIGUOUS)
def test_what_can_be_read_in_two_ways_is_refused(tmp_path: Path, kind: str) -> None:
    with pytest.raises(InputError) as error:
        read(tmp_path, AMBIGUOUS[kind])
    message = str(error.value)
    assert message.startswith(f"{tmp_path / 'a.csv'}: ") and "\n" not in message and len(message) < 350


def test_columns_that_are_colours_and_whole_numbers_are_no_doubt(tmp_path: Path) -> None:
    cloud = read(tmp_path, "10,20,30,255,0,9\n11,20,30,255,0,9\n")
    np.testing.assert_array_equal(cloud.points, [[10, 20, 30], [11, 20, 30]])
    np.testing.assert_array_equal(cloud.colors, [[255, 0, 9], [255, 0, 9]])


@pytest.mark.parametrize("line", ["412 5412 350.5 0.1 0.2", "0.5 0 1.5 2.5 3.5"])
def test_a_grid_that_is_none_of_a_scanner_is_read(tmp_path: Path, line: str) -> None:
    first = line.split()
    rows = [first, [str(float(first[0]) + 0.5), *first[1:]], first]
    cloud = read(tmp_path, "\n".join(" ".join(row) for row in rows), "a.xyz")
    assert len(cloud.points) == 3 and cloud.points[0, 0] == float(first[0])


def test_scans_of_a_pts_file(tmp_path: Path) -> None:
    (tmp_path / "a.pts").write_text("2\n0 0 0 1 2 3 4\n1 0 0 1 2 3 4\n\n0\n1\n0 1 0 -7 2 3 4\n")
    first, second = read_scans(tmp_path / "a.pts")
    assert (first.name, second.name) == ("a.pts#1", "a.pts#2")
    np.testing.assert_array_equal(first.cloud.points, [[0, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(second.cloud.attributes["intensity"], [-7])
    assert len(read_point_cloud(tmp_path / "a.pts").points) == 3
    np.testing.assert_array_equal(read_point_cloud(f"{tmp_path}/a.pts#2").points, [[0, 1, 0]])
    with pytest.raises(InputError, match="cut short"):
        read(tmp_path, "2\n0 0 0\n1 0 0\n2\n0 1 0\n", "b.pts")


def test_intensity_of_pts_is_kept(tmp_path: Path) -> None:
    (tmp_path / "a.pts").write_text("2\n0 0 0 -500 255 0 9\n1 0 0 20 7 8 9\n")
    write_point_cloud(tmp_path / "b.pts", read_point_cloud(tmp_path / "a.pts"))
    back = read_point_cloud(tmp_path / "b.pts")
    np.testing.assert_array_equal(back.attributes["intensity"], [-500, 20])
    np.testing.assert_array_equal(back.colors, [[255, 0, 9], [7, 8, 9]])


def test_columns_without_names_come_back(tmp_path: Path) -> None:
    (tmp_path / "a.xyz").write_text("0.5 0 0 7.5\n1 0 0 8.5\n")
    write_point_cloud(tmp_path / "b.xyz", read_point_cloud(tmp_path / "a.xyz"))
    assert (tmp_path / "b.xyz").read_text().startswith("# x y z column_4\n")
    np.testing.assert_array_equal(read_point_cloud(tmp_path / "b.xyz").attributes["column_4"], [7.5, 8.5])


def test_plain_text_of_many_lines_is_quick(tmp_path: Path) -> None:
    import time

    points = np.random.default_rng(0).normal(size=(100_000, 3))
    np.savetxt(tmp_path / "a.csv", points, delimiter=",", header="x,y,z", comments="")
    started = time.process_time()
    np.testing.assert_allclose(read_point_cloud(tmp_path / "a.csv").points, points, rtol=1e-15)
    assert time.process_time() - started < 2
