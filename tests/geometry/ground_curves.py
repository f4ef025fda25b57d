"""The lane shape model of the LSTR family: a cubic on flat ground and its image in a pitched camera.

GTN paper Eq. (5) to (8); its misprints are corrected by LSTR (Liu et al. 2021). On the ground, X to the right
and Z ahead of the camera, a lane line is

    X = k Z^3 + m Z^2 + n Z + b                                                                                 (5)

and its image is the curve u(v) of Eq. (7), see `geometry.lane_shapes`; here in pixels from the principal point.

The paper derives (7) by rotating image points with the camera, (u, v, f) -> (u', v', f'), without the division by
f' / f (Eq. 6, `tilted_image_curve`). That holds for small pitch only. Projecting the ground curve through a
pinhole at any pitch gives the same family of curves, with other coefficients: `pinhole_image_curve`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class GroundCurve(NamedTuple):
    """Coefficients of Eq. (5), each (*b): k 1/m^2, m 1/m, n 1, b metres."""

    k: Any
    m: Any
    n: Any
    b: Any


class ImageCurve(NamedTuple):
    """Coefficients of Eq. (7), each (*b), named k'', f'', m'', n', b'', b'''."""

    k: Any
    f: Any
    m: Any
    n: Any
    b: Any
    offset: Any


def ground_offset(curve: GroundCurve, ahead: Any) -> Any:
    """Return X of the ground curve at distances Z ahead (metres): Eq. (5)."""
    return ((curve.k * ahead + curve.m) * ahead + curve.n) * ahead + curve.b


def flat_image_curve(curve: GroundCurve, focal: float, height: float) -> ImageCurve:
    """Return the image curve of a level camera: u = k' / v^2 + m' / v + n' + b' v.

    Args:
        curve: on the ground.
        focal: focal length, pixels.
        height: of the camera above the ground, metres.
    """
    # u = f X / Z and v = f h / Z, so that Z = f h / v.
    depth = focal * height
    return ImageCurve(
        k=focal * depth**2 * curve.k,
        f=0.0 * curve.k,
        m=focal * depth * curve.m,
        n=focal * curve.n,
        b=curve.b / height,
        offset=0.0 * curve.b,
    )


def tilted_image_curve(flat: ImageCurve, focal: float, pitch: float) -> ImageCurve:
    """Return the curve on the tilted image plane by the paper's Eq. (6), in the form of Eq. (7).

    Args:
        flat: of a level camera.
        focal: focal length, pixels.
        pitch: phi, angle between optical axis and ground, radians, positive where the horizon moves down the image.
    """
    cos, sin, tan = np.cos(pitch), np.sin(pitch), np.tan(pitch)
    return ImageCurve(
        k=flat.k * cos**2,
        f=focal * sin + 0.0 * flat.k,
        m=flat.m * cos,
        n=flat.n,
        b=flat.b / cos,
        offset=flat.b * focal * tan,
    )


def pinhole_image_curve(curve: GroundCurve, focal: float, height: float, pitch: float) -> ImageCurve:
    """Return the exact image of a ground curve in a pinhole camera at any pitch; arguments as above.

    A pixel's ray meets the ground at Z = h z / y and X = h u / y. Its downward component is
    y = v cos(phi) - f sin(phi) and its forward component z = f cos(phi) + v sin(phi) = f / cos(phi) + y tan(phi). With
    (5),

        u = (k h^2 z^3 / y^2) + (m h z^2 / y) + n z + b y / h,

    and expanding z in powers of y gives (7) with y = cos(phi) (v - f'').
    """
    cos, tan = np.cos(pitch), np.tan(pitch)
    near, horizon = focal / cos, focal * tan
    k, m = curve.k * height**2, curve.m * height
    # Coefficients of y^-2, y^-1, 1 and y.
    inverse_square = k * near**3
    inverse = 3.0 * k * near**2 * tan + m * near**2
    constant = 3.0 * k * near * tan**2 + 2.0 * m * near * tan + curve.n * near
    linear = k * tan**3 + m * tan**2 + curve.n * tan + curve.b / height
    return ImageCurve(
        k=inverse_square / cos**2,
        f=horizon + 0.0 * k,
        m=inverse / cos,
        n=constant,
        b=linear * cos,
        offset=linear * cos * horizon,
    )


def normalised_image_curve(curve: ImageCurve, center: tuple[float, float], size: tuple[float, float]) -> ImageCurve:
    """Return the same curve with rows and columns as fractions of the image, counted from its top-left corner.

    Args:
        curve: in pixels from the principal point.
        center: principal point (u, v), pixels.
        size: width and height, pixels.
    """
    (cu, cv), (width, height) = center, size
    return ImageCurve(
        k=curve.k / height**2 / width,
        f=(curve.f + cv) / height,
        m=curve.m / height / width,
        n=(curve.n + cu) / width,
        b=curve.b * height / width,
        offset=(curve.offset + curve.b * cv) / width,
    )
