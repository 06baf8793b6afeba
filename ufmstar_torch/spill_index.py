"""Which pages a frame may reach, without a look at all of them: a tree of boxes around boxes.

A page lies in one cube of a grid. Eight cubes along every axis share a node, eight nodes the next one, up to 2 km; the
root is above them. A node has the union of its pages' boxes: where a frame does not reach it, it reaches none of them.
So the pages returned are those of a look at every page, and the work depends on what is reached, and hardly on how many
there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

PAGE = 4.0  # [m] edge of the cubes whose components share a page
_BITS = 3  # eight children along each axis
_LEVELS = 3

Box = tuple[tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True)
class Page:
    """Components that were written out together.

    Attributes:
        name: of the file.
        count: of its components.
        means: box around their means, in one cube; lower and upper corner in the frame of the first camera [m].
        reach: box outside of which none of them counts [m].
    """

    name: str
    count: int
    means: Box
    reach: Box


@dataclass(frozen=True)
class View:
    """What a frame can reach, as half spaces n . x + d >= 0, all of which a point within reach satisfies.

    Attributes:
        matching: [P, 4] (n, d) around the means that may project into the image.
        density: [Q, 4] around the points of the depth map.
    """

    matching: NDArray[np.float64]
    density: NDArray[np.float64]

    def reaches(self, means: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.bool_]:
        """[n] False where boxes [n, 2, 3] (see :class:`Page`) lie outside for certain."""
        return _meets(means, self.matching) | _meets(reach, self.density)


class _Node:
    """A box around boxes; it never shrinks, but goes with its last page.

    Attributes:
        boxes: [2, 2, 3] union of the pages' ``means`` and ``reach``.
        children: nodes by cell, on the lowest level pages by number.
        page: its number where it is one.
    """

    def __init__(self, boxes: NDArray[np.float64], page: int = -1) -> None:
        self.boxes, self.page = boxes, page
        self.children: dict[tuple[int, ...], _Node] = {}


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
        boxes, node = np.array([page.means, page.reach]), self._root
        for cell in _cells(page):
            node = node.children.setdefault(cell, _Node(boxes))
            node.boxes = np.stack([np.minimum(node.boxes, boxes)[:, 0], np.maximum(node.boxes, boxes)[:, 1]], 1)
        node.children[(number,)] = _Node(boxes, number)
        self._pages[number] = page
        self.components += page.count

    def remove(self, number: int) -> None:
        """The page goes, and the nodes that are empty without it."""
        page = self._pages.pop(number)
        self.components -= page.count
        cells = _cells(page)
        way = [self._root]
        for cell in cells:
            way.append(way[-1].children[cell])
        for node, cell in zip(reversed(way), reversed([*cells, (number,)]), strict=True):
            del node.children[cell]
            if node.children:
                return

    def reached(self, view: View) -> list[int]:
        """The numbers of the pages that a view reaches, in the order in which they came."""
        nodes = [self._root]
        for _ in range(_LEVELS + 1):
            inner = [child for node in nodes for child in node.children.values()]
            if not inner:
                return []
            boxes = np.array([node.boxes for node in inner])
            nodes = [inner[i] for i in np.flatnonzero(view.reaches(boxes[:, 0], boxes[:, 1]))]
        return sorted(node.page for node in nodes)


def _cells(page: Page) -> list[tuple[int, ...]]:
    """The cells of a page, from the largest to the smallest."""
    cube = [int(np.floor(x / PAGE)) for x in page.means[0]]
    return [tuple(x >> _BITS * level for x in cube) for level in range(_LEVELS, 0, -1)]


def _meets(boxes: NDArray[np.float64], planes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[n] False where a box [n, 2, 3] lies outside of one of the planes [P, 4]."""
    normal, offset = planes[:, :3], planes[:, 3]
    centre, half = (boxes[:, 1] + boxes[:, 0]) / 2, (boxes[:, 1] - boxes[:, 0]) / 2
    farthest = centre @ normal.T + half @ abs(normal).T
    slack = 1e-9 * ((abs(centre) + half) @ abs(normal).T)  # rounding, many times over
    inside: NDArray[np.bool_] = (farthest + offset >= -slack).all(1)
    return inside
