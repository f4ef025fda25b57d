"""Light and weather of an image: sun, sky, fog, rain and night, and the camera's exposure, noise and blur."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from jaxtyping import Float

from tflane_jax.limits import SOME_WEIGHT, PositiveOrZero, Range, Rules

Rgb = Float[np.ndarray, "3"]


class Sky(enum.Enum):
    """Kinds of weather and time of day."""

    CLEAR = "clear"
    LOW_SUN = "low sun"
    OVERCAST = "overcast"
    RAIN = "rain"
    FOG = "fog"
    DUSK = "dusk"
    NIGHT = "night"


@dataclass(frozen=True)
class FrontWeatherConfig:
    """Frequency and strength of each kind of weather at severity 1.

    Attributes:
        kinds: relative frequencies at severity 1; at severity 0 all is clear, so that this kind is among them.
        fog: visibility in fog, metres (distance at which contrast has fallen to 1/e).
        rain: visibility in rain, metres.
        noise: standard deviation of the sensor noise at severity 1, of full brightness 1; night doubles it.
        blur: largest blur of the lens, pixels.
        wear: largest wear of paint.
        contrast, exposure, tint: largest relative deviation of the camera's tone.
    """

    kinds: Annotated[tuple[tuple[Sky, PositiveOrZero], ...], SOME_WEIGHT] = (
        (Sky.CLEAR, 0.26),
        (Sky.LOW_SUN, 0.14),
        (Sky.OVERCAST, 0.22),
        (Sky.RAIN, 0.14),
        (Sky.FOG, 0.08),
        (Sky.DUSK, 0.08),
        (Sky.NIGHT, 0.08),
    )
    fog: Range = (45.0, 160.0)
    rain: Range = (120.0, 500.0)
    noise: PositiveOrZero = 0.03
    blur: PositiveOrZero = 0.9
    wear: PositiveOrZero = 1.0
    contrast: PositiveOrZero = 0.35
    exposure: PositiveOrZero = 0.35
    tint: PositiveOrZero = 0.1

    def limits(self) -> Rules:
        """Clear weather is among the kinds."""
        has = any(kind is Sky.CLEAR for kind, _ in self.kinds)
        yield "kinds", has, "a list with Sky.CLEAR, the weather at severity 0 (its frequency may be 0)"


@dataclass(frozen=True)
class Weather:
    """Light and weather of one image; colours are display values from 0 to 1.

    Attributes:
        kind: of weather.
        sun: (3,) unit vector towards the sun, ego frame.
        direct, ambient: strength of sunlight and of ambient light; their sum is about 1 by day.
        zenith, horizon: colours of the sky.
        cloud: 0 to 1, how much of the sky is clouded.
        visibility: metres.
        rain: 0 to 1.
        night: 0 to 1; the ego's headlights shine.
        wear: of paint, 0 to 1.
        dirt: 0 to 1, amount of stains, seams and cracks on the road.
        exposure, contrast: factors of the picture; contrast about its middle.
        tint: (3,) factors.
        noise: standard deviation.
        blur: of the lens, pixels.
    """

    kind: Sky
    sun: Rgb
    direct: float
    ambient: float
    zenith: Rgb
    horizon: Rgb
    cloud: float
    visibility: float
    rain: float
    night: float
    wear: float
    dirt: float
    exposure: float
    contrast: float
    tint: Rgb
    noise: float
    blur: float


# Direct and ambient light, colours of zenith and horizon, cloud.
_LIGHT: dict[Sky, tuple[float, float, tuple[float, ...], tuple[float, ...], float]] = {
    Sky.CLEAR: (0.55, 0.5, (0.33, 0.55, 0.82), (0.74, 0.84, 0.92), 0.2),
    Sky.LOW_SUN: (0.6, 0.36, (0.45, 0.56, 0.74), (0.98, 0.88, 0.72), 0.25),
    Sky.OVERCAST: (0.06, 0.8, (0.7, 0.73, 0.77), (0.82, 0.84, 0.86), 0.8),
    Sky.RAIN: (0.0, 0.6, (0.5, 0.53, 0.57), (0.64, 0.67, 0.7), 0.7),
    Sky.FOG: (0.0, 0.78, (0.78, 0.79, 0.8), (0.8, 0.81, 0.82), 0.1),
    Sky.DUSK: (0.04, 0.42, (0.2, 0.25, 0.42), (0.72, 0.52, 0.42), 0.4),
    Sky.NIGHT: (0.0, 0.12, (0.02, 0.025, 0.05), (0.08, 0.08, 0.1), 0.1),
}


def draw_weather(rng: np.random.Generator, config: FrontWeatherConfig, severity: float) -> Weather:
    """Draw the weather; the number of draws from `rng` is always the same.

    Args:
        rng: stream.
        config: what to draw.
        severity: 0 (clear, fresh paint, a perfect camera) to 1.
    """
    kinds, weights = zip(*config.kinds, strict=True)
    probability = severity * np.asarray(weights) / np.sum(weights)
    probability[kinds.index(Sky.CLEAR)] += 1.0 - severity
    kind = kinds[rng.choice(len(kinds), p=probability / probability.sum())]
    direct, ambient, zenith, horizon, cloud = _LIGHT[kind]
    azimuth = rng.uniform(-np.pi, np.pi)
    low = kind in (Sky.LOW_SUN, Sky.DUSK)
    elevation = np.deg2rad(rng.uniform(7.0, 18.0) if low else rng.uniform(25.0, 70.0))
    sun = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    fog, rain = rng.uniform(*config.fog), rng.uniform(*config.rain)
    clear = rng.uniform(900.0, 3000.0)
    # Plain floats: numpy's would turn float32 arrays into float64.
    deviation = rng.uniform(-1.0, 1.0, 5).tolist()
    some = rng.random(5).tolist()
    dim = 0.85 + 0.3 * some[3]
    return Weather(
        kind=kind,
        sun=sun,
        direct=direct,
        ambient=ambient * (1.0 if kind is not Sky.NIGHT else 0.5 + some[4]),
        zenith=np.asarray(zenith) * dim,
        horizon=np.clip(np.asarray(horizon) * dim, 0.0, 1.0),
        cloud=cloud * some[2],
        visibility={Sky.FOG: fog, Sky.RAIN: rain}.get(kind, clear),
        rain=float(kind is Sky.RAIN) * (0.4 + 0.6 * some[0]),
        night={Sky.NIGHT: 1.0, Sky.DUSK: 0.4}.get(kind, 0.0),
        wear=config.wear * severity * some[1],
        dirt=severity * (0.3 + 0.7 * some[0]),
        exposure=(1.0 + severity * config.exposure * deviation[0]) * (1.4 if kind is Sky.NIGHT else 1.0),
        contrast=1.0 + severity * config.contrast * deviation[1],
        tint=1.0 + severity * config.tint * np.array(deviation[2:]),
        noise=config.noise * severity * some[3] * (2.0 if kind is Sky.NIGHT else 1.0),
        blur=config.blur * severity * some[4],
    )
