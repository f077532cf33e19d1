"""Everything that can be planted, by name."""

from tools.blind.changes import CHANGES
from tools.blind.effect import Effect
from tools.blind.electronics import ELECTRONICS, GROSS
from tools.blind.foreign import FOREIGN
from tools.blind.frames import FRAMES
from tools.blind.optics import OPTICS
from tools.blind.surroundings import SURROUNDINGS
from tools.blind.timing import TIMING

KNOWN: dict[str, Effect] = {e.id: e for e in (*OPTICS, *ELECTRONICS, *CHANGES, *TIMING, *SURROUNDINGS)}
"""Effects of the public catalogue, with a strength that can be chosen."""
DECOYS: dict[str, Effect] = {e.id: e for e in GROSS}
"""Plain wrong coefficients."""
INTEGRITY: dict[str, Effect] = {e.id: e for e in FRAMES}
"""Faults of frames, clocks and units."""
UNLISTED: dict[str, Effect] = {e.id: e for e in FOREIGN}
"""Effects in no catalogue: the right answer is "unknown" and the driver."""
ALL = KNOWN | DECOYS | INTEGRITY | UNLISTED
THERMAL_DRIVERS = frozenset(
    {"temperature", "temperature_rate", "rate_times_temperature", "rate_times_temperature_rate"}
)
