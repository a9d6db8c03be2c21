"""What the names of columns say: which are coordinates, colours and normals, and in what unit."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import product

from idam.errors import InputError

__all__ = ["color_names", "has_angles", "has_positions", "is_unit", "normal_names", "position_names"]

# Words before or after the letter of an axis: pos_x, X coordinate, Points:0, X_UTM. A number alone names no axis.
_STEM = (
    "pos|position|coords?|coordinates?|koordinate|coordonn[ée]e|coordenada|coordinata|坐标|wert|points?|pt|p|vertex|"
    "utm|cartesian|world|local|map|field|loc|location|scan|axis"
)
_AXIS = re.compile(f"(?P<before>(?:{_STEM})?)(?P<axis>[xyz])(?P<after>(?:{_STEM})?)|(?P<stem>{_STEM})(?P<place>[012])")
# survey's names: any of the first for x, with any of the second for y, with any of the third for z
_SURVEY = (
    ("easting", "east", "e", "rechtswert", "rechts", "ost", "este", "est", "x"),
    ("northing", "north", "n", "hochwert", "hoch", "nord", "norte", "y"),
    ("height", "elevation", "elev", "altitude", "alt", "z", "h", "höhe", "hoehe", "cota", "quota"),
)
_ANGLES = {"lat", "latitude", "lon", "long", "lng", "longitude"}
_COLORS = (
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("rf", "gf", "bf"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
_NORMALS = (
    ("nx", "ny", "nz"),
    ("normal_x", "normal_y", "normal_z"),
    ("normals:0", "normals:1", "normals:2"),
    ("normals_0", "normals_1", "normals_2"),
)
_SHORT_UNIT = "m|mm|cm|km|ft|in"
_UNIT = re.compile(
    r"(?<=\w)\s*[\[({](?!\d[\])}])\s*([^\])}]*?)\s*[\])}]\s*$|"  # X [m]; but not position[0]
    rf"(?<=[a-z0-9])(?:_|\s*/\s*|\s+in\s+)({_SHORT_UNIT})$",
    re.IGNORECASE,
)
_UNIT_ALONE = re.compile(rf"[\[({{]?\s*(?:{_SHORT_UNIT}|)\s*[\])}}]?|-", re.IGNORECASE)


def has_positions(names: Sequence[str]) -> bool:
    """Tell whether the names of columns say where the coordinates are."""
    return bool(_positions(names))


def has_angles(names: Sequence[str]) -> bool:
    """Tell whether the names of columns say that coordinates are latitude and longitude."""
    return bool(_ANGLES & {_plain(name) for name in names})


def is_unit(word: str) -> bool:
    """Tell whether a word is a unit of length, in brackets or not, or says that there is none."""
    return _UNIT_ALONE.fullmatch(word.strip()) is not None


def position_names(columns: Sequence[str]) -> Sequence[str]:
    """Find which of the names are those of x, y and z.

    Raises:
        InputError: none are, or more than one may be, or they have different units.
    """
    found = _positions(columns)
    if len(found) > 1:
        one, other = next((a, b) for a, b in zip(found[0], found[1], strict=True) if a != b)
        raise InputError(f"its coordinates may be in the column '{one}' or '{other}': rename the one that is none")
    if not found:
        if has_angles(columns):
            raise InputError("its coordinates are degrees of latitude and longitude: project them to metres first")
        known = ", ".join(columns)[:60] or "none"
        raise InputError(f"has no columns x, y and z (found: {known}): export it with coordinates")
    units = {(match[1] or match[2] or "").casefold() for name in found[0] if (match := _UNIT.search(name.strip()))}
    if len(units) > 1:
        raise InputError(f"its coordinates have different units ({', '.join(sorted(units))}): convert them to one")
    return found[0]


def normal_names(names: Sequence[str]) -> Sequence[str] | None:
    """Find which of the names are those of a normal, if any."""
    return _find(names, _NORMALS)


def color_names(names: Sequence[str]) -> Sequence[str] | None:
    """Find which of the names are red, green and blue, if any."""
    return _find(names, _COLORS)


def _positions(names: Sequence[str]) -> list[tuple[str, ...]]:
    """All triples of names that may be x, y and z; plain ones before those with a word, those before survey's."""
    triples: dict[tuple[str, str, bool], dict[str, list[str]]] = {}
    for name in names:
        match = _AXIS.fullmatch(re.sub(r"[\W_]", "", _plain(name)))
        if match:
            axis = match["axis"] or "xyz"[int(match["place"])]
            key = match["before"] or match["stem"] or "", match["after"] or "", match["axis"] is None
            triples.setdefault(key, {}).setdefault(axis, []).append(name)
    whole = {key: axes for key, axes in triples.items() if len(axes) == 3}
    plain = whole.get(("", "", False))
    if plain is not None:
        whole = {("", "", False): plain}
    return [each for axes in whole.values() for each in product(*(axes[axis] for axis in "xyz"))] or _survey(names)


def _survey(names: Sequence[str]) -> list[tuple[str, ...]]:
    roles = []
    for choice in _SURVEY:
        given = [name for name in names if _plain(name) in choice]
        roles.append([name for name in given if len(_plain(name)) > 1] or given)  # a word says more than a letter
    return [*product(*roles)]


def _plain(name: str) -> str:
    """A column's name in small letters, without its unit and spaces: ``pos_x`` for ``Pos X [m]``."""
    return "_".join(_UNIT.sub("", name.strip()).split()).casefold()


def _find(names: Sequence[str], choices: tuple[tuple[str, str, str], ...]) -> Sequence[str] | None:
    """The three names, as the file spells them, that are one of the choices."""
    plain = {_plain(name): name for name in names}
    return next(([plain[each] for each in choice] for choice in choices if all(map(plain.__contains__, choice))), None)
