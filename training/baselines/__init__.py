"""Every method the project is compared with: error surfaces over (temperature, rate), and filters over time."""

from training.baselines.filters import FILTERS
from training.baselines.surfaces import SURFACES, Surface

__all__ = ["FILTERS", "SURFACES", "Surface"]
