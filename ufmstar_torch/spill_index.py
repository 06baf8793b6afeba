"""Which pages a frame may reach, without a look at all of them: a tree of boxes around boxes.

Space is divided into cells of 32 m, and a page counts to that of the least corner of its means. Eight cells along every
axis share a node, eight nodes the next one, up to 2 km; the root is above them. A node has the union of its pages'
boxes: where a frame does not reach it, it reaches none of them. So the pages returned are those of a look at every
page, and the work depends on what is reached, and hardly on how many there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

CELL = 32.0  # [m]
_BITS = 3  # eight children along each axis
_LEVELS = 3


@dataclass(frozen=True, eq=False, slots=True)
class Page:
    """Components that were written out together.

    Attributes:
        name: of the file.
        count: of its components.
        boxes: [2, 2, 3] float64, lower and upper corner in the frame of the first camera [m] of a box around their
            means, and of a box outside of which none of them counts.
    """

    name: str
    count: int
    boxes: NDArray[np.float64]


@dataclass(frozen=True)
class View:
    """What a frame can reach, as half spaces n . x + d >= 0, all of which a point within reach satisfies.

    Attributes:
        matching: [P, 4] (n, d) around the means that may project into the image.
        density: [Q, 4] around the points of the depth map.
    """

    matching: NDArray[np.float64]
    density: NDArray[np.float64]

    def reaches(self, boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[n] False where a page with boxes [n, 2, 2, 3] lies outside for certain."""
        return _meets(boxes[:, 0], self.matching) | _meets(boxes[:, 1], self.density)


class _Node:
    """Boxes around those of pages; they never shrink, but go with the last page.

    Attributes:
        boxes: [2, 2, 3] as those of a page.
        children: nodes by cell, on the lowest level numbers of pages.
    """

    __slots__ = ("boxes", "children")

    def __init__(self, boxes: NDArray[np.float64]) -> None:
        self.boxes = boxes
        self.children: dict[tuple[int, ...] | int, _Node | Page] = {}


class PageIndex:
    """Pages by number, and those that a view reaches.

    Attributes:
        components: in all pages.
    """

    def __init__(self) -> None:
        self.components = 0
        self._pages: dict[int, Page] = {}
        self._root = _Node(np.empty((2, 2, 3)))

    def __len__(self) -> int:
        return len(self._pages)

    def __iter__(self) -> Iterator[int]:
        """The numbers in the order in which they came."""
        return iter(sorted(self._pages))

    def __getitem__(self, number: int) -> Page:
        return self._pages[number]

    def add(self, number: int, page: Page) -> None:
        """One more page; its number is new."""
        node = self._root
        for cell in _cells(page):
            inner = node.children.setdefault(cell, _Node(page.boxes))
            assert isinstance(inner, _Node)
            inner.boxes, node = _union(inner.boxes, page.boxes), inner
        node.children[number] = self._pages[number] = page
        self.components += page.count

    def remove(self, number: int) -> None:
        """The page goes, and the nodes that are empty without it."""
        page = self._pages.pop(number)
        self.components -= page.count
        way, cells = [self._root], _cells(page)
        for cell in cells:
            inner = way[-1].children[cell]
            assert isinstance(inner, _Node)
            way.append(inner)
        keys: list[tuple[int, ...] | int] = [*cells, number]
        for node, key in zip(reversed(way), reversed(keys), strict=True):
            del node.children[key]
            if node.children:
                return

    def reached(self, view: View) -> list[int]:
        """The numbers of the pages that a view reaches, in the order in which they came."""
        reached: list[tuple[tuple[int, ...] | int, _Node | Page]] = [((), self._root)]
        for _ in range(_LEVELS + 1):
            inner = [child for _, node in reached if isinstance(node, _Node) for child in node.children.items()]
            if not inner:
                return []
            hits = view.reaches(np.array([node.boxes for _, node in inner]))
            reached = [inner[i] for i in np.flatnonzero(hits)]
        return sorted(key for key, _ in reached if isinstance(key, int))


def _cells(page: Page) -> list[tuple[int, ...]]:
    """The cells of a page, from the largest to the smallest."""
    cell = [int(x) for x in np.floor(page.boxes[0, 0] / CELL)]
    return [tuple(x >> _BITS * level for x in cell) for level in reversed(range(_LEVELS))]


def _union(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    out = np.minimum(a, b)
    np.maximum(a[:, 1], b[:, 1], out=out[:, 1])
    return out


def _meets(boxes: NDArray[np.float64], planes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[n] False where a box [n, 2, 3] lies outside of one of the planes [P, 4]."""
    normal, offset = planes[:, :3], planes[:, 3]
    centre, half = (boxes[:, 1] + boxes[:, 0]) / 2, (boxes[:, 1] - boxes[:, 0]) / 2
    farthest = centre @ normal.T + half @ abs(normal).T
    slack = 1e-9 * ((abs(centre) + half) @ abs(normal).T)  # rounding, many times over
    return np.asarray((farthest + offset >= -slack).all(1))
