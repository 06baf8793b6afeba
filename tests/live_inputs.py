"""A recording, a pose and images as files, for tests of ``ufmstar live``."""

from __future__ import annotations

import io

from PIL import Image

TOUR = "tour:3?frames=5&size=64x96"
POSE = [1, 2, 3, 0, 0, 0, 1]


def content(image):
    file = io.BytesIO()
    Image.fromarray(image).save(file, "PNG")
    return file.getvalue()
