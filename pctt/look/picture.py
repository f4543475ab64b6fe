"""A picture in memory."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Union

import numpy as np

from pctt.look.program import whole


class Picture:
    """``pixels`` (height, width, 3), 0 to 255; a notebook shows them."""

    def __init__(self, pixels: np.ndarray):
        self.pixels = pixels

    def _repr_png_(self) -> bytes:
        """The picture as a file in PNG format."""
        from PIL import Image  # of the extra `pictures`

        file = BytesIO()
        Image.fromarray(np.ascontiguousarray(self.pixels)).save(file, format="png", compress_level=4)
        return file.getvalue()

    def save(self, path: Union[str, Path]) -> None:
        """Write a PNG file, whole or not at all; FolderError if that fails."""
        with whole(Path(path)) as temporary:
            temporary.write_bytes(self._repr_png_())
