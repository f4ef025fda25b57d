"""What is in a picture."""

import numpy as np


def count_colours(picture) -> int:
    """Return the number of colours of a PNG file or an array of bytes (..., 3 or 4), whose fourth channel is ignored.

    Colours are compared as whole numbers: rows of three sort a hundred times slower.
    """
    from matplotlib.image import imread

    pixels = picture if isinstance(picture, np.ndarray) else np.round(imread(picture) * 255)
    red, green, blue = np.moveaxis(np.asarray(pixels, np.uint32)[..., :3], -1, 0)
    return len(np.unique(red << 16 | green << 8 | blue))
