"""Colours of signed errors: two arms of equal lightness steps in Oklab that meet at 0.

Björn Ottosson's Oklab (2020) is perceptually uniform, so a linear path in it is a uniform map. 0 is light, errors of
either sign darken by the same amount: readable by the colour-blind and in grey.
"""

import numpy as np

LIGHT, DARK = 0.96, 0.42  # Oklab lightness at 0 and at the ends
CHROMA = 0.17
HUES_DEG = (255.0, 40.0)  # negative: blue, positive: orange red

_LMS = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_SRGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)

RAW = (235, 130, 60, 255)
CORRECTED = (70, 170, 240, 255)
REFERENCE = (120, 200, 120, 255)
BAND = (110, 125, 165, 255)
TEMPERATURE = (226, 96, 120, 255)
TRAIL = (255, 214, 64, 255)
LINES = (150, 158, 172, 255)
TEXT = (238, 241, 246, 255)  # readable in both themes of the viewer
RULES = (186, 120, 235, 255)
UNMEASURED = (66, 72, 86, 255)
POINTS = (40, 44, 56, 255)  # on a coloured surface
VALIDITY = (70, 200, 160, 255)


def diverging(values: np.ndarray, limit: float) -> np.ndarray:
    """Colour values of −limit … limit; shape `(..., 4)` uint8 sRGB. What lies beyond gets the end's colour."""
    scaled = np.clip(
        np.asarray(values, float) / limit if limit > 0.0 else np.zeros(np.shape(values)), -1.0, 1.0
    )
    scaled = np.nan_to_num(scaled)
    size = np.abs(scaled)
    hue = np.deg2rad(np.where(scaled < 0.0, *HUES_DEG))
    chroma = CHROMA * size
    lab = np.stack([LIGHT + (DARK - LIGHT) * size, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    linear = np.clip((lab @ _LMS.T) ** 3 @ _SRGB.T, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.concatenate([np.rint(encoded * 255.0), np.full((*size.shape, 1), 255.0)], axis=-1).astype(
        np.uint8
    )
