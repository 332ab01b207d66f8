"""What the tags of a map's feature say: its kind, width and height, by the words of OpenStreetMap.

Defaults are guesses for what no tag says; whoever shows a building tells that its height is one.
"""

import re
from collections.abc import Mapping
from enum import IntEnum
from typing import Final

Tags = Mapping[str, str]


class Kind(IntEnum):
    """What a thing is to a robot, and its number in a class layer, where 0 is nothing. Higher ones lie on top."""

    OTHER = 1
    VEGETATION = 2
    WATER = 3
    PATH = 4
    ROAD = 5
    BARRIER = 6
    BUILDING = 7


ROAD_WIDTHS_M: Final = {
    "motorway": 10.5, "trunk": 9.0, "primary": 7.5, "secondary": 7.0, "tertiary": 6.5, "unclassified": 5.5,
    "residential": 5.5, "living_street": 4.5, "motorway_link": 5.5, "trunk_link": 5.5, "primary_link": 5.5,
    "secondary_link": 5.5, "tertiary_link": 5.5, "busway": 3.5, "road": 5.0, "service": 3.5, "track": 3.0,
}  # fmt: skip
PATH_WIDTHS_M: Final = {
    "pedestrian": 4.0, "cycleway": 2.0, "footway": 1.5, "path": 1.5, "bridleway": 1.5, "steps": 1.5, "corridor": 2.0,
}  # fmt: skip
WATER_WIDTHS_M: Final = {"river": 10.0, "canal": 8.0, "stream": 2.0, "ditch": 1.0, "drain": 1.0}
BARRIER_HEIGHTS_M: Final = {
    "wall": 2.0, "city_wall": 5.0, "retaining_wall": 1.5, "fence": 1.5, "hedge": 1.5, "guard_rail": 0.8, "kerb": 0.15,
}  # fmt: skip
WATER_LAND: Final = frozenset({"reservoir", "basin"})
GREEN_LAND: Final = frozenset(
    {"forest", "meadow", "grass", "farmland", "orchard", "vineyard", "allotments", "village_green", "flowerbed"}
)
GREEN_NATURE: Final = frozenset({"wood", "scrub", "heath", "grassland", "tree", "tree_row", "shrub", "wetland"})
GREEN_LEISURE: Final = frozenset({"park", "garden"})

LEVEL_M: Final = 3.0
BUILDING_M: Final = 6.0
BARRIER_M: Final = 1.0
BARRIER_WIDTH_M: Final = 0.3
TREE_ROW_WIDTH_M: Final = 3.0
POINT_WIDTH_M: Final = 1.0
MOST_WIDTH_M: Final = 100.0
MOST_HEIGHT_M: Final = 1_000.0
MOST_LEVELS: Final = 200.0
_NUMBER: Final = re.compile(r"\s*(\d{1,6}(?:[.,]\d{1,6})?)\s*m?\s*", re.ASCII)


def kind_of(tags: Tags) -> Kind:
    """By the first that fits: a building with a fence around it is a building. `kind` may say it in our own words."""
    said = tags.get("kind", "").upper()
    if said in Kind.__members__:
        return Kind[said]
    if _yes(tags, "building") or _yes(tags, "building:part"):
        return Kind.BUILDING
    if _yes(tags, "barrier"):
        return Kind.BARRIER
    highway = tags.get("highway", "")
    if highway in ROAD_WIDTHS_M:
        return Kind.ROAD
    if highway in PATH_WIDTHS_M:
        return Kind.PATH
    nature, land = tags.get("natural", ""), tags.get("landuse", "")
    if nature == "water" or land in WATER_LAND or tags.get("waterway", "") in {*WATER_WIDTHS_M, "riverbank"}:
        return Kind.WATER
    if nature in GREEN_NATURE or land in GREEN_LAND or tags.get("leisure", "") in GREEN_LEISURE:
        return Kind.VEGETATION
    return Kind.OTHER


def width_m(kind: Kind, tags: Tags) -> float:
    """How wide a line or point is to be drawn [m]: as the tag says, else by its class."""
    said = number(tags.get("width", ""))
    if said is not None and 0 < said <= MOST_WIDTH_M:
        return said
    highway = tags.get("highway", "")
    if kind is Kind.ROAD:
        return ROAD_WIDTHS_M.get(highway, ROAD_WIDTHS_M["road"])
    if kind is Kind.PATH:
        return PATH_WIDTHS_M.get(highway, PATH_WIDTHS_M["path"])
    if kind is Kind.WATER:
        return WATER_WIDTHS_M.get(tags.get("waterway", ""), WATER_WIDTHS_M["stream"])
    if kind is Kind.BARRIER:
        return BARRIER_WIDTH_M
    if kind is Kind.VEGETATION:
        return TREE_ROW_WIDTH_M if tags.get("natural") == "tree_row" else POINT_WIDTH_M
    return POINT_WIDTH_M


def height_m(kind: Kind, tags: Tags) -> tuple[float, bool]:
    """How high it stands above the ground [m], and whether that is assumed. 0 for what is not built."""
    if kind not in (Kind.BUILDING, Kind.BARRIER):
        return 0.0, False
    said = number(tags.get("height", tags.get("building:height", "")))
    if said is not None and 0 < said <= MOST_HEIGHT_M:
        return said, False
    if kind is Kind.BARRIER:
        return BARRIER_HEIGHTS_M.get(tags.get("barrier", ""), BARRIER_M), True
    levels = number(tags.get("building:levels", ""))
    if levels is not None and 0 < levels <= MOST_LEVELS:
        roof = number(tags.get("roof:levels", "")) or 0.0
        return (levels + min(roof, MOST_LEVELS)) * LEVEL_M, False
    return BUILDING_M, True


def number(text: str) -> float | None:
    """Metres or a count, with a point or a comma; None for all else, such as feet."""
    found = _NUMBER.fullmatch(text)
    return float(found[1].replace(",", ".")) if found else None


def _yes(tags: Tags, key: str) -> bool:
    return tags.get(key, "no") not in ("no", "")
