"""Random generators by purpose, so that switching one effect on leaves every other random draw as it was."""

import zlib

import numpy as np


class Draw:
    """The random draws of one seeded run."""

    def __init__(self, seed: int):
        """Start from the scenario's seed."""
        self.seed = seed

    def of(self, purpose: str) -> np.random.Generator:
        """Return the generator of one purpose, the same for the same seed and name."""
        return np.random.default_rng([self.seed, zlib.crc32(purpose.encode())])
