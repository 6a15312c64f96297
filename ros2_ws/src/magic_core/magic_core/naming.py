"""Objects named in words: ``the red mug``, ``the longest tool``, ``the cylinder left of the box``.

A name is read by a small grammar over what is measured of each object, colour, size, class of shape and place:

    name      = ["the" | "a"] {colour | superlative | "known"} noun [relation name]
    relation  = "left of" | "right of" | "behind" | "in front of" | "above" | "below" | "next to" | "nearest to"

Left and right are those of somebody who looks along the frame's x axis: for a robot's base (REP-103, x forward, y left) the robot's
own. A name that fits no object, several alike, or one only by less than what measuring may err by, is refused with the list of
objects; nothing is guessed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from magic_core import transforms
from magic_core.errors import Code, MagicError
from magic_core.scene import SceneObject

Array = NDArray[np.float64]

#: By how much the first must lead the second for a superlative to tell them apart: lengths of reconstructions err by some per cent.
LEAD = 1.1
#: And by how much in place, m.
ASIDE = 0.02
#: An object is called by a colour that covers this share of what was seen of it.
COVERED = 0.35
#: Beside this many metres or less of clear space between boxes, things are next to each other.
BESIDE = 0.1

#: The least diameter of what is called a mug, m.
CUP = 0.05

#: Hues in degrees at which one colour word gives way to the next; below them, what is grey or dark has no hue to be named by.
HUES = (
    (12.0, "red"),
    (40.0, "orange"),
    (70.0, "yellow"),
    (165.0, "green"),
    (262.0, "blue"),
    (295.0, "purple"),
    (338.0, "pink"),
    (360.0, "red"),
)
COLOURS = ("red", "orange", "yellow", "green", "blue", "purple", "pink", "brown", "black", "white", "grey")

SYNONYMS = {
    "gray": "grey", "silver": "grey", "violet": "purple", "magenta": "pink",
    "biggest": "largest", "bigger": "largest", "big": "largest", "large": "largest", "larger": "largest",
    "small": "smallest", "smaller": "smallest", "little": "smallest", "littlest": "smallest",
    "long": "longest", "longer": "longest", "short": "shortest", "shorter": "shortest",
    "tall": "tallest", "taller": "tallest", "highest": "tallest", "flat": "flattest", "lowest": "flattest",
    "closest": "nearest", "furthest": "farthest",
    "object": "thing", "item": "thing", "one": "thing", "objects": "thing",
    "cup": "mug", "block": "box", "cube": "box", "brick": "box", "sphere": "ball", "can": "cylinder", "tube": "cylinder",
    "rod": "stick", "bar": "stick", "pole": "stick", "disc": "plate", "disk": "plate",
}  # fmt: skip

NOUNS = ("thing", "tool", "box", "cylinder", "ball", "mug", "bowl", "stick", "plate")
RELATIONS = ("left of", "right of", "behind", "in front of", "above", "below", "next to", "nearest to")
_RELATION = {
    "beside": "next to", "near": "next to", "by": "next to", "on top of": "above", "on": "above", "under": "below",
    "left from": "left of", "right from": "right of", "to the left of": "left of", "to the right of": "right of", "closest to": "nearest to",
}  # fmt: skip


@dataclass(frozen=True)
class Looks:
    """What names go by.

    id; length, width, height in metres (height along the frame's z, length the greatest of the three, width the smaller level
    one); volume (m3) of the mesh; centre (3,); low and high (3,): the box along the frame's axes; colours: shares of the colour
    words by what was seen; shapes: the nouns that fit; tool: a camera saw it, it is no known fixture.
    """

    id: str
    length: float
    width: float
    height: float
    volume: float
    centre: Array
    low: Array
    high: Array
    colours: dict[str, float]
    shapes: frozenset[str]
    tool: bool

    def __str__(self) -> str:
        named = [c for c, share in sorted(self.colours.items(), key=lambda item: -item[1]) if share >= COVERED]
        kind = next((n for n in NOUNS[2:] if n in self.shapes), "thing")
        return f"{self.id}: {' and '.join(named) + ' ' if named else ''}{kind}, {self.length:.2f} m long, {self.height:.2f} m high"


@dataclass(frozen=True)
class Reading:
    """id of the object that a name means, and a sentence that says how the name was read."""

    id: str
    sentence: str


def colour_shares(colors: NDArray[np.uint8]) -> dict[str, float]:
    """Share of each colour word among pixels (N, 3) uint8 RGB; empty for none."""
    if not len(colors):
        return {}
    hue, value, chroma = _hsv(colors)
    words = np.full(len(colors), "", dtype=object)
    lower = 0.0
    for upper, word in HUES:
        words[(hue >= lower) & (hue < upper)] = word
        lower = upper
    # Dark orange is what is called brown.
    words[np.isin(words, ("orange",)) & (value < 0.6)] = "brown"
    # What is dark by a pigment, or in the shade, keeps its hue; noise and warm light give grey and black things less of one.
    grey = chroma < np.maximum(np.clip(0.5 * value, 0.06, 0.12), 0.2 * value)
    words[grey] = "grey"
    words[grey & (value > 0.72)] = "white"
    words[grey & (value < 0.2)] = "black"
    return {word: float(np.mean(words == word)) for word in COLOURS if (words == word).any()}


def _hsv(colors: NDArray[np.uint8]) -> tuple[Array, Array, Array]:
    """Hue in degrees, value and chroma 0..1."""
    hsv = cv2.cvtColor(np.ascontiguousarray(colors, np.float32).reshape(1, -1, 3) / 255, cv2.COLOR_RGB2HSV)[0].astype(float)
    return hsv[:, 0], hsv[:, 2], hsv[:, 1] * hsv[:, 2]


def looks(item: SceneObject) -> Looks:
    """Measure an object, in the frame its pose is given in."""
    points = transforms.apply(item.world_from_object, item.mesh.vertices)
    low, high = points.min(axis=0), points.max(axis=0)
    level = sorted(cv2.minAreaRect(np.ascontiguousarray(points[:, :2], np.float32))[1])
    height = float(high[2] - low[2])
    shapes = set(_shapes(item, points))
    tool = item.source == "camera" and not item.hanging
    return Looks(
        id=item.id,
        length=float(max(*level, height)),
        width=float(level[0]),
        height=height,
        volume=float(item.mesh.to_trimesh().convex_hull.volume),
        centre=0.5 * (low + high),
        low=low,
        high=high,
        colours=colour_shares(_colors(item)),
        shapes=frozenset(shapes | {"thing"} | ({"tool"} if tool else set())),
        tool=tool,
    )


def _colors(item: SceneObject) -> NDArray[np.uint8]:
    """Colours (N, 3) of what was seen; of a known object those of its view."""
    if len(item.colors):
        return item.colors
    return item.view.image[item.view.mask]


#: Side of a silhouette, pixels.
SILHOUETTE = 96


@dataclass(frozen=True)
class _Silhouette:
    """One object seen along an axis: is its outline a circle, a rectangle, a disc with something that sticks out of it; is there a hole."""

    circle: bool
    rectangle: bool
    handled: bool
    hole: bool


def _shapes(item: SceneObject, points: Array) -> set[str]:
    """Nouns that fit by geometry, from silhouettes along the vertical and the level axes of the tightest upright box."""
    angle = math.radians(cv2.minAreaRect(np.ascontiguousarray(points[:, :2], np.float32))[2])
    turned = points @ np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    size = turned.max(axis=0) - turned.min(axis=0)
    small, middle, long = sorted(float(x) for x in size)
    if small <= 0:
        return set()
    seen = [_silhouette(turned[:, [(k + 1) % 3, (k + 2) % 3]], item.mesh.faces) for k in range(3)]
    circles, rectangles = sum(s.circle for s in seen), sum(s.rectangle for s in seen)
    found = set()
    hollow = _hollow(turned, item.mesh.faces)
    if rectangles == 3:
        found.add("box")
    if circles == 3:
        found.add("ball")
    if circles == 1 and rectangles == 2 and not hollow:
        found.add("cylinder")
    if long >= 4 * middle and middle <= 2 * small:
        found.add("stick")
    if small <= 0.15 * middle and circles:
        found.add("plate")
    upright = seen[2]
    if hollow and upright.circle and size[2] < 0.7 * max(size[0], size[1]):
        found.add("bowl")
    # A mug is round with a handle, and open at its top or through the handle.
    open_somewhere = hollow or any(s.hole for s in seen)
    handled = any(s.handled and size[k] >= 0.4 * long for k, s in enumerate(seen)) and open_somewhere
    if middle >= CUP and small >= 0.35 * long and "bowl" not in found and ((hollow and upright.circle) or handled):
        found.add("mug")
    return found


def _raster(flat: Array) -> NDArray[np.int32]:
    """Pixels (V, 2) of points (V, 2) on a silhouette, with a border of two."""
    low, high = flat.min(axis=0), flat.max(axis=0)
    return np.round((flat - low) / max(float((high - low).max()), 1e-9) * (SILHOUETTE - 5) + 2).astype(np.int32)


def _silhouette(flat: Array, faces: NDArray[np.int32]) -> _Silhouette:
    mask = np.zeros((SILHOUETTE, SILHOUETTE), np.uint8)
    for triangle in _raster(flat)[faces]:
        cv2.fillConvexPoly(mask, triangle, 1)
    outline = max(cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=len)
    filled = cv2.drawContours(np.zeros_like(mask), [outline], -1, 1, cv2.FILLED)
    area = float(filled.sum())
    b, a = sorted(side + 1 for side in cv2.minAreaRect(outline)[1])
    depth = cv2.distanceTransform(filled, cv2.DIST_L2, 5)
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    radius = float(depth[row, column])
    away = np.linalg.norm(outline[:, 0] - [column, row], axis=1) / radius
    return _Silhouette(
        circle=a / b < 1.12 and abs(area / (math.pi / 4 * a * b) - 1) < 0.05,
        rectangle=area / (a * b) > 0.93,
        handled=bool(np.mean(away < 1.12) >= 0.62 and 1.25 < away.max() < 2.5 and area < 1.6 * math.pi * radius**2),
        hole=bool(cv2.morphologyEx(filled - mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)).any()),
    )


def _hollow(points: Array, faces: NDArray[np.int32]) -> bool:
    """Does what one sees from above lie deeper in the middle than the rim, by a third of the height."""
    pixels, heights = _raster(points[:, :2])[faces], points[faces, 2]
    top = np.full((SILHOUETTE, SILHOUETTE), -np.inf, np.float32)
    for k in np.argsort(heights.max(axis=1)):  # from below: the highest is painted last
        cv2.fillConvexPoly(top, pixels[k], float(heights[k].mean()))
    inside = np.isfinite(top)
    depth = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5)
    rim, middle = top[inside & (depth < 0.1 * depth.max())], top[depth > 0.6 * depth.max()]
    return bool(len(rim) > 0 and np.median(rim) - np.median(middle) > np.ptp(points[:, 2]) / 3)


@dataclass(frozen=True)
class _Name:
    """A parsed name: the adjectives in their order, the noun, and the relation to another one."""

    colours: tuple[str, ...]
    superlative: str
    known: bool
    noun: str
    relation: str
    other: _Name | None


_SUPERLATIVES: dict[str, Callable[[Looks], float]] = {
    "longest": lambda o: o.length,
    "shortest": lambda o: -o.length,
    "largest": lambda o: o.volume ** (1 / 3),
    "smallest": lambda o: -(o.volume ** (1 / 3)),
    "tallest": lambda o: o.height,
    "flattest": lambda o: -o.height,
    "widest": lambda o: o.width,
    "thinnest": lambda o: -o.width,
    "leftmost": lambda o: float(o.centre[1]),
    "rightmost": lambda o: -float(o.centre[1]),
    "nearest": lambda o: -float(np.hypot(*o.centre[:2])),
    "farthest": lambda o: float(np.hypot(*o.centre[:2])),
}
_PLACES = ("leftmost", "rightmost", "nearest", "farthest")
VOCABULARY = tuple(sorted({*COLOURS, *SYNONYMS, *_SUPERLATIVES, *NOUNS, "known"} - {"thing"}))


def is_name(text: str) -> bool:
    """Whether a text is made of the words of a name (an id such as ``object_3`` is not)."""
    try:
        _parse(text)
    except MagicError:
        return False
    return True


def _parse(text: str) -> _Name:
    words = text.lower().strip()
    relation, other = "", None
    found = [
        (match.start(), -len(key), key, match)
        for key in (*RELATIONS, *_RELATION)
        if (match := re.search(rf"(?<!\S){re.escape(key)}(?!\S)(?=\s+\S)", words)) and match.start() > 0
    ]
    # "nearest to" follows a noun; "the nearest tool" does not, and has no "to".
    if found:
        _, _, key, match = min(found)
        relation = _RELATION.get(key, key)
        other = _parse(words[match.end() :])
        words = words[: match.start()].strip()
        words = re.sub(r"\s+(that is|which is|that's)$", "", words)
    tokens = [SYNONYMS.get(w, w) for w in re.findall(r"[a-z0-9_-]+", words) if w not in ("the", "a", "an", "most")]
    colours, superlative, known = [], "", False
    while tokens and (len(tokens) > 1 or tokens[0] not in NOUNS):
        word = tokens[0]
        if word in COLOURS:
            colours.append(word)
        elif word in _SUPERLATIVES and not superlative:
            superlative = word
        elif word == "known":
            known = True
        else:
            break
        tokens.pop(0)
    if not tokens and (colours or superlative or known):
        tokens = ["thing"]
    if len(tokens) != 1 or tokens[0] not in NOUNS:
        raise MagicError(
            Code.UNKNOWN_OBJECT, "name of an object", text, f"ids, or words of {', '.join(VOCABULARY)}; and {', '.join(RELATIONS)}"
        )
    return _Name(tuple(colours), superlative, known, tokens[0], relation, other)


def resolve(text: str, objects: Sequence[SceneObject]) -> Reading:
    """The one object that a name means.

    objects: in one frame, x forward and z up (a robot's base).  Raises UNKNOWN_OBJECT where a word is not known or nothing fits, and
    AMBIGUOUS_OBJECT where several do; both list what there is.
    """
    name = _parse(text)
    return _resolve(text, name, [looks(item) for item in objects])


def _resolve(text: str, name: _Name, seen: Sequence[Looks]) -> Reading:
    listed = "; ".join(str(o) for o in seen) or "no objects"
    said = []
    fitting = [o for o in seen if name.noun in o.shapes and (not name.known or not o.tool)]
    doubtful: set[str] = set()  # ids of those that fit or do not, by less than measuring may err by

    def only(fits: Callable[[Looks], bool | None]) -> list[Looks]:
        answers = [(o, fits(o)) for o in fitting]
        doubtful.update(o.id for o, answer in answers if answer is None)
        return [o for o, answer in answers if answer is not False]

    for colour in name.colours:
        fitting = only(lambda o, colour=colour: _least(o.colours.get(colour, 0.0), COVERED, COVERED / 1.5))
        if len(fitting) == 1:
            said.append(f"{100 * fitting[0].colours[colour]:.0f} % {colour}")
    if name.other is not None:
        other = _resolve(text, name.other, seen)
        anchor = next(o for o in seen if o.id == other.id)
        fitting = [o for o in fitting if o.id != anchor.id]
        if name.relation == "nearest to":
            fitting = _first(text, fitting, lambda o: -_gap(o, anchor), lambda a, b: a - b < ASIDE, listed)
        else:
            fitting = only(lambda o: _related(name.relation, o, anchor))
        said.append(f"{name.relation} {other.id}")
    if not fitting:
        raise MagicError(Code.UNKNOWN_OBJECT, "no object is called", text, listed)
    if name.superlative:
        value = _SUPERLATIVES[name.superlative]
        if name.superlative in _PLACES:
            alike = lambda a, b: a - b < ASIDE  # noqa: E731
        else:
            alike = lambda a, b: max(abs(a), abs(b)) < LEAD * min(abs(a), abs(b))  # noqa: E731
        fitting = _first(text, fitting, value, alike, listed)
        said.append(f"the {name.superlative}, {abs(value(fitting[0])):.2f} m")
    if len(fitting) > 1:
        raise MagicError(Code.AMBIGUOUS_OBJECT, f"{len(fitting)} objects ({', '.join(o.id for o in fitting)}) are called", text, listed)
    if fitting[0].id in doubtful:
        raise MagicError(Code.AMBIGUOUS_OBJECT, f"{fitting[0].id} is too near to the limit to tell whether it is called", text, listed)
    return Reading(fitting[0].id, f"{text!r} is {fitting[0]}" + (f" ({', '.join(said)})" if said else ""))


def _least(value: float, least: float, doubt: float) -> bool | None:
    """Is a value at least that; ``None`` where it is less, but at least ``doubt``."""
    return True if value >= least else None if value >= doubt else False


def _first(
    text: str, fitting: Sequence[Looks], value: Callable[[Looks], float], alike: Callable[[float, float], bool], listed: str
) -> list[Looks]:
    """The one with the greatest value; AMBIGUOUS_OBJECT where the next one is as good within what measuring may err by."""
    ranked = sorted(fitting, key=lambda o: (-value(o), o.id))
    if len(ranked) > 1 and alike(value(ranked[0]), value(ranked[1])):
        what = f"{ranked[0].id} and {ranked[1].id} are too nearly alike to tell which is called"
        raise MagicError(Code.AMBIGUOUS_OBJECT, what, text, listed)
    return ranked[:1]


def _gap(a: Looks, b: Looks) -> float:
    """Clear distance in metres of two boxes along the frame's axes."""
    return float(np.linalg.norm(np.maximum(0.0, np.maximum(a.low - b.high, b.low - a.high))))


def _related(relation: str, a: Looks, b: Looks) -> bool | None:
    """Is a left of b (and so on): by the middles, and clearly more along that axis than along the other level one; ``None``: in between."""
    dx, dy, dz = a.centre - b.centre
    level = np.minimum(a.high, b.high)[:2] - np.maximum(a.low, b.low)[:2]
    over = bool(level.min() > 0)
    if relation == "above":
        return over and bool(dz > 0 and a.low[2] > b.centre[2])
    if relation == "below":
        return over and bool(dz < 0 and b.low[2] > a.centre[2])
    if relation == "next to":
        return _least(-_gap(a, b), -BESIDE, -BESIDE - ASIDE)
    along, across = {"left of": (dy, dx), "right of": (-dy, dx), "behind": (dx, dy), "in front of": (-dx, dy)}[relation]
    return _least(along, max(ASIDE, 1.2 * abs(across)), max(ASIDE / 2, 0.8 * abs(across)))
