"""Conversions between the units of data sheets (°/h, ppm, milliradian) and the project's (°/s)."""

import math

DEG_PER_H = 1.0 / 3600.0
"""One °/h in °/s."""

PPM = 1e-6
MILLIRADIAN = 1e-3
RAD_PER_DEG = math.pi / 180.0

EARTH_RATE_DPS = 15.041067 * DEG_PER_H
"""Rotation of the Earth against the stars, 7.292115e-5 rad/s (WGS 84), in °/s."""
